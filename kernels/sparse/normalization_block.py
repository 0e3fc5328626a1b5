"""Batch normalisation of voxels, block schedule (CUDA): one launch after the convolution, two for the gradients.

z = max(0, (y - mean) / deviation gain + bias + shortcut), with further channels beside it. The convolution has left
the statistics. A mean is two floats, so that the difference from a large one keeps its digits. Where z was rectified is
seen from z itself.
"""

import warp as wp

from sgwarp.kernels.blocks import BLOCK, barrier, comes_last, latest_double, put, put_double
from sgwarp.kernels.sparse.products_block import CHANNELS, LANES
from sgwarp.kernels.transmittance import BLOCK_OPTIONS

wp.set_module_options(BLOCK_OPTIONS)


@wp.func
def normalized(y: float, statistics: wp.array2d[float], c: int) -> float:
    """(y - mean) / deviation."""
    return ((y - statistics[0, c]) - statistics[1, c]) * statistics[2, c]


@wp.kernel
def normalize_elements(
    # In:
    features: wp.array2d[float],  # y, [N, C]
    statistics: wp.array2d[float],  # [3, C] mean, what float32 leaves of it, 1 / deviation
    gain: wp.array[float],  # [C]
    bias: wp.array[float],  # [C]
    shortcut: wp.array2d[float],  # [N, C], or empty
    least: float,  # value: 0, or -inf for no rectification
    beside: wp.array2d[float],  # [N, S] further channels, copied; or empty
    # Out:
    features_out: wp.array2d[float],  # z, [N, C + S]
):
    """One thread per element of the result."""
    row, c = wp.tid()
    if c < gain.shape[0]:
        value = normalized(features[row, c], statistics, c) * gain[c] + bias[c]
        if shortcut.shape[0] > 0:
            value += shortcut[row, c]
        features_out[row, c] = wp.where(value < least, least, value)  # NaN stays, as in torch
    else:
        features_out[row, c] = beside[row, c - gain.shape[0]]


@wp.func
def passed(gradient: wp.array2d[float], result: wp.array2d[float], rectified: int, row: int, c: int) -> float:
    """Gradient of the sum before rectification; none where that cut it off, as torch's threshold."""
    value = gradient[row, c]
    if rectified != 0 and result[row, c] <= 0.0:
        value = float(0.0)
    return value


@wp.kernel
def sum_normalized_blocks(
    # In:
    gradient: wp.array2d[float],  # of z, [N, C + S]
    result: wp.array2d[float],  # z, [N, C + S]
    rectified: int,  # 0 or 1
    features: wp.array2d[float],  # y, [N, C]
    statistics: wp.array2d[float],  # [3, C]
    per_part: int,  # rows of a block
    partial: wp.array[wp.float64],  # scratch [parts, C, 2]
    arrived: wp.array[int],  # scratch [groups of 32 C], zero
    # Out:
    bias_out: wp.array[float],  # [C] gradient of the bias
    gain_out: wp.array[float],  # [C] gradient of the gain
):
    """Sums over the rows of the gradient, and of its product with what was normalised; a block per part and 32 C."""
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
            product += value * normalized(features[row, c], statistics, c)
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
            bias_out[c] = float(first)
            gain_out[c] = float(second)


@wp.kernel
def normalize_backward_elements(
    # In:
    gradient: wp.array2d[float],  # of z, [N, C + S]
    result: wp.array2d[float],  # z, [N, C + S]
    rectified: int,  # 0 or 1
    features: wp.array2d[float],  # y, [N, C]
    statistics: wp.array2d[float],  # [3, C]
    gain: wp.array[float],  # [C]
    v_bias: wp.array[float],  # [C] of `sum_normalized_blocks`
    v_gain: wp.array[float],  # [C] likewise
    share: float,  # of a row in the statistics: 1 / N, or 0 where they do not depend on the rows
    # Out:
    features_out: wp.array2d[float],  # gradient of y, [N, C]
    shortcut_out: wp.array2d[float],  # gradient of the shortcut, [N, C], or empty
):
    """One thread per element of y."""
    row, c = wp.tid()
    value = passed(gradient, result, rectified, row, c)
    if shortcut_out.shape[0] > 0:
        shortcut_out[row, c] = value
    if share > 0.0:
        value -= share * (v_bias[c] + normalized(features[row, c], statistics, c) * v_gain[c])
    features_out[row, c] = value * (gain[c] * statistics[2, c])
