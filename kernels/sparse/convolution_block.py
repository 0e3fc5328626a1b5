"""Sparse convolution, block schedule (CUDA): one launch for a layer, one for both of its gradients.

Nothing is written but the result, once, so that the order of the sums is fixed. What follows a convolution is done
while its sums are at hand: in training the statistics of the result; in inference the sums are normalised, a shortcut
is added, and what is negative becomes zero. The last block of 32 x 32 weights adds up the shares of their gradient.
Features may be of half precision: weights are then rounded to it, as they are read, and sums are float32.
"""

from functools import cache

import warp as wp

from sgwarp.kernels.blocks import BLOCK, barrier, comes_last, latest
from sgwarp.kernels.sparse.moments_block import join_moments, leave_moments
from sgwarp.kernels.sparse.products_block import CHANNELS, LANES, STRIDE, TARGETS, WIDTH, share_products, sum_products
from sgwarp.kernels.sparse.weights_block import GROUP, sum_weights
from sgwarp.kernels.transmittance import BLOCK_OPTIONS

wp.set_module_options(BLOCK_OPTIONS)

MAX_OFFSETS = 128  # of a kernel
BLOCKS = 3  # that a multiprocessor should hold: no more than 80 registers


@cache
def make_convolve_blocks(Value: type, Weight: type) -> wp.Kernel:
    """Kernel for features of type `Value` and parameters of type `Weight`; all sums are float32."""

    @wp.kernel(module="unique", launch_bounds=(BLOCK, BLOCKS), module_options=BLOCK_OPTIONS, enable_backward=False)
    def convolve_blocks(
        # In:
        features: wp.array2d[Value],  # [N, C_in]
        weight: wp.array3d[Weight],  # [K, C_in, C_out]
        table: wp.array2d[int],  # [K, M] row of `features` that each target reads, -1 = none
        mirrored: int,  # 1 = the table's rows are those of the offsets in reverse
        identity: int,  # offset that connects every voxel with itself, -1 = none
        epsilon: float,  # added to the variance
        momentum: float,  # weight of this batch in the running statistics
        moments: wp.array[wp.float64],  # scratch [parts, C_out, 2]
        arrived: wp.array[int],  # scratch [groups of 32 C_out], zero
        # Out:
        features_out: wp.array2d[Value],  # [M, C_out]
        statistics_out: wp.array2d[float],  # [3, C_out] mean, what float32 leaves of it, 1 / deviation; or empty
        mean_out: wp.array[Weight],  # [C_out] running, changed
        variance_out: wp.array[Weight],  # [C_out] running, changed
    ):
        """Sum over the offsets, and statistics of the result; one block per 128 targets and 32 output channels."""
        part, group, t = wp.tid()
        rows_out = features_out.shape[0]
        outputs = features_out.shape[1]
        first = part * TARGETS
        first_output = group * CHANNELS
        count = wp.min(TARGETS, rows_out - first)
        used = wp.tile_zeros(shape=(MAX_OFFSETS,), dtype=float, storage="shared")
        read = wp.tile_empty(shape=(TARGETS,), dtype=int, storage="shared")
        rows = wp.tile_empty(shape=(wp.static(CHANNELS * STRIDE),), dtype=float, storage="shared")
        weights = wp.tile_empty(shape=(wp.static(CHANNELS * WIDTH),), dtype=float, storage="shared")
        sums = wp.tile_empty(shape=(wp.static(2 * BLOCK),), dtype=wp.float64, storage="shared")
        flag = wp.tile_empty(shape=(1,), dtype=int, storage="shared")
        barrier()
        products = sum_products(
            features,
            weight,
            0,
            table,
            mirrored,
            identity,
            first,
            first_output,
            count,
            outputs,
            t,
            used,
            read,
            rows,
            weights,
        )
        share_products(products, t, rows)
        o = first_output + t % CHANNELS
        if o < outputs:
            for r in range(t / CHANNELS, count, LANES):
                features_out[first + r, o] = Value(wp.tile_extract(rows, STRIDE * (t % CHANNELS) + r))
        if statistics_out.shape[0] > 0:
            leave_moments(count, first_output, outputs, part, t, rows, weights, moments)
            if comes_last(arrived, group, (rows_out + TARGETS - 1) / TARGETS, t, flag):
                join_moments(
                    moments,
                    rows_out,
                    first_output,
                    outputs,
                    epsilon,
                    momentum,
                    t,
                    sums,
                    statistics_out,
                    mean_out,
                    variance_out,
                )

    return convolve_blocks


