"""The frame a scene is fitted in: its cameras around the origin, their extent 1.

Rates, noise and penalties of the reference implementations are stated for scenes of about this size. Fitting in it
makes the unit and the origin of the capture irrelevant, and keeps single precision for where the cameras are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sgwarp.scene import Camera, Gaussians, View
from sgwarp.scene.extent import NEAR_SHARE, camera_extent, near_plane


@dataclass(frozen=True, eq=False)
class Frame:
    """A similarity: (x - origin) / scale.

    Attributes:
        origin: In world coordinates, float64 [3].
        scale: One unit of the frame [world units].
        near: Largest near plane, and that of cameras with the default one [units of the frame]; None to keep theirs.
    """

    origin: Tensor
    scale: float
    near: float | None

    @classmethod
    def around(cls, views: Sequence[View], positions: Any = None) -> Frame:
        """The frame of these cameras; if all are in one place, the distance of positions [N, 3] is its unit."""
        origin = torch.stack([view.camera.position for view in views]).mean(dim=0)
        scale, near = camera_extent(views), near_plane(views)
        if near is None and positions is not None:
            positions = positions if isinstance(positions, Tensor) else torch.from_numpy(np.asarray(positions))
            distances = (positions.detach().cpu().to(torch.float64).reshape(-1, 3) - origin).norm(dim=1)
            distances = distances[torch.isfinite(distances) & (distances > 0)]
            if len(distances):
                scale = float(distances.median())
                near = NEAR_SHARE * scale
        return cls(origin, scale, None if near is None else near / scale)

    def view(self, view: View) -> View:
        """A view from the world."""
        return replace(view, camera=self.camera(view.camera))

    def camera(self, camera: Camera) -> Camera:
        """A camera from the world."""
        pose = camera.world_to_camera.clone()
        pose[:3, 3] = (pose[:3, :3] @ self.origin + pose[:3, 3]) / self.scale
        near = camera.near / self.scale
        if self.near is not None:
            near = self.near if camera.near == Camera.near else min(near, self.near)
        return replace(camera, world_to_camera=pose, near=near, far=camera.far / min(self.scale, 1.0))

    def points(self, positions: Any) -> Tensor:
        """Positions from the world, float64 [N, 3]."""
        positions = positions if isinstance(positions, Tensor) else torch.from_numpy(np.asarray(positions))
        return (positions.detach().cpu().to(torch.float64) - self.origin) / self.scale

    def gaussians(self, gaussians: Gaussians) -> Gaussians:
        """A scene from the world."""
        means = (gaussians.means.to(torch.float64) - self.origin.to(gaussians.device)) / self.scale
        return replace(gaussians, means=means.to(torch.float32), scales=gaussians.scales / self.scale)

    def restored(self, gaussians: Gaussians) -> Gaussians:
        """A scene back into the world."""
        means = gaussians.means.to(torch.float64) * self.scale + self.origin.to(gaussians.device)
        return replace(gaussians, means=means.to(torch.float32), scales=gaussians.scales * self.scale)

    def with_pose(self, view: View, camera: Camera) -> View:
        """A view of the world with the pose of a camera of the frame."""
        pose = camera.world_to_camera.clone()
        pose[:3, 3] = pose[:3, 3] * self.scale - pose[:3, :3] @ self.origin
        return replace(view, camera=replace(view.camera, world_to_camera=pose))
