"""The sums of a sparse convolution, block schedule (CUDA): an implicit product of matrices.

A block owns 128 target voxels and 32 output channels, and for each offset of the kernel and 32 input channels stages
the rows that its targets read, and the weights, in shared memory. A thread keeps 16 sums in registers, eight reads for
16 multiplications. Offsets without a pair in the block are skipped.
"""

from typing import Any

import warp as wp

from sgwarp.kernels.blocks import BLOCK, barrier, put, put_int
from sgwarp.kernels.transmittance import BLOCK_OPTIONS

wp.set_module_options(BLOCK_OPTIONS)

TARGETS = 128  # rows that a block owns
CHANNELS = 32  # staged at a time, and output channels that a block owns
OWN = 4  # rows and columns of a thread
STRIDE = TARGETS + 1  # floats between two channels of the staged rows
WIDTH = CHANNELS + 1  # floats between two channels of the staged weights
LANES = BLOCK // CHANNELS  # threads that share a channel
Products = wp.types.vector(length=OWN * OWN, dtype=wp.float32)


@wp.func
def sum_products(
    features: wp.array2d[Any],  # of any precision; the sums are float32
    weight: wp.array3d[Any],  # [K, C_in, C_out], rounded to the precision of the features
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
                        value = float(features[source, c0 + c])
                    put(rows, STRIDE * c + r, value)
                near = t % CHANNELS
                for far in range(t / CHANNELS, CHANNELS, LANES):
                    # Neighbouring threads read neighbouring weights.
                    c = wp.where(turned != 0, near, far)
                    o = wp.where(turned != 0, far, near)
                    value = float(0.0)
                    if c0 + c < inputs and first_output + o < outputs:
                        if turned != 0:
                            value = float(features.dtype(weight[k, first_output + o, c0 + c]))
                        else:
                            value = float(features.dtype(weight[k, c0 + c, first_output + o]))
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
