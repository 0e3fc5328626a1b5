"""Sparse convolution, block schedule (CUDA): one launch for a layer, one for both of its gradients.

An implicit product of matrices: a block owns 128 target voxels and 32 output channels, and for each offset of the
kernel and 32 input channels stages the rows that its targets read, and the weights, in shared memory. A thread keeps 16
sums in registers, eight reads for 16 multiplications. Offsets without a pair in the block are skipped; nothing is
written but the result, once, so that the order of the sums is fixed.

What follows a convolution is done while its sums are at hand. In training a block leaves mean and squared deviations of
its rows, and the last block of a channel joins them in double precision; in inference the sums are normalised, a
shortcut is added, and what is negative becomes zero.

The gradient of the weights walks a table entry by entry, leaves out the entries without a pair, and shares the walk
out; the last block of 32 x 32 weights adds the shares up.
"""

import warp as wp

from sgwarp.kernels.blocks import BLOCK, barrier, comes_last, latest, latest_double, put, put_double, put_int
from sgwarp.kernels.transmittance import BLOCK_OPTIONS

wp.set_module_options(BLOCK_OPTIONS)

TARGETS = 128  # rows that a block owns
CHANNELS = 32  # staged at a time, and output channels that a block owns
OWN = 4  # rows and columns of a thread
MAX_OFFSETS = 128  # of a kernel
STRIDE = TARGETS + 1  # floats between two channels of the staged rows
WIDTH = CHANNELS + 1  # floats between two channels of the staged weights
LANES = BLOCK // CHANNELS  # threads that share a channel
PAIRS = 32  # staged at a time
BLOCKS = 3  # that a multiprocessor should hold: no more than 80 registers
GROUP = 16  # entries of a table whose pairs are counted by one thread
Products = wp.types.vector(length=OWN * OWN, dtype=wp.float32)
Quarter = wp.types.vector(length=4, dtype=wp.float32)


@wp.func
def sum_products(
    features: wp.array2d[float],
    weight: wp.array3d[float],  # [K, C_in, C_out]
    turned: int,  # whether it is multiplied from its other side
    table: wp.array2d[int],
    mirrored: int,  # whether the table's rows are those of the offsets in reverse
    identity: int,
    first: int,  # row of the result
    first_output: int,
    count: int,  # rows of this block
    outputs: int,  # channels of the result
    t: int,
    used: wp.tile[float],
    read: wp.tile[int],
    rows: wp.tile[float],
    weights: wp.tile[float],
) -> Products:
    """A thread's part of the result: rows t / 8 and each 32nd after it, columns t % 8 and each eighth after it."""
    offsets = weight.shape[0]
    inputs = features.shape[1]
    for e in range(t, offsets * TARGETS, BLOCK):
        k = e / TARGETS
        place = wp.where(mirrored != 0, offsets - 1 - k, k)
        if e % TARGETS < count and (k == identity or table[place, first + e % TARGETS] >= 0):
            put(used, k, 1.0)
    barrier()
    row = t / 8
    column = t % 8
    products = Products(0.0)
    for k in range(offsets):
        if wp.tile_extract(used, k) != 0.0:
            if t < TARGETS:
                source = int(-1)
                if t < count:
                    source = first + t
                    if k != identity:
                        source = table[wp.where(mirrored != 0, offsets - 1 - k, k), first + t]
                put_int(read, t, source)
            barrier()
            for c0 in range(0, inputs, CHANNELS):
                c = t % CHANNELS
                for r in range(t / CHANNELS, TARGETS, LANES):
                    source = wp.tile_extract(read, r)
                    value = float(0.0)
                    if source >= 0 and c0 + c < inputs:
                        value = features[source, c0 + c]
                    put(rows, STRIDE * c + r, value)
                near = t % CHANNELS
                for far in range(t / CHANNELS, CHANNELS, LANES):
                    # Neighbouring threads read neighbouring weights.
                    c = wp.where(turned != 0, near, far)
                    o = wp.where(turned != 0, far, near)
                    value = float(0.0)
                    if c0 + c < inputs and first_output + o < outputs:
                        if turned != 0:
                            value = weight[k, first_output + o, c0 + c]
                        else:
                            value = weight[k, c0 + c, first_output + o]
                    put(weights, WIDTH * c + o, value)
                barrier()
                for c in range(CHANNELS):
                    for i in range(OWN):
                        x = wp.tile_extract(rows, STRIDE * c + row + 32 * i)
                        for j in range(OWN):
                            w = wp.tile_extract(weights, WIDTH * c + column + 8 * j)
                            products[OWN * i + j] = products[OWN * i + j] + x * w
                barrier()
    return products


