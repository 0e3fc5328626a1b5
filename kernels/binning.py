"""Tile lists: which splats touch which 16 x 16 tile, front to back.

Gaussians are sorted once by (depth, index); a stable counting pass then writes every tile's list in that order, so
the intersections themselves are never sorted. On the CPU the counting pass runs in slices of the depth order: each
slice counts its own tiles, prefix sums turn the counts into disjoint places, and each slice fills them. Any number of
threads writes the same lists (`binning_lanes.py`).

On CUDA one thread per Gaussian emits its (tile, entry) pairs in depth order; a stable radix sort by tile alone then
gives the same lists.

A list holds ranks, places in the depth order, where the splats lie one to a line of the cache. Copies of the splats,
tile by tile, could be read front to back, but cost more to write than that saves. A place is a position in the lists,
an entry an intersection (one splat in one tile) counted splat by splat.
"""

import warp as wp

from sgwarp.kernels.gaussian import EXACT_OPTIONS, Splat, column_range
from sgwarp.kernels.projection.forward import VISIBLE

wp.set_module_options(EXACT_OPTIONS)

TILE = wp.constant(16)  # side of a tile [pixels]
AHEAD = wp.constant(6)  # splats between the one at work and the one that is fetched: each is a line of its own


@wp.func
def tile_rows(splat: Splat, height: int):
    """First and last tile row that the footprint touches; empty if first > last."""
    first = int(wp.ceil(wp.clamp(splat.mean[1] - splat.half_height - 0.5, 0.0, float(height))))
    last = int(wp.floor(wp.clamp(splat.mean[1] + splat.half_height - 0.5, -1.0, float(height - 1))))
    if first > last:
        return 1, 0
    return first / TILE, last / TILE


@wp.func
def box_columns(splat: Splat, width: int):
    """First and last tile column that the footprint's bounding box touches; empty if first > last."""
    first = int(wp.ceil(wp.clamp(splat.mean[0] - splat.half_width - 0.5, 0.0, float(width))))
    last = int(wp.floor(wp.clamp(splat.mean[0] + splat.half_width - 0.5, -1.0, float(width - 1))))
    if first > last:
        return 1, 0
    return first / TILE, last / TILE


@wp.func
def tile_columns(splat: Splat, row: int, width: int):
    """First and last tile column that the footprint touches within a tile row; empty if first > last."""
    top = float(row * TILE) + 0.5
    left, right = column_range(splat, top, top + float(TILE - 1))
    first = int(wp.ceil(wp.clamp(left - 0.5, 0.0, float(width))))
    last = int(wp.floor(wp.clamp(right - 0.5, -1.0, float(width - 1))))
    if first > last:
        return 1, 0
    return first / TILE, last / TILE


@wp.func
def row_columns(splat: Splat, row: int, width: int, box_first: int, box_last: int):
    """`tile_columns`, without its square roots where the bounding box is one tile wide and not cut by the image."""
    first = box_first
    last = box_last
    cut = splat.mean[0] < splat.half_width or splat.mean[0] + splat.half_width > float(width)
    if box_first < box_last or cut:
        first, last = tile_columns(splat, row, width)
    return first, last


@wp.func_native("""
#if !defined(__CUDA_ARCH__)
    if (i < splats.shape[0]) __builtin_prefetch(splats.data + i);
#endif
""")
def prefetch(splats: wp.array[Splat], i: int): ...  # a hint for the CPU's cache


@wp.func
def order_splat(
    rank: int,
    order: wp.array[int],
    splats: wp.array[Splat],
    colors: wp.array[wp.vec3],
    ordered_out: wp.array[Splat],
):
    """Bring a splat to its place in the depth order, with its Gaussian and, where colours travel along, its colour."""
    ordered_out[rank] = splats[order[rank]]
    ordered_out[rank].gaussian = order[rank]
    if colors.shape[0] > 0:
        ordered_out[rank].color = colors[rank]


@wp.kernel
def order_splats(
    # In:
    base: int,  # first rank of this launch
    order: wp.array[int],  # [V] Gaussians
    splats: wp.array[Splat],  # [N]
    colors: wp.array[wp.vec3],  # [V] or empty
    # Out:
    ordered_out: wp.array[Splat],  # [V]
):
    """Bring the splats into a given order, for lists that were made elsewhere; counting does it on its way."""
    order_splat(base + wp.tid(), order, splats, colors, ordered_out)


@wp.kernel
def count_splat_tiles(
    # In:
    order: wp.array[int],  # [V] Gaussians by (depth, index), the culled last
    splats: wp.array[Splat],  # [N]
    colors: wp.array[wp.vec3],  # [V] or empty
    status: wp.array[wp.uint8],  # [N]
    width: int,
    height: int,
    # Out:
    ordered_out: wp.array[Splat],  # [V] in depth order
    splat_counts_out: wp.array[int],  # [V] tiles that each splat touches
):
    """Bring the splats into depth order and count their intersections (CUDA)."""
    k = wp.tid()
    total = int(0)
    if int(status[order[k]]) == VISIBLE:
        prefetch(splats, order[wp.min(k + AHEAD, order.shape[0] - 1)])
        order_splat(k, order, splats, colors, ordered_out)
        splat = splats[order[k]]
        box_first, box_last = box_columns(splat, width)
        first_row, last_row = tile_rows(splat, height)
        for row in range(first_row, last_row + 1):
            first, last = row_columns(splat, row, width, box_first, box_last)
            total += wp.max(last - first + 1, 0)
    splat_counts_out[k] = total


@wp.kernel
def emit_tiles(
    # In:
    splats: wp.array[Splat],  # [V] in depth order
    width: int,
    height: int,
    entries: wp.array[int],  # [V + 1] first entry of each splat; the culled have none
    # Out:
    tiles_out: wp.array[int],  # [I] tile of each entry, the sort key
    intersections_out: wp.array[int],  # [I] the entry itself, the sort value
    ranks_out: wp.array[int],  # [I] rank of each entry
):
    """List the tiles of each splat, row by row (CUDA)."""
    k = wp.tid()
    entry = entries[k]
    stop = entries[k + 1]
    if stop == entry:
        return
    columns = (width + TILE - 1) / TILE
    splat = splats[k]
    box_first, box_last = box_columns(splat, width)
    first_row, last_row = tile_rows(splat, height)
    for row in range(first_row, last_row + 1):
        first, last = row_columns(splat, row, width, box_first, box_last)
        # Where the lists were given too little room, `stop` comes before the last tile.
        for column in range(first, wp.min(last, first + stop - entry - 1) + 1):
            tiles_out[entry] = row * columns + column
            intersections_out[entry] = entry
            ranks_out[entry] = k
            entry += 1


@wp.kernel
def list_sorted(
    # In:
    sorted_intersections: wp.array[int],  # [I] entries, by place
    ranks: wp.array[int],  # [I] rank of each entry
    # Out:
    listed_out: wp.array[int],  # [I] ranks of the splats, tile by tile, front to back
    places_out: wp.array[int],  # [I] place of each entry
):
    """Read the lists off the sorted intersections (CUDA). One thread per place."""
    place = wp.tid()
    entry = sorted_intersections[place]
    listed_out[place] = ranks[entry]
    places_out[entry] = place
