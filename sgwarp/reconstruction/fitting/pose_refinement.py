"""Refinement of the camera poses, fitted along with the scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from sgwarp.reconstruction.fitting.per_photograph import PerPhotograph
from sgwarp.scene import Camera

RATE, LAST_RATE = 1e-3, 1e-5  # [radians, and extents of the cameras]


class PoseRefinement(PerPhotograph):
    """A small rigid motion of every camera: a rotation vector and a displacement of its center, in world axes.

    What all cameras share would only move the scene, away from held-out views; the mean motion is held at zero.
    """

    def __init__(self, given: Sequence[Camera], device: torch.device) -> None:
        self.given = list(given)
        poses = torch.stack([camera.world_to_camera for camera in given]).to(device)
        self._rotations = poses[:, :3, :3]
        self._centers = -torch.einsum("nji,nj->ni", self._rotations, poses[:, :3, 3])
        super().__init__(torch.zeros(len(given), 6, device=device), RATE, LAST_RATE)

    def leaf(self, index: int) -> Tensor:
        """The motion of one camera, [6], to take a gradient of."""
        motions = self.group.parameters
        return (motions[index] - motions.mean(dim=0)).requires_grad_()

    def world_to_camera(self, index: int, motion: Tensor | None = None) -> Tensor:
        """The moved camera, float64 [4, 4]; differentiable in the motion, which is today's if None."""
        motion = (self.leaf(index).detach() if motion is None else motion).to(torch.float64)
        rotation = self._rotations[index] @ torch.linalg.matrix_exp(-_cross(motion[:3]))
        translation = -rotation @ (self._centers[index] + motion[3:])
        bottom = rotation.new_tensor([[0.0, 0.0, 0.0, 1.0]])
        return torch.cat([torch.cat([rotation, translation[:, None]], dim=1), bottom])

    def cameras(self) -> list[Camera]:
        """All cameras as they are now."""
        return [replace(given, world_to_camera=self.world_to_camera(i)) for i, given in enumerate(self.given)]


def _cross(vector: Tensor) -> Tensor:
    """The matrix of the cross product with a vector, [3, 3]."""
    x, y, z = vector
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
