"""A picture of many scenes: seconds against Gaussians and views, and who failed why."""

from __future__ import annotations

import textwrap
import warnings
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sgwarp.cluster.summary import stages_of
from sgwarp.cluster.tasks import Outcome
from sgwarp.errors import printable
from sgwarp.files.atomic import atomic_path

if TYPE_CHECKING:
    from matplotlib.axes import Axes

REASONS = 8  # different errors that are written out
NAMES = 3  # scenes named for each
WIDTH = 58  # characters of a line


def write_plot(outcomes: Sequence[Outcome], path: Path) -> list[Path]:
    """Draw what became of the scenes; nothing without matplotlib or without scenes.

    Returns:
        The files written.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        return []
    if not outcomes:
        return []
    failed = any(outcome.status == "failed" for outcome in outcomes)
    figure = Figure(figsize=(13.5 if failed else 9.0, 3.8), layout="constrained")
    panels = figure.subplots(1, 3 if failed else 2, width_ratios=(1, 1, 1.35) if failed else (1, 1))
    for axes, what in zip(panels, ("gaussians", "views"), strict=False):
        _draw_seconds(axes, outcomes, what)
    if failed:
        _write_reasons(panels[2], outcomes)
    with atomic_path(path) as temporary, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # characters of names that the font lacks
        figure.savefig(temporary, dpi=110, format="png")
    return [path]


def _draw_seconds(axes: Axes, outcomes: Sequence[Outcome], what: str) -> None:
    """Seconds of each stage over the size of the scene."""
    sized = [outcome for outcome in outcomes if what in outcome.size and outcome.seconds]
    for stage in stages_of(sized):
        points = [(outcome.size[what], outcome.seconds[stage]) for outcome in sized if stage in outcome.seconds]
        sizes, seconds = zip(*points, strict=True)
        axes.scatter(sizes, seconds, s=14, alpha=0.7, label=stage)
    axes.set_xlabel(what.replace("gaussians", "Gaussians"))
    axes.set_ylabel("seconds")
    axes.grid(alpha=0.3)
    if not sized:
        axes.text(0.5, 0.5, "no scene was measured", ha="center", va="center", transform=axes.transAxes, color="gray")
        return
    axes.set_ylim(bottom=0)
    axes.set_xlim(0, 1.05 * max(outcome.size[what] for outcome in sized))
    axes.legend(fontsize=8)


def _write_reasons(axes: Axes, outcomes: Sequence[Outcome]) -> None:
    """The most frequent errors, and whose they are; a scene's own name and path do not make an error another one."""
    failed = sorted((outcome for outcome in outcomes if outcome.status == "failed"), key=lambda found: found.name)
    kinds = {outcome.name: outcome.error.replace(outcome.name, "SCENE") for outcome in failed}
    lines = []
    for error, count in Counter(kinds.values()).most_common(REASONS):
        names = [outcome.name for outcome in failed if kinds[outcome.name] == error]
        who = ", ".join(names[:NAMES]) + (f" and {count - NAMES} more" if count > NAMES else "")
        lines += textwrap.wrap(printable(f"{count}: {who}"), WIDTH)
        lines += textwrap.wrap(printable(error), WIDTH, max_lines=3, initial_indent="    ", subsequent_indent="    ")
    if (more := len(set(kinds.values())) - REASONS) > 0:
        lines.append(f"and {more} other errors, see summary.csv")
    axes.set_axis_off()
    axes.set_title(f"{len(failed)} of {len(outcomes)} scenes failed", loc="left", fontsize=10)
    text = "\n".join(lines).replace("$", r"\$")
    axes.text(0, 1, text, va="top", family="monospace", fontsize=7, transform=axes.transAxes)
