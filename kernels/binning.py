"""Tile lists: which splats touch which 16 x 16 tile, front to back.

Gaussians are sorted once by (depth, index); a stable counting pass then writes every tile's list in that order, so
the intersections themselves are never sorted. On the CPU the counting pass runs in slices of the depth order: each
slice counts its own tiles, prefix sums turn the counts into disjoint places, and each slice fills them. Any number of
threads writes the same lists.

On CUDA one thread per Gaussian emits its (tile, intersection) pairs in depth order; a stable radix sort by tile alone
then gives the same lists, and one thread per place packs the fragment.
"""

import warp as wp

from sgwarp.kernels.gaussian import EXACT_OPTIONS, Splat, column_range, footprint, footprint_summit
from sgwarp.kernels.projection import VISIBLE

wp.set_module_options(EXACT_OPTIONS)

TILE = wp.constant(16)  # side of a tile [pixels]


@wp.struct
class Fragment:
    """A splat in one tile's list, packed so that compositing reads memory front to back."""

    x: float  # mean relative to the centre of the tile's first pixel [pixels]
    y: float
    a: float
    b: float
    c: float
    level: float
    depth: float  # [m]
    gaussian: int
    entry: int  # place among all intersections when sorted by Gaussian
    first_row: int  # rows of the tile that the footprint may touch
    last_row: int
    color: wp.vec3


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
def tile_columns(splat: Splat, q: float, summit: float, row: int, width: int):
    """First and last tile column that the footprint touches within a tile row; empty if first > last."""
    top = float(row * TILE) + 0.5
    left, right = column_range(splat, q, summit, top, top + float(TILE - 1))
    first = int(wp.ceil(wp.clamp(left - 0.5, 0.0, float(width))))
    last = int(wp.floor(wp.clamp(right - 0.5, -1.0, float(width - 1))))
    if first > last:
        return 1, 0
    return first / TILE, last / TILE


@wp.func
def row_columns(splat: Splat, q: float, summit: float, row: int, width: int, box_first: int, box_last: int):
    """`tile_columns`, without its square roots where the bounding box is one tile wide and not cut by the image."""
    first = box_first
    last = box_last
    cut = splat.mean[0] < splat.half_width or splat.mean[0] + splat.half_width > float(width)
    if box_first < box_last or cut:
        first, last = tile_columns(splat, q, summit, row, width)
    return first, last


@wp.kernel
def gather_splats(
    # In:
    base: int,  # first entry of `order` in this launch
    order: wp.array[int],  # [V] Gaussians by (depth, index)
    splats: wp.array[Splat],  # [N]
    # Out:
    ordered_out: wp.array[Splat],  # [V]
):
    """Bring the splats into depth order: later passes then read memory front to back instead of waiting for it."""
    k = base + wp.tid()
    ordered_out[k] = splats[order[k]]


@wp.kernel
def count_tiles(
    # In:
    base: int,  # first slice of this launch
    splats: wp.array[Splat],  # [V] visible, by (depth, index)
    per_slice: int,  # splats in a slice
    width: int,  # [pixels]
    height: int,
    alpha_min_level: float,
    # Out:
    tile_counts_out: wp.array2d[int],  # [slices, tiles] zeroed
    splat_counts_out: wp.array[int],  # [V] tiles that each splat touches
):
    """Count intersections per (slice, tile) and per Gaussian. One thread per slice."""
    s = base + wp.tid()
    columns = (width + TILE - 1) / TILE
    for k in range(s * per_slice, wp.min((s + 1) * per_slice, splats.shape[0])):
        splat = splats[k]
        q = footprint(splat, alpha_min_level)
        summit = footprint_summit(splat, q)
        box_first, box_last = box_columns(splat, width)
        total = int(0)
        first_row, last_row = tile_rows(splat, height)
        for row in range(first_row, last_row + 1):
            first, last = row_columns(splat, q, summit, row, width, box_first, box_last)
            for column in range(first, last + 1):
                tile_counts_out[s, row * columns + column] += 1
            total += wp.max(last - first + 1, 0)
        splat_counts_out[k] = total


@wp.func
def fragment_of(splat: Splat, gaussian: int) -> Fragment:
    """What all fragments of a splat share."""
    fragment = Fragment()
    fragment.a = splat.a
    fragment.b = splat.b
    fragment.c = splat.c
    fragment.level = splat.level
    fragment.depth = splat.depth
    fragment.gaussian = gaussian
    return fragment


@wp.func
def in_tile_row(fragment: Fragment, splat: Splat, row: int) -> Fragment:
    """The fragment relative to one row of tiles."""
    fragment.y = splat.mean[1] - float(row * TILE) - 0.5
    fragment.first_row = int(wp.ceil(wp.clamp(fragment.y - splat.half_height, 0.0, float(TILE))))
    fragment.last_row = int(wp.floor(wp.clamp(fragment.y + splat.half_height, -1.0, float(TILE - 1))))
    return fragment


