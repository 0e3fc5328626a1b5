"""Distances between neighbouring points: how large a Gaussian at each point should start."""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.kernels.points import neighbors
from sgwarp.ops.arguments import view
from sgwarp.ops.launcher import launch

FAN = neighbors.FAN  # points in a box, boxes in a larger one
CURVE_BITS = 20  # per axis of the space-filling curve


def mean_squared_neighbor_distance(points: Tensor) -> Tensor:
    """Mean of the squared distances from each point to its three nearest others, exact, duplicates included.

    Args:
        points: [m], floating point [N, 3], N >= 4.

    Returns:
        [m^2], float32 [N].

    Raises:
        InputError: Another shape or type, fewer than 4 points, or a point that is not finite.
    """
    if points.ndim != 2 or points.shape[1] != 3 or not points.is_floating_point():
        raise InputError(f"points: expected floating point [N, 3], got {points.dtype} {list(points.shape)}")
    if len(points) < 4:
        raise InputError(f"points: three neighbours need at least 4 points, got {len(points)}")
    points = points.detach()
    finite = torch.isfinite(points).all(dim=1)
    if not bool(finite.all()):
        index = int((~finite).nonzero()[0])
        raise InputError(f"points[{index}] = {points[index].tolist()}: not finite; remove such points first")
    shifted = (points.to(torch.float64) - points.amin(dim=0)).to(torch.float32)
    order = _curve_keys(shifted).argsort()
    # Shifting float64 points keeps their digits; float32 points lose some, while their differences are exact.
    points = (shifted if points.dtype == torch.float64 else points.to(torch.float32))[order].contiguous()
    corners = _boxes(points, points)
    large = _boxes(*corners)
    distances = torch.empty_like(points)
    inputs = [view(t, wp.vec3) for t in (points, *corners, *large, *_boxes(*large))]
    launch(neighbors.nearest_three, len(points), inputs, [view(distances, wp.vec3)], device=points.device)
    return torch.empty_like(distances[:, 0]).index_copy_(0, order, distances.mean(dim=1))


def _curve_keys(points: Tensor) -> Tensor:
    """Place of each point along a Morton curve: the bits of its three coordinates interleaved, int64 [N]."""
    size = points.amax(dim=0).clamp(min=1e-30)
    cells = (points / size * (2**CURVE_BITS - 1)).to(torch.int64)
    keys = torch.zeros_like(cells[:, 0])
    spread = (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    )
    for axis in range(3):
        bits = cells[:, axis]
        for shift, mask in spread:
            bits = (bits | (bits << shift)) & mask
        keys |= bits << axis
    return keys


def _boxes(low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Corners of the boxes around each run of FAN boxes, [ceil(n / FAN), 3] each."""
    short = -len(low) % FAN
    low = torch.cat([low, low[-1:].expand(short, 3)]).view(-1, FAN, 3)
    high = torch.cat([high, high[-1:].expand(short, 3)]).view(-1, FAN, 3)
    return low.amin(dim=1).contiguous(), high.amax(dim=1).contiguous()
