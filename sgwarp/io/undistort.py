"""From the photograph a lens took to the image a pinhole camera would have taken (OpenCV's distortion models)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sgwarp.errors import InputError
from sgwarp.scene import Camera, View
from sgwarp.scene.camera import MOST_PIXELS

ZOOM_RANGE = (0.5, 4.0)
EDGE = 1e-6  # [pixels]
# OpenCV counts pixel centres from 0, cameras here have them at .5.
PRINCIPAL_SHIFT = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])


@dataclass(frozen=True)
class Lens:
    """Intrinsics of a photograph as stored.

    Attributes:
        fx, fy: Focal lengths [pixels].
        cx, cy: Principal point [pixels], pixel centres at .5.
        width, height: Size of the photograph [pixels].
        distortion: OpenCV's coefficients: (k1, k2, p1, p2[, k3[, k4, k5, k6]]), or (k1, k2, k3, k4) of a fisheye.
        fisheye: The equidistant model of cv2.fisheye; without coefficients r = f theta, which is not a pinhole either.

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
    fisheye: bool = False

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
        return self.fisheye or any(self.distortion)

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
    """Callable that turns the stored photograph into the pinhole image of the same size.

    Attributes:
        lens: What the photograph was taken with.
        path: The photograph, for messages.
    """

    lens: Lens
    path: Path

    def __call__(self, pixels: NDArray[Any], nearest: bool = False) -> NDArray[Any]:
        """Resample [H, W] or [H, W, C]; `nearest` for ids of any type, which must not be mixed.

        Raises:
            InputError: The array has not the size the lens is given for.
        """
        import cv2

        if pixels.shape[:2] != (self.lens.height, self.lens.width):
            raise InputError(
                f"{self.path}: image is {pixels.shape[1]} x {pixels.shape[0]}, its camera says {self.lens.width} x "
                f"{self.lens.height}; resize one of them"
            )
        map_x, map_y = _sampling_positions(self.lens)
        if nearest:
            rows = np.rint(map_y).astype(np.intp).clip(0, self.lens.height - 1)
            return pixels[rows, np.rint(map_x).astype(np.intp).clip(0, self.lens.width - 1)]
        return cv2.remap(pixels, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


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
        kind = "fisheye " if lens.fisheye else ""
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
    import cv2

    K, zero = _zoomed(lens, zoom), np.zeros(3)
    size = np.array([lens.width, lens.height])
    grid = np.stack(np.meshgrid(*np.linspace((0.0, 0.0), size, 33).T), axis=2)
    rays = np.concatenate([(grid - K[:2, 2]) / K.diagonal()[:2], np.ones((33, 33, 1))], axis=2).reshape(-1, 1, 3)
    project = cv2.fisheye.projectPoints if lens.fisheye else cv2.projectPoints
    seen = np.asarray(project(rays, zero, zero, lens.K, _coefficients(lens))[0], dtype=np.float64).reshape(33, 33, 2)
    across, down = np.diff(seen, axis=1)[:32], np.diff(seen, axis=0)[:, :32]
    folds = across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0] <= 0
    return bool(((seen >= -EDGE) & (seen <= size + EDGE)).all()) and not bool(folds.any())


@lru_cache(maxsize=2)  # 8 bytes a pixel each; the views of one camera come one after the other
def _sampling_positions(lens: Lens) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Position of each pinhole pixel in the distorted image, OpenCV pixel coordinates, two float32 [H, W]."""
    import cv2

    build = cv2.fisheye.initUndistortRectifyMap if lens.fisheye else cv2.initUndistortRectifyMap
    old, new = lens.K - PRINCIPAL_SHIFT, pinhole_matrix(lens) - PRINCIPAL_SHIFT
    map_x, map_y = build(old, _coefficients(lens), np.eye(3), new, (lens.width, lens.height), cv2.CV_32FC1)
    return np.asarray(map_x, np.float32), np.asarray(map_y, np.float32)


def _coefficients(lens: Lens) -> NDArray[np.float64]:
    """OpenCV takes 4, 5, 8 or more."""
    return np.array(lens.distortion + (0.0,) * max(4 - len(lens.distortion), 0))


def pinhole_view(
    where: str, stem: str, lens: Lens, world_to_camera: NDArray[np.float64], image_path: Path | None
) -> View:
    """The view through the pinhole camera that stands in for `lens`.

    Args:
        where: File and frame, put before the message of an error.
        stem: Name of the view.
        lens: What the photograph was taken with.
        world_to_camera: OpenCV axes, float64 [4, 4].
        image_path: The photograph, or None.

    Raises:
        InputError: The lens has no pinhole stand-in, or the pose is not rigid.
    """
    try:
        K = torch.from_numpy(pinhole_matrix(lens).copy())
        camera = Camera(K, torch.from_numpy(world_to_camera), lens.width, lens.height)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    undistort = Undistortion(lens, image_path) if image_path is not None and lens.distorted else None
    return View(stem, camera, image_path, undistort)
