"""Pictures of a fit: a contact sheet of held-out views, and quality over time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sgwarp.errors import InputError
from sgwarp.files.atomic import atomic_path
from sgwarp.files.images import write_rgb
from sgwarp.metrics.images import psnr
from sgwarp.ops.splatting.forward import rasterize
from sgwarp.reconstruction.fitting.measurement import Measurement
from sgwarp.reconstruction.fitting.photographs import Photograph
from sgwarp.scene import Gaussians
from sgwarp.visualization.pictures import Picture, to_picture

MOST_ROWS = 8
TILE_WIDTH = 400  # [pixels]
LETTERS = 0.45  # size of the titles
GAP = 6  # between pictures [pixels]
LARGEST_ERROR = 0.25  # mean difference of the channels that is drawn in the strongest colour
INK, ACCENT = "#222222", "#2d6cb5"
DPI = 150


def sheet_rows(count: int) -> list[int]:
    """Which of so many photographs a contact sheet shows, evenly spread."""
    return sorted(set(np.linspace(0, count - 1, min(MOST_ROWS, count)).round().astype(int).tolist()))


def write_contact_sheet(
    gaussians: Gaussians, photographs: Sequence[Photograph], path: Path, *, white: bool = False
) -> None:
    """Draw photographs beside their renderings and the difference, at most eight of them, evenly spread.

    Args:
        gaussians: The scene.
        photographs: At least one.
        path: .png or .jpg to write.
        white: The background is white instead of black.
    """
    rows = [_row(gaussians, photographs[index], white) for index in sheet_rows(len(photographs))]
    width = max(row.shape[1] for row in rows)
    padded = [np.pad(row, ((0, GAP), (0, width - row.shape[1]), (0, 0)), constant_values=255) for row in rows]
    write_rgb(path, np.concatenate(padded))


def _row(gaussians: Gaussians, photograph: Photograph, white: bool) -> Picture:
    import cv2

    background = gaussians.means.new_ones(3) if white else None
    image = rasterize(gaussians, photograph.camera, background=background).features
    truth = photograph.image(background)
    error = (image.clamp(0, 1) - truth).abs().mean(dim=2).cpu().numpy() / LARGEST_ERROR
    colours = cv2.applyColorMap((error.clip(0, 1) * 255).astype(np.uint8), cv2.COLORMAP_INFERNO)[:, :, ::-1]
    titles = (
        f"photograph {photograph.stem}",
        f"rendering, {psnr(image, truth, photograph.mask):.1f} dB",
        f"difference, 0 to {LARGEST_ERROR:g} and more",
    )
    height = max(1, round(TILE_WIDTH * photograph.camera.height / photograph.camera.width))
    tiles: list[Picture] = []
    for title, picture in zip(titles, (to_picture(truth), to_picture(image), colours), strict=True):
        tile = cv2.resize(np.ascontiguousarray(picture), (TILE_WIDTH, height), interpolation=cv2.INTER_AREA)
        (width, _), _ = cv2.getTextSize(title, cv2.FONT_HERSHEY_SIMPLEX, LETTERS, 1)
        cv2.rectangle(tile, (0, 0), (width + 16, 24), (0, 0, 0), -1)
        cv2.putText(tile, title, (8, 17), cv2.FONT_HERSHEY_SIMPLEX, LETTERS, (255, 255, 255), 1, cv2.LINE_AA)
        tiles.append(np.pad(tile, ((0, 0), (0, GAP), (0, 0)), constant_values=255).astype(np.uint8))
    return np.concatenate(tiles, axis=1)[:, :-GAP]


def require_matplotlib() -> None:
    """Raise InputError if curves cannot be drawn."""
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError:
        raise InputError("the plot of a fit needs matplotlib; run: pip install 'sgwarp[plots]'") from None


def draw_curve(curve: Sequence[Measurement], path: Path) -> None:
    """PSNR of the held-out views and the loss, over the seconds spent on steps.

    Raises:
        InputError: matplotlib is not installed.
    """
    require_matplotlib()
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.6, 3.6), dpi=DPI, layout="constrained", facecolor="white")
    quality, loss = figure.subplots(1, 2)
    seconds = [point.seconds for point in curve]
    for axis, values, label in (
        (quality, [point.psnr for point in curve], "PSNR of held-out views [dB]"),
        (loss, [point.loss for point in curve], "loss, running mean"),
    ):
        axis.plot(seconds, values, "o-", color=ACCENT, markersize=4)
        axis.set_xlabel("seconds of fitting", color=INK)
        axis.set_ylabel(label, color=INK)
        axis.grid(alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
    last = curve[-1]
    quality.annotate(
        f"{last.psnr:.2f} dB\n{last.step:,} steps, {last.count:,} Gaussians",
        (last.seconds, last.psnr),
        xytext=(-6, -14),
        textcoords="offset points",
        ha="right",
        va="top",
        color=INK,
    )
    with atomic_path(path) as temporary:
        figure.savefig(temporary)
