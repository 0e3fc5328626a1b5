"""Masks and depth of photographs, from files: found by the photographs' names, turned and undistorted like them."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sgwarp.errors import InputError
from sgwarp.files.arrays import read_array
from sgwarp.files.images import read_alpha, read_ids, read_rgb, read_values
from sgwarp.io.companions import PICTURES, Companions
from sgwarp.io.undistort import same_shape
from sgwarp.scene import View

logger = logging.getLogger("sgwarp")
OfView = Callable[[View], Any]

MILLIMETER = 1e-3  # [m], the unit of depth images
WHITE = 128  # from which on a pixel of a lossy mask counts
MOVING = "dynamic_mask_"  # before the names of instant-ngp's masks, in which white is left out
MASK_BEGINNINGS = ("", "mask_", MOVING)
MASK_ENDINGS = tuple(f"{word}{suffix}" for word in ("", "_mask", ".mask", "-mask") for suffix in (*PICTURES, ".npy"))
DEPTH_BEGINNINGS = ("", "depth_")
DEPTH_ENDINGS = tuple(f"{word}{suffix}" for word in ("", "_depth") for suffix in (".npy", ".png", ".tif", ".tiff"))
UNREAD_DEPTH = (".exr", ".pfm", ".npz", ".hdr", ".raw", ".bin", ".dpt", ".jpg", ".jpeg")
JPEG = (".jpg", ".jpeg")


def masks_from_folder(folder: Path, views: Sequence[View], hides: str = "black") -> OfView:
    """Masks of views; black is left out, and a view without a mask counts as a whole.

    Files are found as `Companions` says: {stem}.png, folders that mirror the photographs', COLMAP's double endings.

    Args:
        folder: Of the masks.
        views: All of them.
        hides: "white" for masks in which white is left out; of those named dynamic_mask_{stem}.png it always is.

    Returns:
        A function of a view: bool [H, W] of its camera, or None.

    Raises:
        InputError: No view has a mask there.
    """
    companions = Companions(folder, views)
    paths = {}
    for view in views:
        if found := companions.find(view, MASK_ENDINGS, MASK_BEGINNINGS):
            paths[view.stem] = found[0]
    missing = [view.stem for view in views if view.stem not in paths]
    if not paths:
        raise InputError(f"{folder}: holds no mask of any view; expected files such as {views[0].stem}.png")
    if missing:
        logger.warning("%s: %d of %d views have no mask (%s, ...)", folder, len(missing), len(views), missing[0])
    inverted = {stem for stem, path in paths.items() if hides == "white" or path.name.lower().startswith(MOVING)}
    if inverted and hides != "white":
        logger.warning("%s: in %d masks named %s* white is what is left out", folder, len(inverted), MOVING)

    def mask(view: View) -> Any:
        if view.stem not in paths:
            return None
        known = _read_mask(paths[view.stem], view)
        return ~known if view.stem in inverted else known

    return mask


def masks_of_views(views: Sequence[View]) -> OfView | None:
    """Masks that the data set itself names (`mask_path`), with a logged notice; None if it names none."""
    named = [view for view in views if view.mask_path is not None]
    if not named:
        return None
    logger.warning(
        "%d of %d photographs come with a mask (mask_path), which is used; --masks none ignores them",
        *(len(named), len(views)),
    )
    return lambda view: None if view.mask_path is None else _read_mask(view.mask_path, view)


def depth_from_folder(folder: Path, views: Sequence[View] | None = None) -> OfView:
    """Depth of views [m], [H, W], 0 where there is none: {stem}.npy in meters or {stem}.png in millimeters.

    What is returned raises InputError if a view has neither, or it cannot be read.
    """
    companions = Companions(folder, views or [])

    def depth(view: View) -> Any:
        found = companions.find(view, DEPTH_ENDINGS, DEPTH_BEGINNINGS)
        if not found and (other := next((p for p in companions.paths if p.suffix.lower() in UNREAD_DEPTH), None)):
            raise InputError(
                f"{other}: depth is read from .npy (meters), .png (millimeters) and .tif, not from {other.suffix}; "
                "convert it"
            )
        return _read_depth(found[0] if found else folder / f"{view.stem}.png", view, MILLIMETER)

    return depth


def depth_of_views(views: Sequence[View]) -> OfView | None:
    """Depth that the data set itself names (`depth_file_path`); None if it names none.

    What is returned raises InputError for a view without depth.
    """
    if all(view.depth_path is None for view in views):
        return None

    def depth(view: View) -> Any:
        if view.depth_path is None:
            raise InputError(f"view {view.stem}: the data set names no depth of it")
        return _read_depth(view.depth_path, view, view.depth_unit)

    return depth


def onto_view(path: Path, array: NDArray[Any], view: View) -> NDArray[Any]:
    """What belongs to a photograph, [h, w], at the size of the view's camera; no values are mixed.

    Raises:
        InputError: It does not have the shape of the photograph.
    """
    try:
        carried: NDArray[Any] = np.asarray(view.carry(array))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    (h, w), (height, width) = carried.shape[:2], view.camera.size
    if (h, w) == (height, width):
        return carried
    if not same_shape((h, w), (height, width)):
        raise InputError(f"{path}: is {w} x {h}, its photograph {width} x {height}; resize one of them")
    rows, columns = (np.arange(height) * h // height, np.arange(width) * w // width)
    return carried[rows[:, None], columns]


def _read_mask(path: Path, view: View) -> NDArray[np.bool_]:
    if path.suffix.lower() == ".npy":
        array = read_array(path)
        if array.ndim != 2:
            raise InputError(f"{path}: expected a mask [H, W], got {array.dtype} {list(array.shape)}")
        known = array != 0
    elif path.suffix.lower() in JPEG:  # whose black is not quite black
        known = read_rgb(path).max(axis=2) >= WHITE
    elif (alpha := read_alpha(path)) is not None:
        known = alpha != 0
    else:
        known = read_ids(path) != 0
    return onto_view(path, known, view)


def _read_depth(path: Path, view: View, unit: float) -> NDArray[np.float32]:
    if path.suffix.lower() in (".tif", ".tiff"):
        depth = read_values(path)
    elif path.suffix.lower() != ".npy":
        return onto_view(path, read_ids(path).astype(np.float32) * np.float32(unit), view)
    else:
        depth = read_array(path)
    if depth.ndim == 3 and 1 in (depth.shape[0], depth.shape[2]):
        depth = depth[..., 0] if depth.shape[2] == 1 else depth[0]
    if depth.ndim != 2 or depth.dtype.kind not in "fiu":
        raise InputError(f"{path}: expected depth [H, W], got {depth.dtype} {list(depth.shape)}")
    scale = unit if depth.dtype.kind in "iu" else 1.0
    return onto_view(path, depth.astype(np.float32) * np.float32(scale), view)