@cache
def make_convolve_and_finish_blocks(Value: type, Weight: type) -> wp.Kernel:
    """The same for a whole layer."""

    @wp.kernel(module="unique", launch_bounds=(BLOCK, BLOCKS), module_options=BLOCK_OPTIONS, enable_backward=False)
    def convolve_and_finish_blocks(
        # In:
        features: wp.array2d[Value],  # [N, C_in]
        weight: wp.array3d[Weight],  # [K, C_in, C_out]
        table: wp.array2d[int],  # [K, M] as above
        mirrored: int,
        identity: int,
        mean: wp.array[Weight],  # [C_out] running
        variance: wp.array[Weight],  # [C_out] running
        epsilon: float,  # added to the variance
        gain: wp.array[Weight],  # [C_out]
        bias: wp.array[Weight],  # [C_out]
        shortcut: wp.array2d[Value],  # [M, C_out], or empty
        least: float,  # value: 0, or -inf for no rectification
        beside: wp.array2d[Value],  # [M, S] further channels, copied; or empty
        # Out:
        features_out: wp.array2d[Value],  # [M, C_out + S]
    ):
        """A whole layer for inference; blocks of `beside` follow those of the channels."""
        part, group, t = wp.tid()
        outputs = gain.shape[0]
        groups = (outputs + CHANNELS - 1) / CHANNELS
        first = part * TARGETS
        first_output = group * CHANNELS
        count = wp.min(TARGETS, features_out.shape[0] - first)
        used = wp.tile_zeros(shape=(MAX_OFFSETS,), dtype=float, storage="shared")
        read = wp.tile_empty(shape=(TARGETS,), dtype=int, storage="shared")
        rows = wp.tile_empty(shape=(wp.static(CHANNELS * STRIDE),), dtype=float, storage="shared")
        weights = wp.tile_empty(shape=(wp.static(CHANNELS * WIDTH),), dtype=float, storage="shared")
        barrier()
        if group >= groups:
            for e in range(t, wp.static(TARGETS * CHANNELS), BLOCK):
                r = e / CHANNELS
                c = (group - groups) * CHANNELS + e % CHANNELS
                if r < count and c < beside.shape[1]:
                    features_out[first + r, outputs + c] = beside[first + r, c]
        else:
            products = sum_products(
                features,
                weight,
                0,
                table,
                mirrored,
                identity,
                first,
                first_output,
                count,
                outputs,
                t,
                used,
                read,
                rows,
                weights,
            )
            share_products(products, t, rows)
            o = first_output + t % CHANNELS
            if o < outputs:
                scale = float(gain[o]) / wp.sqrt(float(variance[o]) + epsilon)
                for r in range(t / CHANNELS, count, LANES):
                    value = wp.tile_extract(rows, STRIDE * (t % CHANNELS) + r)
                    value = (value - float(mean[o])) * scale + float(bias[o])
                    if shortcut.shape[0] > 0:
                        value += float(shortcut[first + r, o])
                    # The comparison keeps NaN, as torch's does.
                    features_out[first + r, o] = Value(wp.where(value < least, least, value))

    return convolve_and_finish_blocks


