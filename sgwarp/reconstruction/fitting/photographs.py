"""The photographs of a fit: read once, checked, made smaller, and kept as bytes, many of them in a file."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.files.images import read_alpha
from sgwarp.reconstruction.fitting.belongings import masks_from_folder as masks_from_folder
from sgwarp.reconstruction.fitting.pixels import PixelStore, StoredPixels
from sgwarp.runs.progress import Report
from sgwarp.scene import Camera, View

logger = logging.getLogger("sgwarp")
LEAST_VIEWS = 3  # with fewer, nearly any scene explains them
DARK = 16  # of 255, that no pixel exceeds
MUCH_HIDDEN = 0.7  # of the pixels, from which on masks may have been meant the other way round

Masks = Callable[[View], Any]


@dataclass(frozen=True, eq=False)
class Photograph:
    """One photograph and the camera that took it.

    Attributes:
        stem: Name of the view.
        camera: At the size of the pixels.
        stored: Its pixels, uint8 [H, W, 3], or where they are kept.
        stored_mask: Which pixels count, uint8 [H, W], 0 for those that do not, kept likewise; None for all.
        stored_alpha: How opaque the pixels are, uint8 [H, W], kept likewise; None where all are opaque.
        path: Its file.
    """

    stem: str
    camera: Camera
    stored: Tensor | StoredPixels
    stored_mask: Tensor | StoredPixels | None = None
    stored_alpha: Tensor | StoredPixels | None = None
    path: Path | None = None

    @property
    def pixels(self) -> Tensor:
        """uint8 [H, W, 3]."""
        return _read_stored(self.stored)

    @property
    def mask(self) -> Tensor | None:
        """Which pixels count, bool [H, W], or None for all."""
        return None if self.stored_mask is None else _read_stored(self.stored_mask).to(torch.bool)

    @property
    def alpha(self) -> Tensor | None:
        """How opaque the pixels are, float32 [H, W] in [0, 1], or None where all are."""
        return None if self.stored_alpha is None else _read_stored(self.stored_alpha).to(torch.float32) / 255.0

    def image(self, background: Tensor | None = None) -> Tensor:
        """float32 [H, W, 3] in [0, 1]; transparent pixels show the background, float32 [3], black if None."""
        image = self.pixels.to(torch.float32) / 255.0
        alpha = self.alpha
        if alpha is None:
            return image
        image = image * alpha[..., None]
        return image if background is None else image + (1.0 - alpha[..., None]) * background


def _read_stored(stored: Tensor | StoredPixels) -> Tensor:
    return stored if isinstance(stored, Tensor) else stored.read()


def read_photographs(
    views: Sequence[View],
    *,
    downscale: int = 1,
    largest: int = 0,
    masks: Masks | None = None,
    device: str | torch.device = "cpu",
    progress: Report | None = None,
    store: PixelStore | None = None,
) -> list[Photograph]:
    """Read all photographs; those that cannot be used or whose mask leaves nothing are left out, with a notice.

    Args:
        views: Posed photographs.
        downscale: Divide width and height by this; pixels are averaged.
        largest: Photographs that are then wider or higher are scaled down to this, with a notice [pixels]; 0 for none.
        masks: Which pixels of a view count, [H, W] of its photograph, zero for those that do not; or None for all.
        device: Where the pixels go.
        progress: Called as `progress(done, total, name)`.
        store: Where the pixels are kept; one of its own if None. Groups that are held together share one.

    Raises:
        InputError: A view has no photograph, or none of the photographs can be used.
    """
    if downscale < 1:
        raise InputError(f"downscale: expected a whole number of at least 1, got {downscale}")
    if largest < 0:
        raise InputError(f"largest: expected a size in pixels, or 0 for none, got {largest}")
    report = progress or (lambda done, total, name: None)
    photographs: list[Photograph] = []
    failed: list[InputError] = []
    hidden: list[str] = []
    dark: list[Path] = []
    store = store or PixelStore(device)
    report(0, len(views), "")
    for done, view in enumerate(views, start=1):
        if view.image_path is None:
            raise InputError(f"view {view.stem}: has no photograph; a scene is fitted to photographs")
        try:
            photograph = _read(view, _size(view.camera, downscale, largest), masks, store)
        except InputError as error:
            failed.append(error)
        else:
            if photograph is None:
                hidden.append(view.stem)
            else:
                photographs.append(photograph)
                if photograph.path is not None and int(photograph.pixels.max()) <= DARK:
                    dark.append(photograph.path)
        report(done, len(views), view.stem)
    if failed and not photographs:
        raise failed[0]
    if failed:
        logger.warning(
            "left out %d of %d photographs that cannot be used, first: %s", len(failed), len(views), failed[0]
        )
    if hidden:
        logger.warning("left out %d photographs whose mask leaves no pixel, first %s", len(hidden), hidden[0])
    if dark:
        logger.warning(
            "%d photographs are nearly black, first %s; 16-bit files whose values reach 1023 or 4095 only must be "
            "stretched first",
            *(len(dark), dark[0]),
        )
    masked = [float(photograph.mask.float().mean()) for photograph in photographs if photograph.mask is not None]
    masked += [0.0] * len(hidden)
    if masked and sum(masked) / len(masked) < 1 - MUCH_HIDDEN:
        logger.warning(
            "masks leave out %.0f %% of the pixels of %d photographs; if they mark what is to be left out, say "
            "--mask-hides white",
            *(100 * (1 - sum(masked) / len(masked)), len(masked)),
        )
    scaled = [view.camera for view in views if largest and max(view.camera.size) // downscale > largest]
    if scaled:
        logger.warning(
            "%d photographs are scaled down to %d pixels (the first is %d x %d); --max-size sets another limit",
            *(len(scaled), largest, scaled[0].width, scaled[0].height),
        )
    return photographs


def _size(camera: Camera, downscale: int, largest: int) -> tuple[int, int]:
    """(height, width) that a photograph is scaled down to."""
    height, width = (max(1, round(size / downscale)) for size in camera.size)
    factor = min(1.0, largest / max(height, width)) if largest else 1.0
    return max(1, round(factor * height)), max(1, round(factor * width))


def _read(view: View, size: tuple[int, int], masks: Masks | None, store: PixelStore) -> Photograph | None:
    """One photograph at a size, or None if its mask leaves nothing of it."""
    import cv2

    assert view.image_path is not None
    mask = None if masks is None else masks(view)
    if mask is not None:
        mask = np.asarray(mask) != 0
        if mask.shape != view.camera.size:
            got, want = list(mask.shape), list(view.camera.size)
            raise InputError(f"view {view.stem}: its mask has shape {got}, its photograph {want}; resize one of them")
    pixels: Any = view.pixels()
    alpha: Any = read_alpha(view.image_path)
    if alpha is not None and view.undistort is not None:
        alpha = view.undistort(np.repeat(alpha[..., None], 3, axis=2))[..., 0]
    camera = view.camera
    if size != camera.size:
        camera = camera.resized(*size)
        pixels = cv2.resize(pixels, size[::-1], interpolation=cv2.INTER_AREA)
        if mask is not None:
            mask = cv2.resize(mask.astype(np.float32), size[::-1], interpolation=cv2.INTER_AREA) > 0.5
        if alpha is not None:
            alpha = cv2.resize(alpha, size[::-1], interpolation=cv2.INTER_AREA)
    if mask is not None and not mask.any():
        return None
    known = None if mask is None else store.put(mask.astype(np.uint8))
    opaque = None if alpha is None else store.put(np.asarray(alpha, np.uint8))
    return Photograph(view.stem, camera, store.put(pixels), known, opaque, Path(view.image_path))


def require_enough(views: Sequence[View] | Sequence[Photograph]) -> None:
    """Raise InputError unless there are enough photographs to fit a scene to."""
    if len(views) < LEAST_VIEWS:
        names = f" ({', '.join(view.stem for view in views)})" if views else ""
        raise InputError(
            f"{len(views)} photographs are left to fit to{names}; a scene needs at least {LEAST_VIEWS}: add "
            "photographs, or hold out fewer"
        )


def require_overlap(photographs: Sequence[Photograph], means: Tensor, held_out: Sequence[Photograph] = ()) -> None:
    """Say how many photographs show none of the points [N, 3] that the scene starts from.

    That may be right: features are rarely found in the sky, on a blank wall or a ceiling.

    Raises:
        InputError: No photograph shows any.
    """
    for blind in (p for p in held_out if not bool(_shown(p.camera, means).any())):
        logger.warning("held-out view %s shows none of the points to start from: is its pose right?", blind.stem)
    blinds = [p for p in photographs if not bool(_shown(p.camera, means).any())]
    if not blinds:
        return
    first = blinds[0].path or blinds[0].stem
    if len(blinds) == len(photographs):
        raise InputError(
            f"{first}: shows none of the {len(means)} points that the scene starts from, nor does any other "
            "photograph; points and poses do not belong together: correct them, or start without points (--init random)"
        )
    logger.warning(
        "%d of %d photographs show none of the %d points to start from, first %s: right for sky or blank walls, else "
        "correct their poses",
        *(len(blinds), len(photographs), len(means), first),
    )


def _shown(camera: Camera, means: Tensor) -> Tensor:
    """Mask of the points inside the image, bool [N]."""
    pose = camera.world_to_camera.to(means)
    points = means @ pose[:3, :3].T + pose[:3, 3]
    pixels = points @ camera.K.to(means).T
    x, y = pixels[:, 0] / points[:, 2], pixels[:, 1] / points[:, 2]
    inside = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    return inside & (points[:, 2] > camera.near) & (points[:, 2] < camera.far)
