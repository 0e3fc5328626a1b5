"""The oracle of sparse convolutions: the same on a dense grid, by torch's own conv3d and conv_transpose3d.

Any floating point type, meant for float64; gradients go through. Memory grows with the bounding box of the voxels.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F


def _densify(coordinates: Tensor, features: Tensor, low: Tensor, size: list[int]) -> Tensor:
    """[batches, C, X, Y, Z] with zeros where there is no voxel."""
    b, x, y, z = (coordinates - torch.cat([low.new_zeros(1), low])).unbind(1)
    dense = features.new_zeros(size[0], *size[1:], features.shape[1])
    return dense.index_put((b, x, y, z), features).permute(0, 4, 1, 2, 3)


def _read(dense: Tensor, coordinates: Tensor) -> Tensor:
    b, x, y, z = coordinates.unbind(1)
    return dense[b, :, x, y, z]


def convolve(features: Tensor, weight: Tensor, sources: Tensor, targets: Tensor, side: int, step: int = 1) -> Tensor:
    """Convolution evaluated everywhere and read at the targets, [M, C_out].

    Args:
        features: [N, C_in].
        weight: [K^3, C_in, C_out], offset k = ix + K iy + K^2 iz.
        sources: (batch, x, y, z) of the features, unique integers [N, 4].
        targets: Where the result is read, [M, 4].
        side: K.
        step: Between neighbouring offsets [voxels].
    """
    before = (side // 2) * step if side % 2 else 0
    after = (side - 1) * step - before
    both = torch.cat([sources, targets])
    low, high = both[:, 1:].amin(dim=0), both[:, 1:].amax(dim=0)
    size = [int(both[:, 0].max()) + 1, *(high - low + 1).tolist()]
    dense = F.pad(_densify(sources, features, low, size), (before, after) * 3)
    kernel = weight.view(side, side, side, *weight.shape[1:]).permute(4, 3, 2, 1, 0)
    y = F.conv3d(dense, kernel, dilation=step)
    return _read(y, targets - torch.cat([low.new_zeros(1), low]))


def convolve_transposed(
    features: Tensor, weight: Tensor, sources: Tensor, targets: Tensor, side: int, stride: int
) -> Tensor:
    """Transposed convolution with an even kernel, from voxels at multiples of `stride` to `targets`, [M, C_out].

    Args:
        features: [N, C_in].
        weight: [K^3, C_in, C_out], offset k = ix + K iy + K^2 iz.
        sources: (batch, x, y, z) of the features, x, y, z multiples of `stride`, unique integers [N, 4].
        targets: Where the result is read, [M, 4]; each within the reach of the grid of sources.
        side: K, even.
        stride: Between neighbouring coarse voxels [voxels].
    """
    coarse = sources.clone()
    coarse[:, 1:] //= stride
    low, high = coarse[:, 1:].amin(dim=0), coarse[:, 1:].amax(dim=0)
    size = [int(coarse[:, 0].max()) + 1, *(high - low + 1).tolist()]
    kernel = weight.view(side, side, side, *weight.shape[1:]).permute(3, 4, 2, 1, 0)
    y = F.conv_transpose3d(_densify(coarse, features, low, size), kernel, stride=stride)
    return _read(y, targets - torch.cat([low.new_zeros(1), low * stride]))
