"""A convolution with what follows it in a residual network, block schedule (CUDA): normalisation, shortcut, maximum.

z = max(0, (y - mean) / sqrt(variance + epsilon) gain + bias + shortcut) of y, the convolution of x, and beside z
further channels of the same voxels. Two launches with gradients to follow, three for all gradients, and one for
inference.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

from sgwarp.kernels.sparse import convolution_block, normalization_block, products_block
from sgwarp.ops.arguments import view
from sgwarp.ops.launcher import launch_blocks, launch_plain
from sgwarp.ops.memory import counters, scratch
from sgwarp.ops.sparse.blocks import Running, convolve, gradients, parts_of, rows_of, typed, types_of
from sgwarp.ops.sparse.voxels import KernelMap

ROWS, MAX_PARTS = 128, 256  # of a sum over all voxels: rows of a block at least, and blocks at most


@dataclass(frozen=True, eq=False)
class Normalization:
    """A batch normalisation with its affine map.

    Attributes:
        gain, bias: [C]; may want gradients.
        running: Its running statistics.
        learns: Whether to normalise by the statistics of the rows, of which there are two or more, and to let them into
            the running ones.
        rectified: Whether what is negative becomes zero in the end.
    """

    gain: Tensor
    bias: Tensor
    running: Running
    learns: bool
    rectified: bool = True

    @property
    def least(self) -> float:
        return 0.0 if self.rectified else -math.inf


def convolve_and_normalize(
    features: Tensor,
    weight: Tensor,
    kernel_map: KernelMap,
    norm: Normalization,
    shortcut: Tensor | None = None,
    beside: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """A layer in float32, float16 or bfloat16; beside halves weights and normalisation may be float32, and sums are.

    Args:
        features: x, [N, C_in].
        weight: W, [K^3, C_in, C], of the precision of the normalisation.
        kernel_map: From the N rows to M.
        norm: What follows.
        shortcut: Added before the maximum is taken, [M, C].
        beside: Channels that are copied behind those of the result, [M, S].

    Returns:
        z, [M, C + S], and x: who goes on with this x instead of the one that was given spares its gradient an addition.
    """
    tensors = (features, weight, norm.gain, norm.bias, shortcut, beside)
    if torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in tensors):
        z, through = _Layer.apply(*tensors, kernel_map, norm)
        return z, through
    if not norm.learns:
        return _infer(features, weight, kernel_map, norm, shortcut, beside), features
    return _learn(features, weight, kernel_map, norm, shortcut, beside)[0], features


def _infer(
    features: Tensor,
    weight: Tensor,
    kernel_map: KernelMap,
    norm: Normalization,
    shortcut: Tensor | None,
    beside: Tensor | None,
) -> Tensor:
    """z by the running statistics, in one launch."""
    channels, further = weight.shape[2], 0 if beside is None else beside.shape[1]
    z = features.new_empty(kernel_map.target_count, channels + further)
    if not z.numel():
        return z
    grid = [parts_of(len(z), products_block.TARGETS)]
    grid.append(sum(parts_of(n, products_block.CHANNELS) for n in (channels, further)))
    table, mirrored = kernel_map.table(by_target=True)
    nothing, running = features.new_empty(0, 0), norm.running
    inputs = [typed(rows_of(features)), typed(weight), view(table, wp.int32), int(mirrored)]
    inputs.append(-1 if kernel_map.identity is None else kernel_map.identity)
    inputs += [typed(running.mean), typed(running.variance), running.epsilon, typed(norm.gain), typed(norm.bias)]
    inputs += [typed(nothing if shortcut is None else rows_of(shortcut)), norm.least]
    inputs.append(typed(nothing if beside is None else rows_of(beside)))
    kernel = convolution_block.make_convolve_and_finish_blocks(*types_of(features, weight))
    launch_blocks(kernel, grid, inputs, [typed(z)], device=z.device)
    return z


def _learn(
    features: Tensor,
    weight: Tensor,
    kernel_map: KernelMap,
    norm: Normalization,
    shortcut: Tensor | None,
    beside: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """z, y and the statistics, in two launches."""
    running = norm.running
    y, statistics = convolve(features, weight, kernel_map, running if norm.learns else None)
    if norm.learns:
        for changed in (running.mean, running.variance):
            if not changed.is_inference():
                torch.autograd.graph.increment_version(changed)
    else:
        mean, inverse = running.mean.float(), torch.rsqrt(running.variance.float() + running.epsilon)
        statistics = torch.stack([mean, torch.zeros_like(mean), inverse])
    further = 0 if beside is None else beside.shape[1]
    z = y.new_empty(len(y), y.shape[1] + further)
    nothing = y.new_empty(0, 0)
    inputs = [typed(t) for t in (y, statistics, norm.gain, norm.bias)]
    inputs += [typed(nothing if shortcut is None else rows_of(shortcut)), norm.least]
    inputs.append(typed(nothing if beside is None else rows_of(beside)))
    kernel = normalization_block.make_normalize_elements(*types_of(y, norm.gain))
    launch_plain(kernel, (z.shape[0], z.shape[1]), inputs, [typed(z)], device=z.device)
    return z, y, statistics


class _Layer(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        features: Tensor,
        weight: Tensor,
        gain: Tensor,
        bias: Tensor,
        shortcut: Tensor | None,
        beside: Tensor | None,
        kernel_map: KernelMap,
        norm: Normalization,
    ) -> tuple[Tensor, Tensor]:
        ctx.set_materialize_grads(False)
        z, y, statistics = _learn(features, weight, kernel_map, norm, shortcut, beside)
        ctx.save_for_backward(features, weight, gain, y, statistics, z)
        ctx.kernel_map, ctx.learns, ctx.rectified = kernel_map, norm.learns, norm.rectified
        return z, features.view_as(features)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor | None, through: Tensor | None) -> tuple[Tensor | None, ...]:
        if grad is None:
            return (through, *[None] * 7)
        features, weight, gain, y, statistics, z = ctx.saved_tensors
        for_features, for_weight, for_gain, for_bias, for_shortcut, for_beside = ctx.needs_input_grad[:6]
        channels, grad = y.shape[1], rows_of(grad)
        v_bias, v_gain = ((gain.new_empty if len(y) else gain.new_zeros)(channels) for _ in range(2))
        known, types = [typed(grad), typed(z), int(ctx.rectified), typed(y), typed(statistics)], types_of(y, gain)
        if len(y) and (ctx.learns or for_gain or for_bias):
            per_part = max(ROWS, parts_of(len(y), MAX_PARTS))
            grid = [parts_of(len(y), per_part), parts_of(channels, products_block.CHANNELS)]
            partial = scratch("sparse sums", 2 * grid[0] * channels, torch.float64, y.device)
            inputs = [*known, per_part, view(partial, wp.float64), view(counters(grid[1], y.device), wp.int32)]
            kernel = normalization_block.make_sum_normalized_blocks(*types)
            launch_blocks(kernel, grid, inputs, [typed(v_bias), typed(v_gain)], device=y.device)
        v_features = v_weight = v_shortcut = None
        if for_features or for_weight or for_shortcut:
            v_y = torch.empty_like(y)
            v_shortcut = torch.empty_like(y) if for_shortcut else None
            share = 1.0 / len(y) if ctx.learns else 0.0
            inputs = [*known, *(typed(t) for t in (gain, v_bias, v_gain)), share]
            outputs = [typed(t) for t in (v_y, y.new_empty(0, 0) if v_shortcut is None else v_shortcut)]
            kernel = normalization_block.make_normalize_backward_elements(*types)
            launch_plain(kernel, (len(y), channels), inputs, outputs, device=y.device)
            wanted = for_features, for_weight
            v_features, v_weight = gradients(features, v_y, weight, ctx.kernel_map, wanted, through)
        return (
            v_features,
            v_weight,
            v_gain if for_gain else None,
            v_bias if for_bias else None,
            v_shortcut,
            grad[:, channels:] if for_beside else None,
            None,
            None,
        )
