"""Sparse convolution, block schedule (CUDA): one launch for a layer, one for each of its gradients.

An implicit product of matrices: a block owns 128 target voxels and 32 output channels, and for each offset of the
kernel and 32 input channels stages the rows that its targets read, and the weights, in shared memory. A thread keeps 16
sums in registers, eight reads for 16 multiplications. Offsets without a pair in the block are skipped; nothing is
written but the result, once, so that the order of the sums is fixed. The gradient of the weights sums pairs, offset by
offset.
"""

import warp as wp

from sgwarp.kernels.blocks import BLOCK, barrier, put
from sgwarp.kernels.transmittance import BLOCK_OPTIONS

wp.set_module_options(BLOCK_OPTIONS)

TARGETS = 128  # rows that a block owns
CHANNELS = 32  # staged at a time, and output channels that a block owns
OWN = 4  # rows and columns of a thread
MAX_OFFSETS = 128  # of a kernel
STRIDE = TARGETS + 1  # floats between two channels of the staged rows
PAIRS = 32  # staged at a time
Products = wp.types.vector(length=OWN * OWN, dtype=wp.float32)
Quarter = wp.types.vector(length=4, dtype=wp.float32)


@wp.kernel
def tabulate_pairs(
    # In:
    sources: wp.array[wp.int64],  # [pairs] row that is read, offset by offset
    targets: wp.array[wp.int64],  # [pairs] row that is written
    starts: wp.array[int],  # [K + 1] first pair of each offset
    # Out:
    by_target_out: wp.array2d[int],  # [K, M] source of each target, -1 where it has none
    by_source_out: wp.array2d[int],  # [K, N] the other way round
):
    """Pairs as two tables; a row stands at most once within an offset, on either side."""
    pair = wp.tid()
    low = int(0)
    high = starts.shape[0] - 1
    while high - low > 1:
        middle = (low + high) / 2
        if starts[middle] <= pair:
            low = middle
        else:
            high = middle
    source = int(sources[pair])
    target = int(targets[pair])
    by_target_out[low, target] = source
    by_source_out[low, source] = target


@wp.kernel
def convolve_blocks(
    # In:
    features: wp.array2d[float],  # [N, C_in]
    weight: wp.array3d[float],  # [K, C_in, C_out]
    table: wp.array2d[int],  # [K, M] row of `features` that each target reads, -1 = none
    identity: int,  # offset that connects every voxel with itself and is not in the table, -1 = none
    # Out:
    features_out: wp.array2d[float],  # [M, C_out]
):
    """Sum over the offsets; one block per 128 targets and 32 output channels."""
    part, group, t = wp.tid()
    first = part * TARGETS
    first_output = group * CHANNELS
    count = wp.min(TARGETS, features_out.shape[0] - first)
    used = wp.tile_zeros(shape=(MAX_OFFSETS,), dtype=float, storage="shared")
    rows = wp.tile_empty(shape=(wp.static(CHANNELS * STRIDE),), dtype=float, storage="shared")
    weights = wp.tile_empty(shape=(wp.static(CHANNELS * CHANNELS),), dtype=float, storage="shared")
    barrier()
    for e in range(t, weight.shape[0] * TARGETS, BLOCK):
        if e % TARGETS < count and (e / TARGETS == identity or table[e / TARGETS, first + e % TARGETS] >= 0):
            put(used, e / TARGETS, 1.0)
    barrier()
    row = t / 8  # a thread's rows are this and each 32nd after it, its columns each eighth
    column = t % 8
    products = Products(0.0)
    for k in range(weight.shape[0]):
        if wp.tile_extract(used, k) != 0.0:
            for c0 in range(0, weight.shape[1], CHANNELS):
                for e in range(t, wp.static(TARGETS * CHANNELS), BLOCK):
                    r = e / CHANNELS
                    c = e % CHANNELS
                    value = float(0.0)
                    if r < count and c0 + c < weight.shape[1]:
                        source = first + r
                        if k != identity:
                            source = table[k, first + r]
                        if source >= 0:
                            value = features[source, c0 + c]
                    put(rows, STRIDE * c + r, value)
                for e in range(t, wp.static(CHANNELS * CHANNELS), BLOCK):
                    c = c0 + e / CHANNELS
                    o = first_output + e % CHANNELS
                    value = float(0.0)
                    if c < weight.shape[1] and o < weight.shape[2]:
                        value = weight[k, c, o]
                    put(weights, e, value)
                barrier()
                for c in range(CHANNELS):
                    for i in range(OWN):
                        x = wp.tile_extract(rows, STRIDE * c + row + 32 * i)
                        for j in range(OWN):
                            w = wp.tile_extract(weights, CHANNELS * c + column + 8 * j)
                            products[OWN * i + j] = products[OWN * i + j] + x * w
                barrier()
    for i in range(OWN):
        for j in range(OWN):
            r = row + 32 * i
            o = first_output + column + 8 * j
            if r < count and o < weight.shape[2]:
                features_out[first + r, o] = products[OWN * i + j]


