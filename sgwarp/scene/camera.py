"""A pinhole camera."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import chain

import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.scene.checks import as_tensor, require

MOST_PIXELS = 2**31 - 1  # kernels count them with 32 bits


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera.

    Attributes:
        K: Intrinsics with the real principal point [pixels], float64 [3, 3].
        world_to_camera: Rigid transform, OpenCV axes, float64 [4, 4].
        width, height: Image size [pixels].
        near, far: Range of depth along the optical axis that is rendered [m].

    Raises:
        InputError: K is singular or not a pinhole matrix, the pose is not rigid, the size not positive.
    """

    K: Tensor
    world_to_camera: Tensor
    width: int
    height: int
    near: float = 0.01
    far: float = 1e10

    def __post_init__(self) -> None:
        put = object.__setattr__
        # Copies: a caller may go on using the tensors, a rendering's backward pass still needs the camera.
        K = as_tensor(self.K, torch.float64).detach().cpu().clone()
        pose = as_tensor(self.world_to_camera, torch.float64).detach().cpu().clone()
        require(K.shape == (3, 3), f"K: expected shape [3, 3], got {list(K.shape)}")
        require(pose.shape == (4, 4), f"world_to_camera: expected shape [4, 4], got {list(pose.shape)}")
        _check_intrinsics(K.tolist())
        _check_pose(pose.tolist())
        sizes = (self.width, self.height)
        require(not any(isinstance(n, bool) for n in sizes), f"image size: expected whole pixels, got {sizes}")
        whole = self.width == int(self.width) and self.height == int(self.height)
        require(whole, f"image size: expected whole pixels, got {self.width} x {self.height}")
        require(self.width > 0 and self.height > 0, f"image size must be positive, got {self.width} x {self.height}")
        few = self.width * self.height <= MOST_PIXELS
        require(few, f"image size: {self.width} x {self.height} is more than {MOST_PIXELS} pixels")
        require(0 < self.near < self.far, f"near: expected 0 < near < far, got {self.near} and {self.far}")
        put(self, "K", K)
        put(self, "world_to_camera", pose)
        put(self, "width", int(self.width))
        put(self, "height", int(self.height))

    @property
    def position(self) -> Tensor:
        """Camera centre in the world [m], float64 [3]."""
        return -self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3]

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) [pixels], as tensors are shaped."""
        return self.height, self.width

    def resized(self, height: int, width: int) -> Camera:
        """The same view at another resolution."""
        scale = self.K.new_tensor([[width / self.width], [height / self.height], [1.0]])
        return replace(self, K=self.K * scale, width=width, height=height)


# Plain numbers: in a training step every camera is new, and each operation on a small tensor costs some microseconds.


def _check_intrinsics(K: list[list[float]]) -> None:
    """Refuse what is no pinhole matrix.

    Raises:
        InputError: See `Camera`.
    """
    require(all(map(math.isfinite, chain(*K))), "K: holds NaN or infinity")
    if K[2] != [0.0, 0.0, 1.0]:
        raise InputError(f"K: last row must be [0, 0, 1], got {K[2]}")
    if not (K[0][0] > 0 and K[1][1] > 0):
        focal = f"fx = {K[0][0]:g}, fy = {K[1][1]:g}"
        raise InputError(f"K: singular or mirrored ({focal}); focal lengths must be positive")
    require(K[0][1] == 0 and K[1][0] == 0, "K: skew is not supported; rectify the images first")


def _check_pose(pose: list[list[float]]) -> None:
    """Refuse what is no rigid transform.

    Raises:
        InputError: See `Camera`.
    """
    require(all(map(math.isfinite, chain(*pose))), "world_to_camera: holds NaN or infinity")
    rows = [row[:3] for row in pose[:3]]
    x, y, z = rows
    error = max(abs(_dot(rows[i], rows[j]) - (i == j)) for i in range(3) for j in range(i, 3))
    if not error < 1e-3:
        raise InputError(f"world_to_camera: not a rigid transform (R Rt differs from I by {error:.2g})")
    normal = [x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]]
    require(_dot(normal, z) > 0, "world_to_camera: mirrors the world (determinant -1)")
    require(pose[3] == [0.0, 0.0, 0.0, 1.0], "world_to_camera: last row must be [0, 0, 0, 1]")


def _dot(u: list[float], v: list[float]) -> float:
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]
