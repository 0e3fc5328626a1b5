"""From the photograph a lens took to the image a pinhole camera would have taken."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sgwarp.errors import InputError
from sgwarp.files.exif import UPRIGHT, turn
from sgwarp.io.lens_models import LensModel, distort
from sgwarp.scene import Camera, View
from sgwarp.scene.camera import MOST_PIXELS

ZOOM_RANGE = (0.5, 4.0)
EDGE = 1e-6  # [pixels]
LEAST_FOCAL = 0.05  # of a perspective lens [sizes of the image]
ROWS = 256  # of an image, for which sampling positions are found at a time


@dataclass(frozen=True)
class Lens:
    """Intrinsics of a photograph as stored.

    Attributes:
        fx, fy: Focal lengths [pixels].
        cx, cy: Principal point [pixels], pixel centres at .5.
        width, height: Size of the photograph [pixels].
        distortion: Coefficients in the order of the model; OpenCV's of a perspective lens are k1, k2, p1, p2, k3 to k6.
        model: See `sgwarp.io.lens_models`.

    Raises:
        InputError: A focal length or the size is not positive, or a number not finite.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: tuple[float, ...] = ()
    model: LensModel = "perspective"

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, (self.fx, self.fy, self.cx, self.cy, *self.distortion))):
            raise InputError("K: holds NaN or infinity")
        if self.fx <= 0 or self.fy <= 0:
            raise InputError(
                f"K: singular or mirrored (fx = {self.fx:g}, fy = {self.fy:g}); focal lengths must be positive"
            )
        if self.width <= 0 or self.height <= 0:
            raise InputError(f"image size must be positive, got {self.width} x {self.height}")
        if self.width * self.height > MOST_PIXELS:
            raise InputError(f"image size: {self.width} x {self.height} is more than {MOST_PIXELS} pixels")

    @property
    def distorted(self) -> bool:
        return self.model != "perspective" or any(self.distortion)

    @property
    def K(self) -> NDArray[np.float64]:
        """Intrinsics without the distortion, float64 [3, 3]."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def resized(self, width: int, height: int) -> Lens:
        """The same lens with the photograph scaled to another size; distortion coefficients do not change."""
        u, v = width / self.width, height / self.height
        return replace(self, fx=self.fx * u, cx=self.cx * u, fy=self.fy * v, cy=self.cy * v, width=width, height=height)


@dataclass(frozen=True)
class Undistortion:
    """Callable that turns the stored photograph into the pinhole image.

    Attributes:
        lens: What the upright photograph was taken with.
        path: The photograph, for messages.
        orientation: How the stored photograph lies, as EXIF counts it; 1 is upright.
    """

    lens: Lens
    path: Path
    orientation: int = UPRIGHT

    def __call__(self, pixels: NDArray[Any], nearest: bool = False) -> NDArray[Any]:
        """Resample [H, W] or [H, W, C]; `nearest` for ids of any type, which must not be mixed.

        Raises:
            InputError: The array has not the size the lens is given for.
        """
        pixels = turn(pixels, self.orientation)
        if pixels.shape[:2] != (self.lens.height, self.lens.width):
            raise InputError(
                f"{self.path}: image is {pixels.shape[1]} x {pixels.shape[0]}, its camera says {self.lens.width} x "
                f"{self.lens.height}; resize one of them"
            )
        return self._straight(pixels, nearest)

    def carry(self, array: NDArray[Any], nearest: bool = True) -> NDArray[Any]:
        """Do the same to what belongs to the photograph, at its own resolution.

        A raster that fits only the upright photograph is taken to be upright.

        Raises:
            InputError: The array does not have the shape of the photograph.
        """
        lying = self.orientation >= 5
        stored = (self.lens.width, self.lens.height) if lying else (self.lens.height, self.lens.width)
        if same_shape(array.shape[:2], stored):
            array = turn(array, self.orientation)
        elif not same_shape(array.shape[:2], stored[::-1]) or not lying:
            raise InputError(
                f"{self.path}: is {stored[1]} x {stored[0]}, what belongs to it {array.shape[1]} x {array.shape[0]}; "
                "resize one of them"
            )
        return self._straight(array, nearest)

    def _straight(self, array: NDArray[Any], nearest: bool) -> NDArray[Any]:
        import cv2

        if not self.lens.distorted:
            return array
        height, width = array.shape[:2]
        map_x, map_y = _sampling_positions(self.lens, width, height)
        if nearest:
            rows = np.rint(map_y).astype(np.intp).clip(0, height - 1)
            return array[rows, np.rint(map_x).astype(np.intp).clip(0, width - 1)]
        if array.ndim == 3 and array.shape[2] > 4:  # more than OpenCV remaps at once
            parts = [array[:, :, start : start + 4] for start in range(0, array.shape[2], 4)]
            return np.concatenate([self._straight(np.ascontiguousarray(part), False) for part in parts], axis=2)
        straight = cv2.remap(array, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return straight.reshape(array.shape)  # OpenCV drops the axis of a single channel


def same_shape(small: Sequence[int], size: Sequence[int]) -> bool:
    """Whether a raster of `small` (h, w) covers one of `size` (h, w) with square cells, up to rounding."""
    (h, w), (height, width) = small[:2], size[:2]
    return abs(h - w * height / width) <= 1 or abs(w - h * width / height) <= 1


def _require_pixels(lens: Lens) -> None:
    """Refuse numbers that are shares of the image, which would otherwise pass for a camera of nearly 180 degrees.

    Raises:
        InputError: So it is.
    """
    size = f"an image of {lens.width} x {lens.height}"
    if min(lens.width, lens.height) > 2 and 0 < lens.cx <= 1 and 0 < lens.cy <= 1:
        raise InputError(
            f"principal point ({lens.cx:g}, {lens.cy:g}) of {size} is in shares of it; give cx and cy in pixels"
        )
    if lens.model == "perspective" and max(lens.fx / lens.width, lens.fy / lens.height) < LEAST_FOCAL:
        raise InputError(
            f"focal lengths {lens.fx:g}, {lens.fy:g} of {size} see more than 168 degrees; are they in pixels?"
        )


@lru_cache(maxsize=64)
def pinhole_matrix(lens: Lens) -> NDArray[np.float64]:
    """Intrinsics of the undistorted image, float64 [3, 3].

    The image keeps its size, its principal point and the shape of its pixels; the focal lengths are multiplied by
    the one factor between 1/2 and 4 that just keeps every pixel within the photograph. So nothing is black that was
    not (black borders would pass for a photograph of something black), and little of the photograph is lost.

    Raises:
        InputError: There is no such factor, because the coefficients fold the image.
    """
    if not lens.distorted:
        return lens.K
    low, high = ZOOM_RANGE
    if not _covers(lens, high):
        kind = "" if lens.model == "perspective" else lens.model.replace("_", " ") + " "
        raise InputError(
            f"{kind}distortion {list(lens.distortion)} folds the image and cannot be undistorted; correct them"
        )
    if _covers(lens, low):
        high = low
    while high - low > 1e-6:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if _covers(lens, middle) else (middle, high)
    return _zoomed(lens, high)


def _zoomed(lens: Lens, zoom: float) -> NDArray[np.float64]:
    return lens.K * np.array([[zoom, 1.0, 1.0], [1.0, zoom, 1.0], [1.0, 1.0, 1.0]])


def _covers(lens: Lens, zoom: float) -> bool:
    """Whether the zoomed pinhole image lies within the photograph and does not fold, checked on a 33 x 33 grid."""
    K = _zoomed(lens, zoom)
    size = np.array([lens.width, lens.height])
    grid = np.stack(np.meshgrid(*np.linspace((0.0, 0.0), size, 33).T), axis=2)
    seen = _seen_at(lens, K, grid[..., 0], grid[..., 1])
    across, down = np.diff(seen, axis=1)[:32], np.diff(seen, axis=0)[:, :32]
    with np.errstate(invalid="ignore", over="ignore"):
        folds = ~(across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0] > 0)
    return bool(((seen >= -EDGE) & (seen <= size + EDGE)).all()) and not bool(folds.any())


def _seen_at(lens: Lens, K: NDArray[np.float64], x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.float64]:
    """Where in the photograph the lens puts what a pinhole camera of intrinsics K sees at (x, y), [..., 2] [pixels]."""
    u, v = distort(lens.model, lens.distortion, (x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1])
    return np.stack([u * lens.fx + lens.cx, v * lens.fy + lens.cy], axis=-1)


@lru_cache(maxsize=2)  # 8 bytes a pixel each; the views of one camera come one after the other
def _sampling_positions(lens: Lens, width: int, height: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Where in a raster of the photograph each pixel of its pinhole image lies, two float32 [height, width].

    Positions are OpenCV's, which counts pixel centers from 0; cameras here have them at .5.
    """
    resized = lens.resized(width, height)
    scale = np.array([[width / lens.width], [height / lens.height], [1.0]])
    K = pinhole_matrix(lens) * scale
    found = np.empty((2, height, width), np.float32)
    x = np.arange(width) + 0.5
    for start in range(0, height, ROWS):
        y = np.arange(start, min(start + ROWS, height)) + 0.5
        seen = _seen_at(resized, K, *np.meshgrid(x, y)) - 0.5
        found[:, start : start + ROWS] = seen.transpose(2, 0, 1)
    return found[0], found[1]