@wp.func
def share_products(products: Products, t: int, rows: wp.tile[float]):
    """To shared memory, channel by channel; the threads of a warp then write neighbouring channels of a row."""
    for i in range(OWN):
        for j in range(OWN):
            put(rows, STRIDE * (t % 8 + 8 * j) + t / 8 + 32 * i, products[OWN * i + j])
    barrier()


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
    mean_out: wp.array[float],
    variance_out: wp.array[float],
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
        mean_out[o] = (1.0 - momentum) * mean_out[o] + momentum * high
        variance_out[o] = (1.0 - momentum) * variance_out[o] + momentum * unbiased


@wp.kernel(launch_bounds=(BLOCK, BLOCKS))
def convolve_blocks(
    # In:
    features: wp.array2d[float],  # [N, C_in]
    weight: wp.array3d[float],  # [K, C_in, C_out]
    table: wp.array2d[int],  # [K, M] row of `features` that each target reads, -1 = none
    mirrored: int,  # 1 = the table's rows are those of the offsets in reverse
    identity: int,  # offset that connects every voxel with itself, -1 = none
    epsilon: float,  # added to the variance
    momentum: float,  # weight of this batch in the running statistics
    moments: wp.array[wp.float64],  # scratch [parts, C_out, 2]
    arrived: wp.array[int],  # scratch [groups of 32 C_out], zero
    # Out:
    features_out: wp.array2d[float],  # [M, C_out]
    statistics_out: wp.array2d[float],  # [3, C_out] mean, what float32 leaves of it, 1 / deviation; or empty
    mean_out: wp.array[float],  # [C_out] running, changed
    variance_out: wp.array[float],  # [C_out] running, changed
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
            features_out[first + r, o] = wp.tile_extract(rows, STRIDE * (t % CHANNELS) + r)
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


@wp.kernel(launch_bounds=(BLOCK, BLOCKS))
def convolve_and_finish_blocks(
    # In:
    features: wp.array2d[float],  # [N, C_in]
    weight: wp.array3d[float],  # [K, C_in, C_out]
    table: wp.array2d[int],  # [K, M] as above
    mirrored: int,
    identity: int,
    mean: wp.array[float],  # [C_out] running
    variance: wp.array[float],  # [C_out] running
    epsilon: float,  # added to the variance
    gain: wp.array[float],  # [C_out]
    bias: wp.array[float],  # [C_out]
    shortcut: wp.array2d[float],  # [M, C_out], or empty
    least: float,  # value: 0, or -inf for no rectification
    beside: wp.array2d[float],  # [M, S] further channels, copied; or empty
    # Out:
    features_out: wp.array2d[float],  # [M, C_out + S]
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
            scale = gain[o] / wp.sqrt(variance[o] + epsilon)
            for r in range(t / CHANNELS, count, LANES):
                value = (wp.tile_extract(rows, STRIDE * (t % CHANNELS) + r) - mean[o]) * scale + bias[o]
                if shortcut.shape[0] > 0:
                    value += shortcut[first + r, o]
                # The comparison keeps NaN, as torch's does.
                features_out[first + r, o] = wp.where(value < least, least, value)


@wp.func
def list_pairs_of_window(
    walked: wp.array2d[int],
    k: int,
    identity: int,
    entry: int,
    stop: int,
    t: int,
    marks: wp.tile[int],
    groups: wp.tile[int],
    walkers: wp.tile[int],
    others: wp.tile[int],
) -> int:
    """Of 256 entries of a table those that have a pair, in their order; how many there are."""
    other = int(-1)
    if entry < stop:
        other = entry
        if k != identity:
            other = walked[k, entry]
    put_int(marks, t, wp.where(other >= 0, 1, 0))
    barrier()
    if t < wp.static(BLOCK // GROUP):
        marked = int(0)
        for e in range(GROUP):
            marked += wp.tile_extract(marks, GROUP * t + e)
        put_int(groups, t, marked)
    barrier()
    place = int(0)
    total = int(0)
    for group in range(wp.static(BLOCK // GROUP)):
        marked = wp.tile_extract(groups, group)
        place += wp.where(group < t / GROUP, marked, 0)
        total += marked
    for e in range(t - t % GROUP, t):
        place += wp.tile_extract(marks, e)
    if other >= 0:
        put_int(walkers, place, entry)
        put_int(others, place, other)
    barrier()
    return total


@wp.func
def sum_weights(
    features: wp.array2d[float],
    gradient: wp.array2d[float],
    walked: wp.array2d[int],
    by_source: int,
    identity: int,
    share: int,
    shares: int,
    k: int,
    first_input: int,
    first_output: int,
    t: int,
    marks: wp.tile[int],
    groups: wp.tile[int],
    walkers: wp.tile[int],
    others: wp.tile[int],
    inputs: wp.tile[float],
    outputs: wp.tile[float],
) -> Quarter:
    """A thread's part of a square: rows t / 16 and 16 after it, columns t % 16 and 16 after it."""
    entries = wp.where(by_source != 0, features.shape[0], gradient.shape[0])
    per_share = (entries + shares - 1) / shares
    stop = wp.min(entries, (share + 1) * per_share)
    row = t / 16
    column = t % 16
    sums = Quarter(0.0)
    for begin in range(share * per_share, stop, BLOCK):
        total = list_pairs_of_window(walked, k, identity, begin + t, stop, t, marks, groups, walkers, others)
        for start in range(0, total, PAIRS):
            here = wp.min(PAIRS, total - start)
            for e in range(t, here * CHANNELS, BLOCK):
                c = first_input + e % CHANNELS
                o = first_output + e % CHANNELS
                walker = wp.tile_extract(walkers, start + e / CHANNELS)
                other = wp.tile_extract(others, start + e / CHANNELS)
                x = float(0.0)
                v = float(0.0)
                if c < features.shape[1]:
                    x = features[wp.where(by_source != 0, walker, other), c]
                if o < gradient.shape[1]:
                    v = gradient[wp.where(by_source != 0, other, walker), o]
                put(inputs, e, x)
                put(outputs, e, v)
            barrier()
            for p in range(here):
                for i in range(2):
                    x = wp.tile_extract(inputs, CHANNELS * p + row + 16 * i)
                    for j in range(2):
                        v = wp.tile_extract(outputs, CHANNELS * p + column + 16 * j)
                        sums[2 * i + j] = sums[2 * i + j] + x * v
            barrier()
    return sums


@wp.kernel(launch_bounds=(BLOCK, BLOCKS))
def convolve_backward_blocks(
    # In:
    features: wp.array2d[float],  # [N, C_in]
    gradient: wp.array2d[float],  # [M, C_out]
    weight: wp.array3d[float],  # [K, C_in, C_out]
    table: wp.array2d[int],  # [K, N] row of `gradient` that each source reaches, -1 = none
    mirrored: int,  # 1 = the rows of `table` are those of the offsets in reverse
    identity: int,  # offset that connects every voxel with itself, -1 = none
    addend: wp.array2d[float],  # [N, C_in] added to the gradient of the features, or empty
    feature_blocks: int,  # blocks for that gradient; the others are for the weights
    walked: wp.array2d[int],  # [K, M] source of each target, or [K, N] the other way round, not mirrored
    by_source: int,  # 1 = the latter
    shares: int,  # of the walk
    partial: wp.array[float],  # scratch [shares, K, C_in, C_out], if there are several
    arrived: wp.array[int],  # scratch [K squares], zero
    # Out:
    features_out: wp.array2d[float],  # [N, C_in], or empty
    weight_out: wp.array3d[float],  # [K, C_in, C_out], or empty
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
                    value += addend[first + r, o]
                features_out[first + r, o] = value
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
                        weight_out[k, c, o] = sums[2 * i + j]
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
                        weight_out[k, c, o] = total