@wp.kernel
def sum_weight_blocks(
    # In:
    features: wp.array2d[float],  # [N, C_in]
    gradient: wp.array2d[float],  # [M, C_out]
    sources: wp.array[wp.int64],  # [pairs]
    targets: wp.array[wp.int64],  # [pairs]
    starts: wp.array[int],  # [K + 1]
    identity: int,
    # Out:
    weight_out: wp.array4d[float],  # [shares, K, C_in, C_out] sums over a share of the pairs
):
    """x[sources]^T v[targets] of every offset; one block per (share of the pairs, offset, 32 x 32 weights)."""
    share, k, square, t = wp.tid()
    squares = (weight_out.shape[3] + CHANNELS - 1) / CHANNELS
    first_input = (square / squares) * CHANNELS
    first_output = (square % squares) * CHANNELS
    begin = starts[k]
    count = starts[k + 1] - begin
    if k == identity:
        begin = 0
        count = gradient.shape[0]
    per_share = (count + weight_out.shape[0] - 1) / weight_out.shape[0]
    stop = wp.min(count, (share + 1) * per_share)
    inputs = wp.tile_empty(shape=(wp.static(PAIRS * CHANNELS),), dtype=float, storage="shared")
    outputs = wp.tile_empty(shape=(wp.static(PAIRS * CHANNELS),), dtype=float, storage="shared")
    row = t / 16  # a thread's weights are rows `row` and `row` + 16, columns `column` and `column` + 16
    column = t % 16
    sums = Quarter(0.0)
    for start in range(share * per_share, stop, PAIRS):
        for e in range(t, wp.static(PAIRS * CHANNELS), BLOCK):
            p = start + e / CHANNELS
            c = first_input + e % CHANNELS
            o = first_output + e % CHANNELS
            x = float(0.0)
            v = float(0.0)
            if p < stop:
                source = p
                target = p
                if k != identity:
                    source = int(sources[begin + p])
                    target = int(targets[begin + p])
                if c < weight_out.shape[2]:
                    x = features[source, c]
                if o < weight_out.shape[3]:
                    v = gradient[target, o]
            put(inputs, e, x)
            put(outputs, e, v)
        barrier()
        for p in range(PAIRS):
            for i in range(2):
                x = wp.tile_extract(inputs, CHANNELS * p + row + 16 * i)
                for j in range(2):
                    v = wp.tile_extract(outputs, CHANNELS * p + column + 16 * j)
                    sums[2 * i + j] = sums[2 * i + j] + x * v
        barrier()
    for i in range(2):
        for j in range(2):
            c = first_input + row + 16 * i
            o = first_output + column + 16 * j
            if c < weight_out.shape[2] and o < weight_out.shape[3]:
                weight_out[share, k, c, o] = sums[2 * i + j]
