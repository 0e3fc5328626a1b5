"""Mean and variance of the result of a convolution, block schedule (CUDA).

A block leaves those of its rows, and the last block of a channel joins them in double precision.
"""

from typing import Any

import warp as wp

from sgwarp.kernels.blocks import BLOCK, barrier, latest_double, put, put_double
from sgwarp.kernels.sparse.products_block import CHANNELS, LANES, STRIDE, TARGETS
from sgwarp.kernels.transmittance import BLOCK_OPTIONS

wp.set_module_options(BLOCK_OPTIONS)


@wp.func
def leave_moments(
    count: int,
    first_output: int,
    outputs: int,
    part: int,
    t: int,
    rows: wp.tile[float],
    weights: wp.tile[float],
    moments: wp.array[wp.float64],
):
    """Mean and squared deviations from it of a block's rows, of every channel; counted from the first row, so that a
    large mean does not drown them."""
    c = t / LANES
    lane = t % LANES
    origin = wp.tile_extract(rows, STRIDE * c)
    total = float(0.0)
    for r in range(lane, count, LANES):
        total += wp.tile_extract(rows, STRIDE * c + r) - origin
    put(weights, t, total)
    barrier()
    total = float(0.0)
    for other in range(LANES):
        total += wp.tile_extract(weights, LANES * c + other)
    shift = total / float(count)
    deviations = float(0.0)
    for r in range(lane, count, LANES):
        deviation = wp.tile_extract(rows, STRIDE * c + r) - origin - shift
        deviations += deviation * deviation
    put(weights, BLOCK + t, deviations)
    barrier()
    if lane == 0 and first_output + c < outputs:
        deviations = float(0.0)
        for other in range(LANES):
            deviations += wp.tile_extract(weights, BLOCK + t + other)
        at = 2 * (part * outputs + first_output + c)
        moments[at] = wp.float64(origin) + wp.float64(shift)
        moments[at + 1] = wp.float64(deviations)


@wp.func
def join_moments(
    moments: wp.array[wp.float64],
    count: int,
    first_output: int,
    outputs: int,
    epsilon: float,
    momentum: float,
    t: int,
    sums: wp.tile[wp.float64],
    statistics_out: wp.array2d[float],
    mean_out: wp.array[Any],
    variance_out: wp.array[Any],
):
    """Statistics of all rows from those of the blocks, in double precision, counted from the first block's mean."""
    o = first_output + t % CHANNELS
    lane = t / CHANNELS
    origin = wp.float64(0.0)
    shift = wp.float64(0.0)
    deviations = wp.float64(0.0)
    parts = (count + TARGETS - 1) / TARGETS
    if o < outputs:
        origin = latest_double(moments, 2 * o)
        for part in range(lane, parts, LANES):
            at = 2 * (part * outputs + o)
            rows = wp.float64(wp.min(TARGETS, count - part * TARGETS))
            away = latest_double(moments, at) - origin
            shift += rows * away
            deviations += latest_double(moments, at + 1) + rows * away * away
    put_double(sums, t, shift)
    put_double(sums, BLOCK + t, deviations)
    barrier()
    if lane == 0 and o < outputs:
        shift = wp.float64(0.0)
        deviations = wp.float64(0.0)
        for other in range(LANES):
            shift += wp.tile_extract(sums, CHANNELS * other + t)
            deviations += wp.tile_extract(sums, BLOCK + CHANNELS * other + t)
        rows = wp.float64(count)
        shift /= rows
        mean = origin + shift
        variance = deviations / rows - shift * shift
        if variance < wp.float64(0.0):  # by rounding; NaN stays
            variance = wp.float64(0.0)
        high = float(mean)
        statistics_out[0, o] = high
        statistics_out[1, o] = float(mean - wp.float64(high))
        statistics_out[2, o] = float(wp.float64(1.0) / wp.sqrt(variance + wp.float64(epsilon)))
        unbiased = float(variance * rows / (rows - wp.float64(1.0)))
        mean_out[o] = mean_out.dtype((1.0 - momentum) * float(mean_out[o]) + momentum * high)
        variance_out[o] = variance_out.dtype((1.0 - momentum) * float(variance_out[o]) + momentum * unbiased)
