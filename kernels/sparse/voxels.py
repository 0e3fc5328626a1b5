"""Voxels as sorted integer keys, and kernel maps: which voxel lies at which offset of which other.

A key packs a batch number (12 bits) and x, y, z (17 bits each, moved up by 2^16 so that no field is negative). An
offset is then one constant added to a key, and clearing the low bits of a field rounds down, below zero as well. Adding
an offset keeps sorted keys sorted, so a kernel map is a merge of two sorted lists: no hash, no atomics.
"""

from functools import cache

import warp as wp

from sgwarp.kernels.gaussian import EXACT_OPTIONS

wp.set_module_options(EXACT_OPTIONS)

AXIS_BITS = wp.constant(17)
BATCH_BITS = wp.constant(12)
BIAS = wp.constant(65536)  # 2^(AXIS_BITS - 1)
LIMIT = wp.constant(65280)  # |coordinate| stays below: the margin of 256 keeps a carry out of the next field


@wp.func
def pack_voxel(batch: int, x: int, y: int, z: int) -> wp.int64:
    """Key of a voxel; keys in increasing order are rows in lexicographic order of (batch, x, y, z)."""
    key = wp.int64(batch)
    key = (key << wp.int64(AXIS_BITS)) + wp.int64(x + BIAS)
    key = (key << wp.int64(AXIS_BITS)) + wp.int64(y + BIAS)
    return (key << wp.int64(AXIS_BITS)) + wp.int64(z + BIAS)


@wp.func
def first_not_below(keys: wp.array[wp.int64], key: wp.int64) -> int:
    """Place of the first of the sorted keys that is not smaller than `key`."""
    low = int(0)
    high = keys.shape[0]
    while low < high:
        middle = (low + high) / 2
        if keys[middle] < key:
            low = middle + 1
        else:
            high = middle
    return low


@wp.kernel
def key_points(
    # In:
    base: int,  # first point of this launch
    points: wp.array[wp.vec3],  # [N] [m]
    origin: wp.vec3d,  # corner of voxel (0, 0, 0) [m]
    size: wp.float64,  # side of a voxel [m]
    batch: int,  # batch number of all these points
    # Out:
    keys_out: wp.array[wp.int64],  # [N], -1 where not finite or out of range
):
    """Voxel of every point, floor((point - origin) / size) in double precision."""
    i = base + wp.tid()
    p = points[i]
    x = wp.floor((wp.float64(p[0]) - origin[0]) / size)
    y = wp.floor((wp.float64(p[1]) - origin[1]) / size)
    z = wp.floor((wp.float64(p[2]) - origin[2]) / size)
    limit = wp.float64(LIMIT)
    key = wp.int64(-1)
    if wp.abs(x) < limit and wp.abs(y) < limit and wp.abs(z) < limit:  # false for NaN as well
        key = pack_voxel(batch, int(x), int(y), int(z))
    keys_out[i] = key


@cache
def make_list_pairs(write: bool) -> wp.Kernel:
    """Kernel that counts, offset by offset, the targets whose neighbour at that offset is a source, or lists them."""

    @wp.kernel(module="unique", module_options=EXACT_OPTIONS, enable_backward=False)
    def list_pairs(
        # In:
        base: int,  # first (offset, chunk) of this launch
        steps: wp.array[wp.int64],  # [K] what each offset adds to a key
        sources: wp.array[wp.int64],  # [N] sorted keys of the voxels that are read
        targets: wp.array[wp.int64],  # [M] sorted keys of the voxels that are written
        per_chunk: int,  # targets that one thread walks
        chunks: int,  # of the targets
        places: wp.array[wp.int64],  # [K * chunks] where the pairs of each offset and chunk go; only with `write`
        # Out:
        counts_out: wp.array[int],  # [K * chunks] pairs of each offset and chunk; not written with `write`
        source_rows_out: wp.array[wp.int64],  # [pairs]; only with `write`
        target_rows_out: wp.array[wp.int64],  # [pairs], increasing within an offset; only with `write`
    ):
        """Merge a chunk of the targets, moved by an offset, with the sources."""
        place = base + wp.tid()
        step = steps[place / chunks]
        first = (place % chunks) * per_chunk
        last = wp.min(first + per_chunk, targets.shape[0])
        n = sources.shape[0]
        j = first_not_below(sources, targets[first] + step)
        count = int(0)
        for i in range(first, last):
            wanted = targets[i] + step
            while j < n and sources[j] < wanted:
                j += 1
            if j < n and sources[j] == wanted:
                if wp.static(write):
                    at = places[place] + wp.int64(count)
                    source_rows_out[at] = wp.int64(j)
                    target_rows_out[at] = wp.int64(i)
                count += 1
        if wp.static(not write):
            counts_out[place] = count

    return list_pairs


@wp.func
def row_of(keys: wp.array[wp.int64], key: wp.int64) -> int:
    """Place of a key among the sorted keys, -1 if it is not there."""
    place = first_not_below(keys, key)
    if place < keys.shape[0] and keys[place] == key:
        return place
    return -1


@wp.kernel
def tabulate_neighbors(
    # In:
    side: int,  # of the kernel
    step: int,  # between neighbouring offsets [voxels]
    sources: wp.array[wp.int64],  # [N] sorted keys of the voxels that are read
    targets: wp.array[wp.int64],  # [M] sorted keys of the voxels that are written
    # Out:
    by_target_out: wp.array2d[int],  # [K, M] source of each target, -1 where it has none
    by_source_out: wp.array2d[int],  # [K, N] the other way round, or empty
):
    """Both tables of a kernel map; one thread per offset and voxel. Neighbours search for neighbouring keys."""
    k, i = wp.tid()
    first = -(side / 2) * (side % 2)
    x = wp.int64((first + k % side) * step)
    y = wp.int64((first + k / side % side) * step)
    z = wp.int64((first + k / side / side) * step)
    along = wp.int64(1) << wp.int64(AXIS_BITS)
    added = (x * along + y) * along + z
    if i < targets.shape[0]:
        by_target_out[k, i] = row_of(sources, targets[i] + added)
    else:
        i -= targets.shape[0]
        by_source_out[k, i] = row_of(targets, sources[i] - added)