@cache
def make_convolve_backward_blocks(Value: type, Weight: type) -> wp.Kernel:
    """The same for both gradients."""

    @wp.kernel(module="unique", launch_bounds=(BLOCK, BLOCKS), module_options=BLOCK_OPTIONS, enable_backward=False)
    def convolve_backward_blocks(
        # In:
        features: wp.array2d[Value],  # [N, C_in]
        gradient: wp.array2d[Value],  # [M, C_out]
        weight: wp.array3d[Weight],  # [K, C_in, C_out]
        table: wp.array2d[int],  # [K, N] row of `gradient` that each source reaches, -1 = none
        mirrored: int,  # 1 = the rows of `table` are those of the offsets in reverse
        identity: int,  # offset that connects every voxel with itself, -1 = none
        addend: wp.array2d[Value],  # [N, C_in] added to the gradient of the features, or empty
        feature_blocks: int,  # blocks for that gradient; the others are for the weights
        walked: wp.array2d[int],  # [K, M] source of each target, or [K, N] the other way round, not mirrored
        by_source: int,  # 1 = the latter
        shares: int,  # of the walk
        partial: wp.array[float],  # scratch [shares, K, C_in, C_out], if there are several
        arrived: wp.array[int],  # scratch [K squares], zero
        # Out:
        features_out: wp.array2d[Value],  # [N, C_in], or empty
        weight_out: wp.array3d[Weight],  # [K, C_in, C_out], or empty
    ):
        """Both gradients; one block per 128 sources and 32 C_in, and one per share, offset and 32 x 32 weights."""
        block, t = wp.tid()
        used = wp.tile_zeros(shape=(MAX_OFFSETS,), dtype=float, storage="shared")
        read = wp.tile_empty(shape=(TARGETS,), dtype=int, storage="shared")
        rows = wp.tile_empty(shape=(wp.static(CHANNELS * STRIDE),), dtype=float, storage="shared")
        weights = wp.tile_empty(shape=(wp.static(CHANNELS * WIDTH),), dtype=float, storage="shared")
        marks = wp.tile_empty(shape=(BLOCK,), dtype=int, storage="shared")
        groups = wp.tile_empty(shape=(wp.static(BLOCK // GROUP),), dtype=int, storage="shared")
        walkers = wp.tile_empty(shape=(BLOCK,), dtype=int, storage="shared")
        others = wp.tile_empty(shape=(BLOCK,), dtype=int, storage="shared")
        flag = wp.tile_empty(shape=(1,), dtype=int, storage="shared")
        barrier()
        if block < feature_blocks:
            channels = features_out.shape[1]
            across = (channels + CHANNELS - 1) / CHANNELS
            first = (block / across) * TARGETS
            first_output = (block % across) * CHANNELS
            count = wp.min(TARGETS, features_out.shape[0] - first)
            products = sum_products(
                gradient,
                weight,
                1,
                table,
                mirrored,
                identity,
                first,
                first_output,
                count,
                channels,
                t,
                used,
                read,
                rows,
                weights,
            )
            share_products(products, t, rows)
            o = first_output + t % CHANNELS
            if o < channels:
                for r in range(t / CHANNELS, count, LANES):
                    value = wp.tile_extract(rows, STRIDE * (t % CHANNELS) + r)
                    if addend.shape[0] > 0:
                        value += float(addend[first + r, o])
                    features_out[first + r, o] = Value(value)
        else:
            place = block - feature_blocks
            across = (weight_out.shape[2] + CHANNELS - 1) / CHANNELS
            squares = (weight_out.shape[1] + CHANNELS - 1) / CHANNELS * across
            square = place % squares
            k = place / squares % weight_out.shape[0]
            share = place / squares / weight_out.shape[0]
            first_input = square / across * CHANNELS
            first_output = square % across * CHANNELS
            sums = sum_weights(
                features,
                gradient,
                walked,
                by_source,
                identity,
                share,
                shares,
                k,
                first_input,
                first_output,
                t,
                marks,
                groups,
                walkers,
                others,
                rows,
                weights,
            )
            size = weight_out.shape[0] * weight_out.shape[1] * weight_out.shape[2]
            for i in range(2):
                for j in range(2):
                    c = first_input + t / 16 + 16 * i
                    o = first_output + t % 16 + 16 * j
                    if c < weight_out.shape[1] and o < weight_out.shape[2]:
                        if shares == 1:
                            weight_out[k, c, o] = Weight(sums[2 * i + j])
                        else:
                            at = (k * weight_out.shape[1] + c) * weight_out.shape[2] + o
                            partial[share * size + at] = sums[2 * i + j]
            if shares > 1 and comes_last(arrived, k * squares + square, shares, t, flag):
                for i in range(2):
                    for j in range(2):
                        c = first_input + t / 16 + 16 * i
                        o = first_output + t % 16 + 16 * j
                        if c < weight_out.shape[1] and o < weight_out.shape[2]:
                            at = (k * weight_out.shape[1] + c) * weight_out.shape[2] + o
                            total = float(0.0)
                            for other in range(shares):
                                total += latest(partial, other * size + at)
                            weight_out[k, c, o] = Weight(total)

    return convolve_backward_blocks
