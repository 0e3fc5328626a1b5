"""Convolution of sparse voxels and its gradients: for each offset gather rows, multiply, add to the rows they reach.

A target stands at most once within an offset, so the additions of an offset never collide, and the order of the
offsets is fixed: the result does not depend on threads. Single precision on the CPU runs in a kernel that does all
three at once, CUDA has kernels of blocks (blocks.py); elsewhere rows are copied and multiplied by torch.
"""

from __future__ import annotations

from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from sgwarp.errors import InputError
from sgwarp.kernels.sparse import convolution_lanes as kernels
from sgwarp.ops.arguments import view
from sgwarp.ops.launcher import launch
from sgwarp.ops.memory import scratch
from sgwarp.ops.sparse import blocks
from sgwarp.ops.sparse.voxels import KernelMap

BLOCK_BYTES, LEAST_BLOCK = 2**17, 64  # rows of a block of targets: those that it reads should stay in the cache
HALVES = (torch.float16, torch.bfloat16)


def sparse_conv(features: Tensor, weight: Tensor, kernel_map: KernelMap, *, schedule: str | None = None) -> Tensor:
    """y[target] = sum over the pairs of offset k of x[source] @ W[k]; differentiable in features and weight.

    In half precision, or under autocast, the products are taken in that precision and summed in float32; so is the
    gradient of the weight. The result has the precision of the products.

    Args:
        features: x, floating point [N, C_in].
        weight: W, floating point [K^3, C_in, C_out].
        kernel_map: Pairs of sources among the N rows and targets among the M rows of the result.
        schedule: "lanes" or "block", by default the device's own; either runs on the CPU.

    Returns:
        y, [M, C_out].

    Raises:
        InputError: The shapes do not belong together.
    """
    fits = features.ndim == 2 and weight.ndim == 3 and features.shape[1] == weight.shape[1]
    if not fits or len(features) != kernel_map.source_count or len(weight) != kernel_map.offsets:
        raise InputError(
            f"features {list(features.shape)} and weight {list(weight.shape)} do not fit a map of "
            f"{kernel_map.source_count} voxels and {kernel_map.offsets} offsets"
        )
    device = features.device.type
    if torch.is_autocast_enabled(device) and features.dtype != torch.float64:
        features = features.to(torch.get_autocast_dtype(device))
    dtype = features.dtype
    y: Tensor = _SparseConv.apply(features, weight.to(dtype) if dtype not in HALVES else weight, kernel_map, schedule)
    return y


class _SparseConv(torch.autograd.Function):
    """Half precision features may come with a float32 weight, whose gradient then stays in float32."""

    @staticmethod
    def forward(ctx: Any, features: Tensor, weight: Tensor, kernel_map: KernelMap, schedule: str | None) -> Tensor:
        ctx.save_for_backward(features, weight)
        ctx.kernel_map, ctx.in_blocks = kernel_map, blocks.fits_blocks(features.dtype, kernel_map, schedule)
        with torch.autocast(features.device.type, enabled=False):
            if ctx.in_blocks:
                return blocks.convolve(features, blocks.weight_for(weight, features.dtype), kernel_map)[0]
            return _convolve(features, weight.to(features.dtype), kernel_map)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor | None, None, None]:
        features, weight = ctx.saved_tensors
        for_features, for_weight = ctx.needs_input_grad[:2]
        v_features = v_weight = None
        with torch.autocast(features.device.type, enabled=False):
            grad = grad.to(features.dtype)
            if ctx.in_blocks:
                operands = features, grad, blocks.weight_for(weight, features.dtype)
                v_features, v_weight = blocks.gradients(*operands, ctx.kernel_map, (for_features, for_weight))
                return v_features, None if v_weight is None else v_weight.to(weight.dtype), None, None
            grad, rounded = grad.contiguous(), weight.to(features.dtype)
            if for_features:
                v_features = _convolve(grad, rounded.transpose(1, 2), ctx.kernel_map.swapped())
            if for_weight:
                v_weight = _weight_gradient(features, grad, ctx.kernel_map).to(weight.dtype)
        return v_features, v_weight, None, None


def _fits_kernel(features: Tensor, outputs: int) -> bool:
    return features.dtype == torch.float32 and not features.is_cuda and outputs % kernels.COLUMNS == 0