@dataclass(frozen=True)
class Listed:
    """A photograph as a data set lists it.

    Attributes:
        name: With folders and ending.
        path: Its file, or None.
        orientation: How its file lies, as EXIF counts it, where that matters; else 1.
        mask_path, depth_path: Files that the data set names for it.
        depth_unit: What one step of that depth is [m].
    """

    name: str = ""
    path: Path | None = None
    orientation: int = UPRIGHT
    mask_path: Path | None = None
    depth_path: Path | None = None
    depth_unit: float = 1e-3


def pinhole_view(where: str, stem: str, lens: Lens, world_to_camera: NDArray[np.float64], listed: Listed) -> View:
    """The view through the pinhole camera that stands in for `lens`.

    Args:
        where: File and frame, put before the message of an error.
        stem: Name of the view.
        lens: What the upright photograph was taken with.
        world_to_camera: OpenCV axes, float64 [4, 4].
        listed: The photograph.

    Raises:
        InputError: The lens has no pinhole stand-in, or the pose is not rigid.
    """
    try:
        _require_pixels(lens)
        K = torch.from_numpy(pinhole_matrix(lens).copy())
        camera = Camera(K, torch.from_numpy(world_to_camera), lens.width, lens.height)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    undistort = None
    if listed.path is not None and (lens.distorted or listed.orientation != UPRIGHT):
        undistort = Undistortion(lens, listed.path, listed.orientation)
    belongings = {"mask_path": listed.mask_path, "depth_path": listed.depth_path, "depth_unit": listed.depth_unit}
    return View(stem, camera, listed.path, undistort, listed.name, **belongings)  # type: ignore[arg-type]
