"""Host side of the block schedule of sparse convolutions: one launch each, in single and half precision.

Features of half precision stay so in memory; all sums are float32. Weights may be float32: the kernels round them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor

from sgwarp.kernels.sparse import convolution_block as kernels
from sgwarp.kernels.sparse import products_block
from sgwarp.ops.arguments import view
from sgwarp.ops.launcher import launch_blocks
from sgwarp.ops.memory import counters, scratch
from sgwarp.ops.sparse.voxels import KernelMap

MAX_OFFSETS = kernels.MAX_OFFSETS
TYPES = {torch.float32: wp.float32, torch.float16: wp.float16, torch.bfloat16: wp.bfloat16}
BUSY_BLOCKS, MAX_SHARES = 1024, 16  # of a gradient of the weights: a large GPU has 132 multiprocessors


class Running(NamedTuple):
    """Running statistics of a batch normalisation, [C], which a batch changes; and how."""

    mean: Tensor
    variance: Tensor
    epsilon: float
    momentum: float


def fits_blocks(dtype: torch.dtype, kernel_map: KernelMap, schedule: str | None) -> bool:
    """Whether the kernels of the block schedule take it: on CUDA, all but double precision and very large kernels."""
    on_cuda = kernel_map.device.type == "cuda" if schedule is None else schedule == "block"
    return on_cuda and dtype != torch.float64 and kernel_map.offsets <= MAX_OFFSETS


def typed(tensor: Tensor) -> Any:
    """The tensor for a kernel that takes its precision."""
    return view(tensor, TYPES[tensor.dtype])


def types_of(features: Tensor, parameter: Tensor) -> tuple[Any, Any]:
    """What the factories of kernels are asked for."""
    return TYPES[features.dtype], TYPES[parameter.dtype]


def weight_for(weight: Tensor, dtype: torch.dtype) -> Tensor:
    """The weight as kernels take it beside features of this precision: of the same, or float32."""
    return weight if weight.dtype == torch.float32 else weight.to(dtype)


def parts_of(count: int, size: int) -> int:
    """How many parts of this size it takes."""
    return -(-count // size)


def rows_of(matrix: Tensor) -> Tensor:
    """The matrix where each row is one piece of memory, as kernels want it; a copy only if it is not so yet."""
    rows, columns = matrix.shape
    apart = matrix.stride(0) >= columns or rows < 2
    return matrix if apart and (matrix.stride(1) == 1 or columns < 2) else matrix.contiguous()


def convolve(
    features: Tensor, weight: Tensor, kernel_map: KernelMap, running: Running | None = None
) -> tuple[Tensor, Tensor]:
    """y, [M, C_out], and with `running`, which it changes, the statistics of y: mean, rest of the mean and inverse
    deviation, [3, C_out]; at least two rows."""
    outputs, device = weight.shape[2], features.device
    y = torch.empty(kernel_map.target_count, outputs, dtype=features.dtype, device=device)
    statistics = torch.empty(0 if running is None else 3, outputs, device=device)
    if not y.numel():
        return y, statistics
    table, mirrored = kernel_map.table(by_target=True)
    grid = [parts_of(len(y), products_block.TARGETS), parts_of(outputs, products_block.CHANNELS)]
    moments = scratch("sparse moments", 2 * grid[0] * outputs if running else 0, torch.float64, device)
    mean, variance, epsilon, momentum = running or (weight.new_empty(0), weight.new_empty(0), 0.0, 0.0)
    inputs = [typed(rows_of(features)), typed(weight), view(table, wp.int32), int(mirrored)]
    inputs += [_identity(kernel_map), epsilon, momentum, view(moments, wp.float64)]
    inputs.append(view(counters(grid[1], device), wp.int32))
    kernel = kernels.make_convolve_blocks(*types_of(features, weight))
    launch_blocks(kernel, grid, inputs, [typed(t) for t in (y, statistics, mean, variance)], device=device)
    return y, statistics


def gradients(
    features: Tensor,
    grad: Tensor,
    weight: Tensor,
    kernel_map: KernelMap,
    wanted: tuple[bool, bool] = (True, True),
    addend: Tensor | None = None,
) -> tuple[Tensor | None, Tensor | None]:
    """Gradients of the features, with `addend` added to it, and of the weight; those that are wanted, in one launch."""
    device, (offsets, inputs, outputs) = features.device, weight.shape
    v_features = features.new_empty(kernel_map.source_count, inputs) if wanted[0] else None
    v_weight = weight.new_empty(weight.shape) if wanted[1] else None
    across = parts_of(inputs, products_block.CHANNELS)
    feature_blocks = 0 if v_features is None else parts_of(len(v_features), products_block.TARGETS) * across
    pieces = 0 if v_weight is None else offsets * across * parts_of(outputs, products_block.CHANNELS)
    shares = max(1, min(BUSY_BLOCKS // max(pieces, 1), MAX_SHARES))
    blocks = feature_blocks + pieces * shares
    if not blocks:
        return v_features, v_weight
    (table, mirrored), identity = kernel_map.table(by_target=False), _identity(kernel_map)
    # The table of the side that has fewer voxels has fewer gaps.
    by_source = kernel_map.source_count < kernel_map.target_count
    walked, reverse = kernel_map.table(by_target=not by_source)
    if reverse:
        by_source = not by_source
        walked, _ = kernel_map.table(by_target=not by_source)
    partial = scratch("sparse shares", shares * weight.numel() if shares > 1 else 0, torch.float32, device)
    nothing = features.new_empty(0, 0)
    added = nothing if addend is None else rows_of(addend)
    arguments = [typed(rows_of(features)), typed(rows_of(grad)), typed(weight)]
    arguments += [view(table, wp.int32), int(mirrored), identity, typed(added)]
    arguments += [feature_blocks, view(walked, wp.int32), int(by_source), shares, view(partial, wp.float32)]
    arguments.append(view(counters(pieces, device), wp.int32))
    outs = [typed(nothing if v_features is None else v_features)]
    outs.append(typed(weight.new_empty(0, 0, 0) if v_weight is None else v_weight))
    kernel = kernels.make_convolve_backward_blocks(*types_of(features, weight))
    launch_blocks(kernel, [blocks], arguments, outs, device=device)
    return v_features, v_weight


def _identity(kernel_map: KernelMap) -> int:
    return -1 if kernel_map.identity is None else kernel_map.identity