@wp.kernel
def fill_tiles(
    # In:
    base: int,
    order: wp.array[int],  # [V]
    splats: wp.array[Splat],  # [V]
    colors: wp.array[wp.vec3],  # [V] or empty
    per_slice: int,
    width: int,
    height: int,
    alpha_min_level: float,
    entries: wp.array[int],  # [V] first intersection of each entry, by Gaussian
    # In and out:
    cursors: wp.array2d[int],  # [slices, tiles] next free place of each (slice, tile)
    # Out:
    fragments_out: wp.array[Fragment],  # [I] tile by tile, front to back
    places_out: wp.array[int],  # [I] position in the tile lists of each intersection, by Gaussian; or empty
    tiles_out: wp.array[int],  # [I] its tile; or empty
):
    """Write the tile lists. One thread per slice; the cursors keep slices apart."""
    s = base + wp.tid()
    columns = (width + TILE - 1) / TILE
    for k in range(s * per_slice, wp.min((s + 1) * per_slice, order.shape[0])):
        splat = splats[k]
        q = footprint(splat, alpha_min_level)
        summit = footprint_summit(splat, q)
        box_first, box_last = box_columns(splat, width)
        fragment = fragment_of(splat, order[k])
        if colors.shape[0] > 0:
            fragment.color = colors[k]
        entry = entries[k]
        first_row, last_row = tile_rows(splat, height)
        for row in range(first_row, last_row + 1):
            first, last = row_columns(splat, q, summit, row, width, box_first, box_last)
            fragment = in_tile_row(fragment, splat, row)
            for column in range(first, last + 1):
                tile = row * columns + column
                place = cursors[s, tile]
                cursors[s, tile] = place + 1
                fragment.x = splat.mean[0] - float(column * TILE) - 0.5
                fragment.entry = entry
                fragments_out[place] = fragment
                if places_out.shape[0] > 0:
                    places_out[entry] = place
                    tiles_out[entry] = tile
                entry += 1


@wp.kernel
def count_splat_tiles(
    # In:
    order: wp.array[int],  # [V] Gaussians by (depth, index), the culled last
    splats: wp.array[Splat],  # [V]
    status: wp.array[wp.uint8],  # [N]
    width: int,
    height: int,
    alpha_min_level: float,
    # Out:
    splat_counts_out: wp.array[int],  # [V] tiles that each splat touches
):
    """Count intersections per Gaussian (CUDA)."""
    k = wp.tid()
    total = int(0)
    if int(status[order[k]]) == VISIBLE:
        splat = splats[k]
        q = footprint(splat, alpha_min_level)
        summit = footprint_summit(splat, q)
        box_first, box_last = box_columns(splat, width)
        first_row, last_row = tile_rows(splat, height)
        for row in range(first_row, last_row + 1):
            first, last = row_columns(splat, q, summit, row, width, box_first, box_last)
            total += wp.max(last - first + 1, 0)
    splat_counts_out[k] = total


@wp.kernel
def emit_tiles(
    # In:
    order: wp.array[int],  # [V]
    splats: wp.array[Splat],  # [V]
    status: wp.array[wp.uint8],  # [N]
    width: int,
    height: int,
    alpha_min_level: float,
    entries: wp.array[int],  # [V] first intersection of each entry
    # Out:
    tiles_out: wp.array[int],  # [I] sort key
    intersections_out: wp.array[int],  # [I] sort value
    ranks_out: wp.array[int],  # [I] place in `order`
):
    """List the tiles of each Gaussian, row by row (CUDA)."""
    k = wp.tid()
    if int(status[order[k]]) != VISIBLE:
        return
    columns = (width + TILE - 1) / TILE
    splat = splats[k]
    q = footprint(splat, alpha_min_level)
    summit = footprint_summit(splat, q)
    box_first, box_last = box_columns(splat, width)
    entry = entries[k]
    first_row, last_row = tile_rows(splat, height)
    for row in range(first_row, last_row + 1):
        first, last = row_columns(splat, q, summit, row, width, box_first, box_last)
        for column in range(first, last + 1):
            tiles_out[entry] = row * columns + column
            intersections_out[entry] = entry
            ranks_out[entry] = k
            entry += 1


@wp.kernel
def pack_fragments(
    # In:
    sorted_tiles: wp.array[int],  # [I]
    sorted_intersections: wp.array[int],  # [I]
    ranks: wp.array[int],  # [I] place in `order`, by intersection
    order: wp.array[int],  # [V]
    splats: wp.array[Splat],  # [V]
    colors: wp.array[wp.vec3],  # [V] or empty
    width: int,
    # Out:
    fragments_out: wp.array[Fragment],  # [I]
    places_out: wp.array[int],  # [I] position in the tile lists of each intersection
):
    """Pack the sorted intersections (CUDA). One thread per place."""
    place = wp.tid()
    tile = sorted_tiles[place]
    entry = sorted_intersections[place]
    k = ranks[entry]
    columns = (width + TILE - 1) / TILE
    splat = splats[k]
    fragment = in_tile_row(fragment_of(splat, order[k]), splat, tile / columns)
    fragment.x = splat.mean[0] - float((tile % columns) * TILE) - 0.5
    fragment.entry = entry
    if colors.shape[0] > 0:
        fragment.color = colors[k]
    fragments_out[place] = fragment
    places_out[entry] = place
