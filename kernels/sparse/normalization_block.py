"""Batch normalisation of voxels, block schedule (CUDA): one launch after the convolution, two for the gradients.

z = max(0, (y - mean) / deviation gain + bias + shortcut), with further channels beside it. The convolution has left
the statistics. A mean is two floats, so that the difference from a large one keeps its digits. Where z was rectified is
seen from z itself.
"""

from functools import cache
from typing import Any

import warp as wp

from sgwarp.kernels.blocks import BLOCK, barrier, comes_last, latest_double, put, put_double
from sgwarp.kernels.sparse.products_block import CHANNELS, LANES
from sgwarp.kernels.transmittance import BLOCK_OPTIONS

wp.set_module_options(BLOCK_OPTIONS)


@wp.func
def normalized(y: float, statistics: wp.array2d[float], c: int) -> float:
    """(y - mean) / deviation."""
    return ((y - statistics[0, c]) - statistics[1, c]) * statistics[2, c]


@cache
def make_normalize_elements(Value: type, Weight: type) -> wp.Kernel:
    """Kernel for features of type `Value` and parameters of type `Weight`; the arithmetic is float32."""

    @wp.kernel(module="unique", module_options=BLOCK_OPTIONS, enable_backward=False)
    def normalize_elements(
        # In:
        features: wp.array2d[Value],  # y, [N, C]
        statistics: wp.array2d[float],  # [3, C] mean, what float32 leaves of it, 1 / deviation
        gain: wp.array[Weight],  # [C]
        bias: wp.array[Weight],  # [C]
        shortcut: wp.array2d[Value],  # [N, C], or empty
        least: float,  # value: 0, or -inf for no rectification
        beside: wp.array2d[Value],  # [N, S] further channels, copied; or empty
        # Out:
        features_out: wp.array2d[Value],  # z, [N, C + S]
    ):
        """One thread per element of the result."""
        row, c = wp.tid()
        if c < gain.shape[0]:
            value = normalized(float(features[row, c]), statistics, c) * float(gain[c]) + float(bias[c])
            if shortcut.shape[0] > 0:
                value += float(shortcut[row, c])
            features_out[row, c] = Value(wp.where(value < least, least, value))  # NaN stays, as in torch
        else:
            features_out[row, c] = beside[row, c - gain.shape[0]]

    return normalize_elements


@wp.func
def passed(gradient: wp.array2d[Any], result: wp.array2d[Any], rectified: int, row: int, c: int) -> float:
    """Gradient of the sum before rectification; none where that cut it off, as torch's threshold."""
    value = float(gradient[row, c])
    if rectified != 0 and float(result[row, c]) <= 0.0:
        value = float(0.0)
    return value


@cache
def make_sum_normalized_blocks(Value: type, Weight: type) -> wp.Kernel:
    """The same for the sums that the gradients need."""

    @wp.kernel(module="unique", module_options=BLOCK_OPTIONS, enable_backward=False)
    def sum_normalized_blocks(
        # In:
        gradient: wp.array2d[Value],  # of z, [N, C + S]
        result: wp.array2d[Value],  # z, [N, C + S]
        rectified: int,  # 0 or 1
        features: wp.array2d[Value],  # y, [N, C]
        statistics: wp.array2d[float],  # [3, C]
        per_part: int,  # rows of a block
        partial: wp.array[wp.float64],  # scratch [parts, C, 2]
        arrived: wp.array[int],  # scratch [groups of 32 C], zero
        # Out:
        bias_out: wp.array[Weight],  # [C] gradient of the bias
        gain_out: wp.array[Weight],  # [C] gradient of the gain
    ):
        """Sums over the rows of the gradient, and of it times what was normalised; a block per part and 32 C."""
        part, group, t = wp.tid()
        channels = features.shape[1]
        parts = (features.shape[0] + per_part - 1) / per_part
        c = group * CHANNELS + t % CHANNELS
        lane = t / CHANNELS
        shares = wp.tile_empty(shape=(wp.static(2 * BLOCK),), dtype=float, storage="shared")
        sums = wp.tile_empty(shape=(wp.static(2 * BLOCK),), dtype=wp.float64, storage="shared")
        flag = wp.tile_empty(shape=(1,), dtype=int, storage="shared")
        total = float(0.0)
        product = float(0.0)
        if c < channels:
            for row in range(part * per_part + lane, wp.min((part + 1) * per_part, features.shape[0]), LANES):
                value = passed(gradient, result, rectified, row, c)
                total += value
                product += value * normalized(float(features[row, c]), statistics, c)
        put(shares, t, total)
        put(shares, BLOCK + t, product)
        barrier()
        if lane == 0 and c < channels:
            first = wp.float64(0.0)
            second = wp.float64(0.0)
            for other in range(LANES):
                first += wp.float64(wp.tile_extract(shares, CHANNELS * other + t))
                second += wp.float64(wp.tile_extract(shares, BLOCK + CHANNELS * other + t))
            partial[2 * (part * channels + c)] = first
            partial[2 * (part * channels + c) + 1] = second
        if comes_last(arrived, group, parts, t, flag):
            first = wp.float64(0.0)
            second = wp.float64(0.0)
            if c < channels:
                for other in range(lane, parts, LANES):
                    first += latest_double(partial, 2 * (other * channels + c))
                    second += latest_double(partial, 2 * (other * channels + c) + 1)
            put_double(sums, t, first)
            put_double(sums, BLOCK + t, second)
            barrier()
            if lane == 0 and c < channels:
                first = wp.float64(0.0)
                second = wp.float64(0.0)
                for other in range(LANES):
                    first += wp.tile_extract(sums, CHANNELS * other + t)
                    second += wp.tile_extract(sums, BLOCK + CHANNELS * other + t)
                bias_out[c] = Weight(first)
                gain_out[c] = Weight(second)

    return sum_normalized_blocks


@cache
def make_normalize_backward_elements(Value: type, Weight: type) -> wp.Kernel:
    """The same for the gradients of the features and the shortcut."""

    @wp.kernel(module="unique", module_options=BLOCK_OPTIONS, enable_backward=False)
    def normalize_backward_elements(
        # In:
        gradient: wp.array2d[Value],  # of z, [N, C + S]
        result: wp.array2d[Value],  # z, [N, C + S]
        rectified: int,  # 0 or 1
        features: wp.array2d[Value],  # y, [N, C]
        statistics: wp.array2d[float],  # [3, C]
        gain: wp.array[Weight],  # [C]
        v_bias: wp.array[Weight],  # [C] of `sum_normalized_blocks`
        v_gain: wp.array[Weight],  # [C] likewise
        share: float,  # of a row in the statistics: 1 / N, or 0 where they do not depend on the rows
        # Out:
        features_out: wp.array2d[Value],  # gradient of y, [N, C]
        shortcut_out: wp.array2d[Value],  # gradient of the shortcut, [N, C], or empty
    ):
        """One thread per element of y."""
        row, c = wp.tid()
        value = passed(gradient, result, rectified, row, c)
        if shortcut_out.shape[0] > 0:
            shortcut_out[row, c] = Value(value)
        if share > 0.0:
            value -= share * (float(v_bias[c]) + normalized(float(features[row, c]), statistics, c) * float(v_gain[c]))
        features_out[row, c] = Value(value * (float(gain[c]) * statistics[2, c]))

    return normalize_backward_elements
