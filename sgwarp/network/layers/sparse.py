"""Sparse voxel tensors and the layers of a U-Net on them.

Parameters bear the names that MinkowskiEngine gives them, so that its checkpoints load: `kernel` of convolutions,
[K^3, C_in, C_out] or [C_in, C_out] for K = 1, and `bn` within a batch normalisation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor, nn

from sgwarp.errors import InputError
from sgwarp.ops.sparse.blocks import MAX_OFFSETS, TYPES, Running
from sgwarp.ops.sparse.convolution import sparse_conv
from sgwarp.ops.sparse.normalization import Normalization, convolve_and_normalize
from sgwarp.ops.sparse.voxels import KernelMap, coarsen, kernel_map, unpack_voxels


@dataclass(eq=False)
class Grid:
    """The voxels of a batch at every stride, and the kernel maps between them, each made once.

    Attributes:
        levels: Sorted unique keys at each stride that was asked for, int64; stride 1 from the start.
    """

    levels: dict[int, Tensor]
    _maps: dict[tuple[int, int, int, int], KernelMap] = field(default_factory=dict, repr=False)

    def keys(self, stride: int) -> Tensor:
        """Keys of the voxels at a stride, a power of two."""
        if stride not in self.levels:
            finer = max(s for s in self.levels if s < stride)
            self.levels[stride] = coarsen(self.levels[finer], stride)
        return self.levels[stride]

    def map(self, side: int, stride: int, coarser: int = 1, dilation: int = 1) -> KernelMap:
        """Map of a kernel from the voxels at `stride` to those at `stride * coarser`."""
        name = (side, stride, coarser, dilation)
        if name not in self._maps:
            sources, targets = self.keys(stride), self.keys(stride * coarser)
            self._maps[name] = kernel_map(sources, targets, side, stride * dilation)
        return self._maps[name]


@dataclass(frozen=True, eq=False)
class SparseTensor:
    """Features of voxels.

    Attributes:
        features: One row per voxel in the order of the grid's keys, [N, C].
        grid: The voxels, and the maps between them.
        stride: Which of the grid's levels the rows belong to [voxels].
    """

    features: Tensor
    grid: Grid
    stride: int = 1

    @property
    def coordinates(self) -> Tensor:
        """(batch, x, y, z) of every row, int64 [N, 4]; multiples of the stride."""
        return unpack_voxels(self.grid.keys(self.stride))

    def with_features(self, features: Tensor) -> SparseTensor:
        """Other features of the same voxels."""
        return replace(self, features=features)


def pool(keys: Tensor, features: Tensor) -> tuple[SparseTensor, Tensor]:
    """Voxels from points: the mean of the features of the points in each.

    Args:
        keys: Voxel of every point, int64 [P], as `pack_voxels` and `key_points` make them; in any order, repeated.
        features: [P, C].

    Returns:
        The voxels, and the row of every point among them, int64 [P]: `tensor.features[rows]` goes back to the points.

    Raises:
        InputError: Keys and features differ in number, or a key belongs to no voxel.
    """
    if keys.shape != features.shape[:1] or features.ndim != 2:
        raise InputError(f"expected keys [P] and features [P, C], got {list(keys.shape)} and {list(features.shape)}")
    if len(keys) and int(keys.min()) < 0:
        raise InputError("keys: a point without voxel (not finite, or out of range) is among them; leave it out first")
    unique, rows, counts = torch.unique(keys, return_inverse=True, return_counts=True)
    wide = features.to(torch.promote_types(features.dtype, torch.float32))  # a sum may leave the range of float16
    sums = wide.new_zeros(len(unique), features.shape[1]).index_add(0, rows, wide)
    return SparseTensor((sums / counts.to(wide)[:, None]).to(features.dtype), Grid({1: unique})), rows


class Conv(nn.Module):
    """Convolution; with stride 2 onto the voxels of the next coarser level.

    Args:
        in_channels, out_channels: C_in and C_out.
        side: K of the K^3 kernel.
        stride: 1, or a power of two.
        dilation: Between neighbouring offsets of the kernel [voxels of the level].
    """

    def __init__(self, in_channels: int, out_channels: int, side: int = 3, stride: int = 1, dilation: int = 1) -> None:
        super().__init__()
        self.side, self.stride, self.dilation = side, stride, dilation
        self.kernel = nn.Parameter(torch.empty(side**3, in_channels, out_channels))
        nn.init.normal_(self.kernel, std=math.sqrt(2.0 / (out_channels * side**3)))  # He et al. 2015, fan out

    def connect(self, x: SparseTensor) -> tuple[KernelMap, int]:
        """Map from the voxels of x to those of the result, and their stride."""
        return x.grid.map(self.side, x.stride, self.stride, self.dilation), x.stride * self.stride

    @property
    def weight(self) -> Tensor:
        return self.kernel

    def forward(self, x: SparseTensor) -> SparseTensor:
        pairs, stride = self.connect(x)
        return SparseTensor(sparse_conv(x.features, self.kernel, pairs), x.grid, stride)


class ConvTranspose(nn.Module):
    """Transposed convolution from a coarse level onto the voxels of a finer one that is already in the grid."""

    def __init__(self, in_channels: int, out_channels: int, side: int = 2, stride: int = 2) -> None:
        super().__init__()
        self.side, self.stride = side, stride
        self.kernel = nn.Parameter(torch.empty(side**3, in_channels, out_channels))
        bound = 1.0 / math.sqrt(out_channels * side**3)
        nn.init.uniform_(self.kernel, -bound, bound)

    def connect(self, x: SparseTensor) -> tuple[KernelMap, int]:
        """Map from the voxels of x to those of the result, and their stride."""
        if x.stride % self.stride:
            raise InputError(f"voxels at stride {x.stride} cannot be refined by {self.stride}")
        finer = x.stride // self.stride
        return x.grid.map(self.side, finer, self.stride).swapped(), finer

    @property
    def weight(self) -> Tensor:
        return self.kernel

    def forward(self, x: SparseTensor) -> SparseTensor:
        pairs, stride = self.connect(x)
        return SparseTensor(sparse_conv(x.features, self.kernel, pairs), x.grid, stride)


class Linear(nn.Module):
    """The same linear map at every voxel, without bias: a convolution of side 1."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.kernel = nn.Parameter(torch.empty(in_channels, out_channels))
        nn.init.normal_(self.kernel, std=math.sqrt(2.0 / out_channels))

    def connect(self, x: SparseTensor) -> tuple[KernelMap, int]:
        """Map from every voxel to itself, and the stride."""
        return x.grid.map(1, x.stride), x.stride

    @property
    def weight(self) -> Tensor:
        return self.kernel[None]

    def forward(self, x: SparseTensor) -> SparseTensor:
        return x.with_features(x.features @ self.kernel)


