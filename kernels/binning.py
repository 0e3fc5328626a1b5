"""Tile lists: which splats touch which 16 x 16 tile, front to back.

Gaussians are sorted once by (depth, index); a stable counting pass then writes every tile's list in that order, so
the intersections themselves are never sorted. On the CPU the counting pass runs in slices of the depth order: each slice counts
its own tiles, prefix sums turn the counts into disjoint places, and each slice fills them. Any number of threads
writes the same lists.

On CUDA one thread per Gaussian emits its (tile, intersection) pairs in depth order; a stable radix sort by tile alone
then gives the same lists, and one thread per place packs the fragment.
"""

import warp as wp

from sgwarp.kernels.gaussian import Splat, column_range, footprint
from sgwarp.kernels.projection import VISIBLE

wp.set_module_options({"enable_backward": False, "fast_math": False})

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
def tile_columns(splat: Splat, q: float, row: int, width: int):
    """First and last tile column that the footprint touches within a tile row; empty if first > last."""
    top = float(row * TILE) + 0.5
    left, right = column_range(splat, q, top, top + float(TILE - 1))
    first = int(wp.ceil(wp.clamp(left - 0.5, 0.0, float(width))))
    last = int(wp.floor(wp.clamp(right - 0.5, -1.0, float(width - 1))))
    if first > last:
        return 1, 0
    return first / TILE, last / TILE


@wp.kernel
def count_tiles(
    # In:
    base: int,  # first slice of this launch
    order: wp.array[int],  # [V] visible Gaussians by (depth, index)
    splats: wp.array[Splat],  # [N]
    per_slice: int,  # entries of `order` in a slice
    width: int,  # [pixels]
    height: int,
    alpha_min_level: float,
    # Out:
    tile_counts_out: wp.array2d[int],  # [slices, tiles] zeroed
    splat_counts_out: wp.array[int],  # [V] tiles that each entry touches
):
    """Count intersections per (slice, tile) and per Gaussian. One thread per slice."""
    s = base + wp.tid()
    columns = (width + TILE - 1) / TILE
    for k in range(s * per_slice, wp.min((s + 1) * per_slice, order.shape[0])):
        splat = splats[order[k]]
        q = footprint(splat, alpha_min_level)
        total = int(0)
        first_row, last_row = tile_rows(splat, height)
        for row in range(first_row, last_row + 1):
            first, last = tile_columns(splat, q, row, width)
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
def placed(fragment: Fragment, splat: Splat, row: int, column: int) -> Fragment:
    """The fragment relative to one tile."""
    fragment.x = splat.mean[0] - float(column * TILE) - 0.5
    fragment.y = splat.mean[1] - float(row * TILE) - 0.5
    fragment.first_row = int(wp.ceil(wp.clamp(fragment.y - splat.half_height, 0.0, float(TILE))))
    fragment.last_row = int(wp.floor(wp.clamp(fragment.y + splat.half_height, -1.0, float(TILE - 1))))
    return fragment


@wp.kernel
def fill_tiles(
    # In:
    base: int,
    order: wp.array[int],  # [V]
    splats: wp.array[Splat],  # [N]
    colors: wp.array[wp.vec3],  # [N] or empty
    per_slice: int,
    width: int,
    height: int,
    alpha_min_level: float,
    entries: wp.array[int],  # [V] first intersection of each entry, by Gaussian
    # In and out:
    cursors: wp.array2d[int],  # [slices, tiles] next free place of each (slice, tile)
    # Out:
    fragments_out: wp.array[Fragment],  # [I] tile by tile, front to back
    places_out: wp.array[int],  # [I] position in the tile lists of each intersection, by Gaussian
    tiles_out: wp.array[int],  # [I] its tile
):
    """Write the tile lists. One thread per slice; the cursors keep slices apart."""
    s = base + wp.tid()
    columns = (width + TILE - 1) / TILE
    for k in range(s * per_slice, wp.min((s + 1) * per_slice, order.shape[0])):
        i = order[k]
        splat = splats[i]
        q = footprint(splat, alpha_min_level)
        fragment = fragment_of(splat, i)
        if colors.shape[0] > 0:
            fragment.color = colors[i]
        entry = entries[k]
        first_row, last_row = tile_rows(splat, height)
        for row in range(first_row, last_row + 1):
            first, last = tile_columns(splat, q, row, width)
            for column in range(first, last + 1):
                fragment.entry = entry
                place = cursors[s, row * columns + column]
                cursors[s, row * columns + column] = place + 1
                fragments_out[place] = placed(fragment, splat, row, column)
                places_out[entry] = place
                tiles_out[entry] = row * columns + column
                entry += 1


@wp.kernel
def count_splat_tiles(
    # In:
    order: wp.array[int],  # [V] Gaussians by (depth, index), the culled last
    splats: wp.array[Splat],  # [N]
    status: wp.array[wp.uint8],  # [N]
    width: int,
    height: int,
    alpha_min_level: float,
    # Out:
    splat_counts_out: wp.array[int],  # [V] tiles that each entry touches
):
    """Count intersections per Gaussian (CUDA)."""
    k = wp.tid()
    i = order[k]
    total = int(0)
    if int(status[i]) == VISIBLE:
        splat = splats[i]
        q = footprint(splat, alpha_min_level)
        first_row, last_row = tile_rows(splat, height)
        for row in range(first_row, last_row + 1):
            first, last = tile_columns(splat, q, row, width)
            total += wp.max(last - first + 1, 0)
    splat_counts_out[k] = total


@wp.kernel
def emit_tiles(
    # In:
    order: wp.array[int],  # [V]
    splats: wp.array[Splat],  # [N]
    status: wp.array[wp.uint8],  # [N]
    width: int,
    height: int,
    alpha_min_level: float,
    entries: wp.array[int],  # [V] first intersection of each entry
    # Out:
    tiles_out: wp.array[int],  # [I] sort key
    intersections_out: wp.array[int],  # [I] sort value
    gaussians_out: wp.array[int],  # [I]
):
    """List the tiles of each Gaussian, row by row (CUDA)."""
    k = wp.tid()
    i = order[k]
    if int(status[i]) != VISIBLE:
        return
    columns = (width + TILE - 1) / TILE
    splat = splats[i]
    q = footprint(splat, alpha_min_level)
    entry = entries[k]
    first_row, last_row = tile_rows(splat, height)
    for row in range(first_row, last_row + 1):
        first, last = tile_columns(splat, q, row, width)
        for column in range(first, last + 1):
            tiles_out[entry] = row * columns + column
            intersections_out[entry] = entry
            gaussians_out[entry] = i
            entry += 1


@wp.kernel
def pack_fragments(
    # In:
    sorted_tiles: wp.array[int],  # [I]
    sorted_intersections: wp.array[int],  # [I]
    gaussians: wp.array[int],  # [I] by intersection
    splats: wp.array[Splat],  # [N]
    colors: wp.array[wp.vec3],  # [N] or empty
    width: int,
    # Out:
    fragments_out: wp.array[Fragment],  # [I]
    places_out: wp.array[int],  # [I] position in the tile lists of each intersection
):
    """Pack the sorted intersections (CUDA). One thread per place."""
    place = wp.tid()
    tile = sorted_tiles[place]
    entry = sorted_intersections[place]
    i = gaussians[entry]
    columns = (width + TILE - 1) / TILE
    splat = splats[i]
    fragment = placed(fragment_of(splat, i), splat, tile / columns, tile % columns)
    fragment.entry = entry
    if colors.shape[0] > 0:
        fragment.color = colors[i]
    fragments_out[place] = fragment
    places_out[entry] = place
