"""A pinhole camera."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

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
        require(bool(torch.isfinite(K).all()), "K: holds NaN or infinity")
        require(bool(torch.isfinite(pose).all()), "world_to_camera: holds NaN or infinity")
        bottom = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64, device="cpu")
        require(bool((K[2] == bottom).all()), f"K: last row must be [0, 0, 1], got {K[2].tolist()}")
        focal = f"fx = {K[0, 0].item():g}, fy = {K[1, 1].item():g}"
        require(bool((K.diagonal() > 0).all()), f"K: singular or mirrored ({focal}); focal lengths must be positive")
        require(bool(K[0, 1] == 0) and bool(K[1, 0] == 0), "K: skew is not supported; rectify the images first")
        R = pose[:3, :3]
        error = (R @ R.T - torch.eye(3, dtype=torch.float64, device="cpu")).abs().max().item()
        require(error < 1e-3, f"world_to_camera: not a rigid transform (R Rt differs from I by {error:.2g})")
        require(bool(torch.linalg.det(R) > 0), "world_to_camera: mirrors the world (determinant -1)")
        affine = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64, device="cpu")
        require(bool((pose[3] == affine).all()), "world_to_camera: last row must be [0, 0, 0, 1]")
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
