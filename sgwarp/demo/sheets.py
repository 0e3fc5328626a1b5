"""The pictures of the demonstration, drawn with matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from sgwarp.demo.data import FURNITURE, Room
from sgwarp.demo.measurement import Finding, Measurement
from sgwarp.errors import InputError
from sgwarp.files.atomic import atomic_path
from sgwarp.visualization.pictures import Picture, depth_picture, heat_map, overlay, to_picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 150
TILE = 3.2  # width of a picture on a sheet [inches]
MARGIN = 9  # of a cross [pixels]
HIT, MISS, INK = "#1a8f4b", "#c0392b", "#222222"
# One colour per piece of furniture, in the order of the classes, apart from each other also on a dark background.
COLOURS = np.array(
    [
        (226, 74, 51),
        (58, 134, 222),
        (242, 190, 84),
        (240, 98, 178),
        (34, 211, 224),
        (160, 96, 44),
        (160, 90, 220),
        (44, 160, 90),
        (255, 127, 14),
        (166, 226, 70),
        (186, 204, 232),
    ],
    dtype=np.uint8,
)


@dataclass(frozen=True)
class Trial:
    """One point of the trade between time and error."""

    name: str
    views: int
    seconds: float
    result: Measurement


def require_matplotlib() -> None:
    """Raise InputError if the pictures cannot be drawn."""
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError:
        raise InputError('the pictures of the demonstration need matplotlib: pip install "sgwarp[demo]"') from None


def draw_renderings(room: Room, renderings: dict[str, tuple[Tensor, Tensor]], path: Path) -> None:
    """Photographs beside what the Gaussians look like and how far away they are.

    Args:
        room: The scene.
        renderings: Colour [H, W, 3] and mean depth [m], [H, W], of each held-out view.
        path: PNG to write.
    """
    figure, axes = _sheet(len(room.held_out), 3)
    for row, view in zip(axes, room.held_out, strict=True):
        rgb, depth = renderings[view.stem]
        photograph = view.image()
        psnr = -10 * np.log10(float((rgb.clamp(0, 1) - photograph).square().mean()))
        _show(row[0], to_picture(photograph), f"photograph {view.stem} (held out)")
        _show(row[1], to_picture(rgb), f"{len(room.gaussians):,} Gaussians, PSNR {psnr:.1f} dB")
        _show(row[2], depth_picture(depth), f"depth, {depth[depth > 0].min():.1f} to {depth.max():.1f} m")
    _save(figure, path)


def draw_queries(room: Room, result: Measurement, path: Path) -> None:
    """One heat map per text, in the held-out view that shows most of the object, with the object's true outline."""
    images = {view.stem: view.image() for view in room.held_out}
    columns = 4
    figure, axes = _sheet(-(-(FURNITURE + 1) // columns), columns)
    tiles = list(axes.flat)
    for axis, finding in zip(tiles, result.best_sights, strict=False):
        _draw_query(axis, finding, images[finding.stem], room.truth[finding.stem] == room.names.index(finding.name))
    _draw_key(tiles[len(result.best_sights)], result.localised, len(result.best_sights))
    for axis in tiles[len(result.best_sights) + 1 :]:
        axis.axis("off")
    _save(figure, path)


def _draw_query(axis: Axes, finding: Finding, image: Tensor, mask: Tensor) -> None:
    colour = HIT if finding.hit else MISS
    _show(axis, heat_map(image, finding.scores, low=0.0, high=1.0), "")
    axis.set_title(f"“{finding.name}”", fontsize=11, color=INK, loc="left", pad=4)
    axis.set_title("found" if finding.hit else "missed", fontsize=10, color=colour, loc="right", pad=4, weight="bold")
    axis.contour(mask.numpy(), levels=[0.5], colors="white", linewidths=0.9)
    height, width = mask.shape
    x, y = finding.pixel  # a cross at the edge is drawn where it can be seen whole
    _cross(axis, (min(max(x, MARGIN), width - MARGIN), min(max(y, MARGIN), height - MARGIN)))


def _cross(axis: Axes, place: tuple[float, float]) -> None:
    axis.plot(*place, marker="+", markersize=13, color="black", markeredgewidth=3.6)
    axis.plot(*place, marker="+", markersize=12, color="white", markeredgewidth=1.8)


def _draw_key(axis: Axes, hits: int, count: int) -> None:
    """Legend of the marks, in the tile that is left over."""
    from matplotlib import colormaps

    axis.set_xlim(0, 1)
    axis.set_ylim(0, 1)
    axis.axis("off")
    axis.text(0.06, 0.88, f"{hits} of {count} found", fontsize=15, color=INK, weight="bold", va="center")
    _cross(axis, (0.1, 0.69))
    axis.text(0.18, 0.69, "best pixel of the query", fontsize=10, color=INK, va="center")
    axis.plot([0.06, 0.14], [0.54, 0.54], color="black", linewidth=3)
    axis.plot([0.06, 0.14], [0.54, 0.54], color="white", linewidth=1.2)
    axis.text(0.18, 0.54, "true outline of the object", fontsize=10, color=INK, va="center")
    ramp = colormaps["turbo"](np.linspace(0, 1, 256))[None, :, :3]
    axis.imshow(ramp, extent=(0.06, 0.94, 0.24, 0.34), aspect="auto")
    for place, text, side in ((0.06, "scene's median", "left"), (0.94, "its best 0.1 %", "right")):
        axis.text(place, 0.15, text, fontsize=9, color=INK, ha=side, va="center")
    axis.text(0.06, 0.40, "score", fontsize=9, color=INK, va="center")


def draw_segmentation(room: Room, columns: Sequence[tuple[str, Measurement]], path: Path) -> None:
    """Class maps of each held-out view: one column per way to lift, and the truth.

    Args:
        room: The scene.
        columns: Title and result of each way.
        path: PNG to write.
    """
    figure, axes = _sheet(len(room.held_out), len(columns) + 2, below=0.62)
    for row, view in zip(axes, room.held_out, strict=True):
        image = view.image()
        _show(row[0], to_picture(image), f"held-out view {view.stem}")
        maps = [(title, result.classes[view.stem]) for title, result in columns]
        maps.append(("truth", room.truth[view.stem]))
        for axis, (title, classes) in zip(row[1:], maps, strict=True):
            _show(axis, overlay(image, classes, COLOURS, 0.72), title)
    _legend(figure, room.furniture)
    _save(figure, path)


def draw_trials(trials: Sequence[Trial], bound: Trial, path: Path) -> None:
    """Error against run time: one point per number of views, and the bound that true labels set."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.6, 3.6), dpi=DPI, layout="constrained", facecolor="white")
    left, right = figure.subplots(1, 2)
    seconds = [trial.seconds for trial in trials]
    count = len(bound.result.best_sights)
    series = (
        (left, "mIoU of the furniture", [t.result.miou for t in trials], bound.result.miou, 1.0),
        (right, f"objects localised, of {count}", [t.result.localised for t in trials], bound.result.localised, count),
    )
    for axis, title, values, limit, top in series:
        axis.axhline(limit, color="#999999", linewidth=1.2, linestyle=(0, (4, 3)))
        # x in shares of the axis, y in data
        place = axis.get_yaxis_transform()
        axis.text(0.02, limit - 0.02 * top, bound.name, fontsize=9, color="#777777", va="top", transform=place)
        axis.plot(seconds, values, color="#2d6cb5", linewidth=1.6, marker="o", markersize=6)
        for trial, value in zip(trials, values, strict=True):
            axis.annotate(
                f"{trial.views} views", (trial.seconds, value), (5, -13), textcoords="offset points", fontsize=9
            )
        axis.set_ylim(0, 1.08 * top)
        axis.set_xlim(0, 1.2 * max(seconds))
        axis.set_title(title, fontsize=11, color=INK, loc="left")
        axis.set_xlabel("seconds to encode, lift and answer", fontsize=9)
        axis.spines[["top", "right"]].set_visible(False)
        axis.tick_params(labelsize=9)
    _save(figure, path)


def _sheet(rows: int, columns: int, below: float = 0.0) -> tuple[Figure, Any]:
    """A figure of tiles of 4 : 3 with a line of title each, and `below` inches at the bottom; axes [rows, columns]."""
    from matplotlib.figure import Figure

    gap, title = 0.12, 0.3  # [inches]
    width = columns * TILE + (columns + 1) * gap
    height = rows * (0.75 * TILE + title) + gap + below
    figure = Figure(figsize=(width, height), dpi=DPI, facecolor="white")
    axes = np.empty((rows, columns), dtype=object)
    for row, column in np.ndindex(rows, columns):
        left, bottom = gap + column * (TILE + gap), height - (row + 1) * (0.75 * TILE + title)
        axes[row, column] = figure.add_axes((left / width, bottom / height, TILE / width, 0.75 * TILE / height))
    return figure, axes


def _show(axis: Axes, picture: Picture, title: str) -> None:
    axis.imshow(picture, interpolation="lanczos")
    axis.set_xticks([])
    axis.set_yticks([])
    for spine in axis.spines.values():
        spine.set_visible(False)
    if title:
        axis.set_title(title, fontsize=10, color=INK, loc="left", pad=4)


def _legend(figure: Figure, names: Sequence[str]) -> None:
    from matplotlib.patches import Patch

    entries = [Patch(color=colour / 255, label=name) for name, colour in zip(names, COLOURS, strict=True)]
    entries.append(Patch(facecolor="#555555", label="background"))
    figure.legend(
        handles=entries,
        loc="lower center",
        ncols=-(-len(entries) // 2),
        fontsize=10,
        frameon=False,
        handlelength=1.1,
        handleheight=1.1,
        columnspacing=1.6,
        borderaxespad=0.3,
    )


def _save(figure: Figure, path: Path) -> None:
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=DPI)