def _pairs(kernel_map: KernelMap) -> list[Any]:
    """Pairs as the kernels read them."""
    starts = view(torch.tensor(kernel_map.starts, dtype=torch.int32, device="cpu"), wp.int32)
    identity = -1 if kernel_map.identity is None else kernel_map.identity
    return [view(kernel_map.sources, wp.int64), view(kernel_map.targets, wp.int64), starts, identity]


def _convolve_by_kernel(features: Tensor, weight: Tensor, kernel_map: KernelMap) -> Tensor:
    offsets, inputs, outputs = weight.shape
    packed = weight.view(offsets, inputs, -1, kernels.COLUMNS).transpose(1, 2).contiguous()
    y = features.new_empty(kernel_map.target_count, outputs)
    rows = max(LEAST_BLOCK, BLOCK_BYTES // (4 * inputs))
    arguments = [rows, view(features.contiguous(), wp.float32), view(packed.flatten(), wp.float32), *_pairs(kernel_map)]
    blocks = -(-kernel_map.target_count // rows)
    launch(kernels.convolve_voxels, blocks, arguments, [view(y, wp.float32)], device=y.device, chunk=1)
    return y


def _convolve(features: Tensor, weight: Tensor, kernel_map: KernelMap) -> Tensor:
    if _fits_kernel(features, weight.shape[2]):
        return _convolve_by_kernel(features, weight, kernel_map)
    accumulate = torch.float32 if features.dtype in HALVES else features.dtype
    if kernel_map.identity is None:
        y = features.new_zeros(kernel_map.target_count, weight.shape[2], dtype=accumulate)
    else:
        y = torch.mm(features, weight[kernel_map.identity]).to(accumulate)
    for k, (start, stop) in enumerate(zip(kernel_map.starts, kernel_map.starts[1:], strict=False)):
        if start < stop:
            rows = _gathered("sources", features, kernel_map.sources[start:stop])
            product = _borrowed("products", len(rows), weight.shape[2], features)
            torch.mm(rows, weight[k], out=product)
            y.index_add_(0, kernel_map.targets[start:stop], product.to(accumulate))
    return y.to(features.dtype)


def _weight_gradient(features: Tensor, grad: Tensor, kernel_map: KernelMap) -> Tensor:
    """x[sources]^T v_y[targets] of every offset, float32 or wider."""
    if _fits_kernel(features, grad.shape[1]):
        v_weight = features.new_empty(kernel_map.offsets, features.shape[1], grad.shape[1])
        tasks = kernel_map.offsets * -(-features.shape[1] // kernels.GRADIENT_GROUP)
        arguments = [view(features.contiguous(), wp.float32), view(grad, wp.float32), *_pairs(kernel_map)]
        kernel, outputs = kernels.sum_weight_gradient, [view(v_weight, wp.float32)]
        launch(kernel, tasks, arguments, outputs, device=features.device, chunk=1)
        return v_weight
    accumulate = torch.float32 if features.dtype in HALVES else features.dtype
    v_weight = features.new_zeros(kernel_map.offsets, features.shape[1], grad.shape[1], dtype=accumulate)
    for k, (start, stop) in enumerate(zip(kernel_map.starts, kernel_map.starts[1:], strict=False)):
        if start < stop:
            rows = _gathered("sources", features, kernel_map.sources[start:stop]).to(accumulate)
            reached = _gathered("targets", grad, kernel_map.targets[start:stop]).to(accumulate)
            torch.mm(rows.T, reached, out=v_weight[k])
    if kernel_map.identity is not None:
        torch.mm(features.T.to(accumulate), grad.to(accumulate), out=v_weight[kernel_map.identity])
    return v_weight


def _gathered(name: str, values: Tensor, rows: Tensor) -> Tensor:
    """values[rows] in memory that the next offset writes over."""
    return torch.index_select(values, 0, rows, out=_borrowed(name, len(rows), values.shape[1], values))


def _borrowed(name: str, count: int, channels: int, like: Tensor) -> Tensor:
    """Scratch of shape [count, channels]: fresh memory costs about as much as the product that is written to it."""
    return scratch(f"sparse_conv {name}", count * channels, like.dtype, like.device).view(count, channels)