class BatchNorm(nn.Module):
    """Batch normalisation over all voxels; with fewer than two, which have no variance, by the running statistics.

    The network counts the batches, for all its layers at once.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.bn = nn.BatchNorm1d(channels)

    def learns(self, rows: int) -> bool:
        """Whether so many rows are normalised by their own statistics."""
        return self.training and rows > 1

    def forward(self, x: SparseTensor) -> SparseTensor:
        bn = self.bn
        assert bn.momentum is not None
        learns = self.learns(len(x.features))
        y = nn.functional.batch_norm(
            x.features, bn.running_mean, bn.running_var, bn.weight, bn.bias, learns, bn.momentum, bn.eps
        )
        return x.with_features(y)

    def as_rows(self, rows: int, rectified: bool) -> Normalization:
        """The same for the kernels, of so many rows."""
        bn = self.bn
        assert bn.momentum is not None
        assert bn.running_mean is not None
        assert bn.running_var is not None
        running = Running(bn.running_mean, bn.running_var, bn.eps, bn.momentum)
        return Normalization(bn.weight, bn.bias, running, self.learns(rows), rectified)


def normalized(
    conv: Conv | ConvTranspose | Linear,
    norm: BatchNorm,
    x: SparseTensor,
    *,
    shortcut: SparseTensor | None = None,
    rectify: bool = True,
    beside: SparseTensor | None = None,
) -> tuple[SparseTensor, SparseTensor]:
    """norm(conv(x)) + shortcut, what is negative becoming zero, joined with `beside`; and x, to go on with.

    On CUDA in single and half precision kernels do it all, and call neither module nor its hooks; elsewhere the modules
    do it one after the other. Going on with the x that comes back spares its gradient an addition there.
    """
    dtype = _fused_dtype(x, conv.kernel, norm)
    if dtype is not None:
        pairs, stride = conv.connect(x)
        if pairs.offsets <= MAX_OFFSETS:
            z, through = convolve_and_normalize(
                x.features.to(dtype),
                conv.weight,
                pairs,
                norm.as_rows(pairs.target_count, rectify),
                None if shortcut is None else shortcut.features.to(dtype),
                None if beside is None else beside.features.to(dtype),
            )
            return SparseTensor(z, x.grid, stride), x.with_features(through)
    y: SparseTensor = norm(conv(x))
    if shortcut is not None:
        y = y.with_features(y.features + shortcut.features)
    if rectify:
        y = relu(y)
    return y if beside is None else join(y, beside), x


def _fused_dtype(x: SparseTensor, kernel: Tensor, norm: BatchNorm) -> torch.dtype | None:
    """Precision of the features in which kernels take the whole layer, None where they do not."""
    tensors = (kernel, norm.bn.weight, norm.bn.bias, norm.bn.running_mean, norm.bn.running_var)
    dtype = x.features.dtype
    if not x.features.is_cuda:
        return None
    if torch.is_autocast_enabled("cuda") and dtype != torch.float64:
        dtype = torch.get_autocast_dtype("cuda")
    parameters = {None if tensor is None else tensor.dtype for tensor in tensors}
    return dtype if dtype in TYPES and parameters in ({torch.float32}, {dtype}) else None


def relu(x: SparseTensor) -> SparseTensor:
    """max(0, x)."""
    return x.with_features(torch.relu(x.features))


def join(x: SparseTensor, y: SparseTensor) -> SparseTensor:
    """Channels of x, then those of y, of the same voxels."""
    return x.with_features(torch.cat([x.features, y.features], dim=1))
