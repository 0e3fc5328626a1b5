"""The gradient of a convolution's weights, block schedule (CUDA): x[source]^T v[target] summed over the pairs.

A table is walked entry by entry, those without a pair are left out, and the walk is shared out among blocks.
"""

from typing import Any

import warp as wp

from sgwarp.kernels.blocks import BLOCK, barrier, put, put_int
from sgwarp.kernels.sparse.products_block import CHANNELS
from sgwarp.kernels.transmittance import BLOCK_OPTIONS

wp.set_module_options(BLOCK_OPTIONS)

PAIRS = 32  # staged at a time
GROUP = 16  # entries of a table whose pairs are counted by one thread
Quarter = wp.types.vector(length=4, dtype=wp.float32)


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
    features: wp.array2d[Any],
    gradient: wp.array2d[Any],
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
                    x = float(features[wp.where(by_source != 0, walker, other), c])
                if o < gradient.shape[1]:
                    v = float(gradient[wp.where(by_source != 0, other, walker), o])
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
