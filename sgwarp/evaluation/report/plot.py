"""The plot of the report: quality over run time, one line per knob, the Pareto front behind them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sgwarp.errors import InputError
from sgwarp.evaluation.report.sweep import DEFAULT, Trial, pareto_front
from sgwarp.files.atomic import atomic_path

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DPI = 150
INK, FAINT, FRONT = "#222222", "#777777", "#d9d9d9"
STYLES = {  # colour and marker of each knob
    "alpha_min": ("#2d6cb5", "o"),
    "transmittance_min": ("#d1495b", "s"),
    "SH degree": ("#00a5b5", "p"),
    "largest Gaussians": ("#1a8f4b", "^"),
    "random Gaussians": ("#c98a1b", "D"),
    "resolution": ("#8e5bbf", "v"),
    "views": ("#1a8f4b", "^"),
    "lift mode": ("#c98a1b", "D"),
    "features": ("#8e5bbf", "v"),
}
LETTER = 4.9  # width of a character of a name [points]
NEAR = 0.02  # share of the range of qualities within which a trial comes out like the default
CROWDED = 5  # so many of them are drawn again, larger

Place = tuple[float, float]  # run time and quality
Box = tuple[float, float, float, float]  # left, bottom, right, top [points]


def require_matplotlib() -> None:
    """Raise InputError if the plot cannot be drawn."""
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError:
        raise InputError("the report's plot needs matplotlib; run: pip install 'sgwarp[plots]'") from None


def draw_trials(rendering: Sequence[Trial], lifting: Sequence[Trial], path: Path) -> None:
    """One panel for rendering and, where there are labels, one for lifting."""
    from matplotlib.figure import Figure

    panels = 2 if lifting else 1
    figure = Figure(figsize=(6.4 * panels, 5.2), dpi=DPI, layout="constrained", facecolor="white")
    axes = figure.subplots(1, panels, squeeze=False)[0]
    names = []
    for axis, title, trials, quality, unit, time_label, label in (
        (axes[0], "Rendering", rendering, "psnr", 1e3, "milliseconds per view", "PSNR against the float64 oracle [dB]"),
        (axes[-1], "Lifting", lifting, "miou", 1.0, "seconds to lift and segment", "mIoU on held-out views"),
    ):
        if trials:
            axis.set_title(title, fontsize=12, color=INK, loc="left")
            drawn = _panel(axis, trials, quality, unit, time_label, label)
            names += [(part, trials, _places(trials, quality, unit), chosen) for part, chosen in drawn]
    figure.draw_without_rendering()  # settles where the points are
    for part, trials, places, chosen in names:
        _annotate(part, trials, places, chosen)
    with atomic_path(path) as temporary:
        figure.savefig(temporary)


def _panel(
    axis: Axes, trials: Sequence[Trial], quality: str, unit: float, time_label: str, label: str
) -> list[tuple[Axes, set[int]]]:
    """Draw everything but the names of the settings; returns which of them belong where."""
    places = _places(trials, quality, unit)
    front = _places(pareto_front(trials, quality), quality, unit)
    _points(axis, trials, places, front)
    crowd = _crowd(places)
    _time_axis(axis)
    axis.margins(x=0.12, y=0.06)
    axis.set_xlabel(time_label, fontsize=9.5)
    axis.set_ylabel(label, fontsize=9.5)
    axis.legend(fontsize=8.5, frameon=False, loc="upper left")
    if not crowd:
        return [(axis, set(range(1, len(trials))))]
    zoom = axis.inset_axes((0.5, 0.12, 0.49, 0.5))
    _points(zoom, trials, places, front)
    times, values = zip(*(places[k] for k in (0, *crowd)), strict=True)
    span = max(values) - min(values) or 1e-3
    zoom.set_xlim(0.94 * min(times), 1.1 * max(times))
    zoom.set_ylim(min(values) - 0.2 * span, max(values) + 0.2 * span)
    _time_axis(zoom, (1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 7, 8, 9))
    zoom.tick_params(labelsize=7.5)
    zoom.spines[["top", "right"]].set_visible(True)
    axis.indicate_inset_zoom(zoom, edgecolor=FAINT, alpha=0.5)
    return [(axis, set(range(1, len(trials))) - crowd), (zoom, crowd)]


def _places(trials: Sequence[Trial], quality: str, unit: float) -> list[Place]:
    return [(trial.seconds * unit, trial.errors[quality]) for trial in trials]


def _points(axis: Axes, trials: Sequence[Trial], places: Sequence[Place], front: Sequence[Place]) -> None:
    axis.step(*zip(*front, strict=True), where="post", color=FRONT, linewidth=7, zorder=1, label="Pareto front")
    axis.plot(*places[0], color=INK, marker="*", markersize=14, linestyle="none", zorder=6, label=DEFAULT)
    for knob in dict.fromkeys(trial.knob for trial in trials[1:]):
        colour, marker = STYLES[knob]
        own = [place for trial, place in zip(trials, places, strict=True) if trial.knob == knob]
        line = sorted([places[0], *own], key=lambda place: place[1])
        axis.plot(*zip(*line, strict=True), color=colour, linewidth=1.1, alpha=0.45, zorder=2)
        axis.plot(
            *zip(*own, strict=True), color=colour, marker=marker, markersize=6, linestyle="none", zorder=3, label=knob
        )
    axis.grid(True, color="#eeeeee", zorder=0)
    axis.spines[["top", "right"]].set_visible(False)
    axis.tick_params(labelsize=9)


def _annotate(axis: Axes, trials: Sequence[Trial], places: Sequence[Place], chosen: set[int]) -> None:
    """Name the settings beside their points, each where it covers least of the points and of the names before it."""
    from matplotlib.patheffects import withStroke

    to_points = 72.0 / axis.figure.dpi
    spots = [tuple(to_points * value for value in axis.transData.transform(place)) for place in places]
    taken = [(x - 5.0, y - 5.0, x + 5.0, y + 5.0) for x, y in spots]
    for k in sorted(chosen, key=lambda k: spots[k]):
        (x, y), half_width = spots[k], 0.5 * LETTER * len(trials[k].setting) + 1.0
        boxes = []
        for reach in (0.0, 9.0, 18.0):
            side, up = 8.0 + half_width + reach, 10.5 + reach
            for dx, dy in ((side, 0.0), (0.0, up), (0.0, -up), (-side, 0.0), (side, up), (side, -up)):
                boxes.append((x + dx - half_width, y + dy - 4.0, x + dx + half_width, y + dy + 4.0))
        box = min(boxes, key=lambda box: sum(_overlap(box, other) for other in taken))
        taken.append(box)
        axis.annotate(
            trials[k].setting,
            places[k],
            (0.5 * (box[0] + box[2]) - x, 0.5 * (box[1] + box[3]) - y),
            textcoords="offset points",
            fontsize=8,
            ha="center",
            va="center",
            color=STYLES[trials[k].knob][0],
            path_effects=[withStroke(linewidth=2.5, foreground="white")],
            zorder=5,
        )


def _overlap(one: Box, other: Box) -> float:
    """Area that two boxes share."""
    width = min(one[2], other[2]) - max(one[0], other[0])
    height = min(one[3], other[3]) - max(one[1], other[1])
    return max(width, 0.0) * max(height, 0.0)


def _crowd(places: Sequence[Place]) -> set[int]:
    """Trials that come out like the default; empty unless they are many."""
    values = [value for _, value in places]
    near = NEAR * (max(values) - min(values))
    crowd = {k for k, value in enumerate(values) if k and abs(value - values[0]) <= near}
    return crowd if len(crowd) >= CROWDED else set()


def _time_axis(axis: Axes, steps: Sequence[float] = (1, 2, 5)) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator

    axis.set_xscale("log")
    axis.xaxis.set_major_locator(LogLocator(subs=steps))
    axis.xaxis.set_minor_locator(NullLocator())
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.xaxis.set_minor_formatter(NullFormatter())
