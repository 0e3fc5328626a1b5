"""Points that ride on Gaussians: where a point of one frame is in all others."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.io.sequences import GaussianSequence
from sgwarp.scene import Gaussians

MIN_NORM2 = 1e-6  # |q|^2 below which a quaternion has no direction


def carry_points(sequence: GaussianSequence, points: Tensor, frame: int = 0, frames: Sequence[int] = ()) -> Tensor:
    """Trajectories of points, as Dynamic3DGaussians tracks them: each rides on the Gaussian that covers it most.

    That is the one of largest opacity times exp(-d^2 / 2), d the Mahalanobis distance; where that is 0 for all of them,
    the one of smallest d. The point keeps its place in the axes of that Gaussian, which move and turn.

    Args:
        sequence: Gaussians that keep their identity by row.
        points: At `frame` [m], [K, 3].
        frame: Frame in which the points are given.
        frames: Frames of the trajectories; all if empty.

    Returns:
        float64 [frames, K, 3]; NaN where the Gaussian is not finite.

    Raises:
        InputError: The frame has no finite Gaussian, or a frame has another number of them.
    """
    start = sequence.frame(frame).gaussians
    owner = owners(start, points)
    local = _to_local(start, owner, points.double())
    rows = []
    for index in frames or range(len(sequence)):
        now = sequence.frame(index).gaussians
        if len(now) != len(start):
            raise InputError(
                f"frame {index}: has {len(now)} Gaussians, frame {frame} {len(start)}; points ride on rows"
            )
        R = rotations(now.quats[owner])
        rows.append(now.means[owner].double() + torch.einsum("kij,kj->ki", R, local))
    return torch.stack(rows)


def owners(gaussians: Gaussians, points: Tensor) -> Tensor:
    """Which Gaussian covers each point most, int64 [K].

    Raises:
        InputError: No Gaussian is finite, or a point is not.
    """
    if points.ndim != 2 or points.shape[1] != 3 or not bool(torch.isfinite(points).all()):
        raise InputError(f"points: expected finite values of shape [K, 3], got {list(points.shape)}")
    finite = gaussians.finite & (gaussians.quats.square().sum(dim=1) >= MIN_NORM2)
    rows = finite.nonzero().flatten()
    if not len(rows):
        raise InputError("points: the frame has no finite Gaussian to ride on")
    R = rotations(gaussians.quats[rows])
    scales = gaussians.scales[rows].double().clamp(min=1e-12)
    means, opacities = gaussians.means[rows].double(), gaussians.opacities[rows].double()
    chosen = []
    for point in points.double():
        local = torch.einsum("nij,ni->nj", R, point - means) / scales
        distance2 = local.square().sum(dim=1)
        cover = opacities * torch.exp(-0.5 * distance2)
        best = cover.argmax() if bool((cover > 0).any()) else distance2.argmin()
        chosen.append(rows[best])
    return torch.stack(chosen) if chosen else rows[:0]


def _to_local(gaussians: Gaussians, owner: Tensor, points: Tensor) -> Tensor:
    R = rotations(gaussians.quats[owner])
    return torch.einsum("kij,ki->kj", R, points - gaussians.means[owner].double())


def rotations(quats: Tensor) -> Tensor:
    """Rotation matrices of (w, x, y, z), which need not be normalized, float64 [K, 3, 3]."""
    w, x, y, z = torch.nn.functional.normalize(quats.double(), dim=1).unbind(1)
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(rows, dim=1).view(-1, 3, 3)
