"""Tile lists on the CPU: the counting passes of `binning.py`, each slice of the depth order in one C++ loop.

The maths of a splat's tiles is that of `tile_rows`, `box_columns` and `tile_columns` there, operation by operation; the
tests hold the lists of both to each other.
"""

import warp as wp

from sgwarp.kernels.binning import TILE
from sgwarp.kernels.gaussian import EXACT_OPTIONS, Splat

wp.set_module_options(EXACT_OPTIONS)

SPANS = 4  # tile rows of a splat whose columns the counting pass keeps for the filling pass
MOST_COLUMNS = 256  # of tiles, so that a column takes eight bits
AHEAD = 12  # splats between the one at work and the one that is fetched

TILES_OF_A_SPLAT = f"""
    constexpr int TILE = {int(TILE)}, SPANS = {SPANS}, MOST_COLUMNS = {MOST_COLUMNS}, AHEAD = {AHEAD};
    struct Range {{
        int first, last;  // empty if first > last
    }};
    const auto least = [](float x, float y) {{ return x < y ? x : y; }};
    const auto most = [](float x, float y) {{ return x > y ? x : y; }};
    // Tiles whose pixel centres lie between two places.
    const auto tiles_between = [&](float low, float high, int size) -> Range {{
        const float limit = size, end = size - 1;
        const int first = __builtin_ceilf(least(most(low - 0.5f, 0.0f), limit));
        const int last = __builtin_floorf(least(most(high - 0.5f, -1.0f), end));
        return first > last ? Range{{1, 0}} : Range{{first / TILE, last / TILE}};
    }};
    const auto tile_rows = [&](const auto& s) -> Range {{
        return tiles_between(s.mean[1] - s.half_height, s.mean[1] + s.half_height, height);
    }};
    // Within a row of tiles; without square roots where the bounding box is one tile wide and not cut by the image.
    const auto tile_columns = [&](const auto& s, int row, Range box) -> Range {{
        const float edge = width;
        if (box.first >= box.last && !(s.mean[0] < s.half_width || s.mean[0] + s.half_width > edge)) return box;
        const float top = (float)(row * TILE) + 0.5f, bottom = top + (float)(TILE - 1);
        const float low = most(top - s.mean[1], -s.half_height), high = least(bottom - s.mean[1], s.half_height);
        if (low > high) return Range{{1, 0}};
        const float y_right = least(most(s.summit, low), high), y_left = least(most(-s.summit, low), high);
        const float cr = s.c * y_right, cl = s.c * y_left, inv_a = 1.0f / s.a;
        const float right = (__builtin_sqrtf(most(s.reach - cr * cr, 0.0f)) - s.b * y_right) * inv_a;
        const float left = (-__builtin_sqrtf(most(s.reach - cl * cl, 0.0f)) - s.b * y_left) * inv_a;
        return tiles_between(s.mean[0] + left, s.mean[0] + right, width);
    }};
    const int columns = (width + TILE - 1) / TILE, total = order.shape[0];
    const int end = (slice + 1) * per_slice < total ? (slice + 1) * per_slice : total;
"""

COUNT = (
    TILES_OF_A_SPLAT
    + """
    typedef float Line __attribute__((ext_vector_type(16), aligned(4)));  // a splat
    int* const counts = tile_counts.data + slice * tile_counts.shape[1];
    for (int k = slice * per_slice; k < end; ++k) {
        const int ahead = k + AHEAD < total ? k + AHEAD : total - 1;
        __builtin_prefetch(splats.data + order.data[ahead]);
        const auto& s = splats.data[order.data[k]];
        auto& out = ordered.data[k];
        reinterpret_cast<Line&>(out) = reinterpret_cast<const Line&>(s);
        out.gaussian = order.data[k];
        if (colors.shape[0] > 0) out.color = colors.data[k];
        const Range rows = tile_rows(s);
        const Range box = tiles_between(s.mean[0] - s.half_width, s.mean[0] + s.half_width, width);
        int touched = 0;
        wp::uint64 kept = 0;
        for (int row = rows.first; row <= rows.last; ++row) {
            const Range range = tile_columns(s, row, box);
            int* const of_row = counts + row * columns;
            for (int column = range.first; column <= range.last; ++column) ++of_row[column];
            touched += range.last < range.first ? 0 : range.last - range.first + 1;
            const int place = row - rows.first;
            if (place < SPANS) kept |= (wp::uint64)(range.first + (range.last << 8)) << (16 * place);
        }
        splat_counts.data[k] = touched;
        spans.data[k] = kept;
        rows_of.data[k] = rows.first | rows.last << 16;
    }
"""
)

FILL = (
    TILES_OF_A_SPLAT.replace("order.shape", "splats.shape")
    + """
    int* const next = cursors.data + slice * cursors.shape[1];
    const bool keeps_places = places.shape[0] > 0, keeps_tiles = tiles.shape[0] > 0;
    for (int k = slice * per_slice; k < end; ++k) {
        int entry = entries.data[k];
        const Range rows = {rows_of.data[k] & 0xffff, rows_of.data[k] >> 16};
        for (int row = rows.first; row <= rows.last; ++row) {
            const int place_of_row = row - rows.first;
            Range range;
            if (place_of_row < SPANS && columns <= MOST_COLUMNS) {
                const int span = spans.data[k] >> (16 * place_of_row) & 0xffff;
                range = {span & 255, span >> 8};
            } else {
                const auto& s = splats.data[k];
                range = tile_columns(
                    s, row, tiles_between(s.mean[0] - s.half_width, s.mean[0] + s.half_width, width));
            }
            for (int column = range.first; column <= range.last; ++column, ++entry) {
                const int tile = row * columns + column, place = next[tile]++;
                listed.data[place] = k;
                if (keeps_places) places.data[entry] = place;
                if (keeps_tiles) tiles.data[entry] = tile;
            }
        }
    }
"""
)


@wp.func_native(COUNT)
def count_slice(
    slice: int,
    order: wp.array[int],
    splats: wp.array[Splat],
    colors: wp.array[wp.vec3],
    per_slice: int,
    width: int,
    height: int,
    ordered: wp.array[Splat],
    tile_counts: wp.array2d[int],
    splat_counts: wp.array[int],
    spans: wp.array[wp.uint64],
    rows_of: wp.array[int],
): ...


@wp.func_native(FILL)
def fill_slice(
    slice: int,
    splats: wp.array[Splat],
    per_slice: int,
    width: int,
    height: int,
    entries: wp.array[int],
    spans: wp.array[wp.uint64],
    rows_of: wp.array[int],
    cursors: wp.array2d[int],
    listed: wp.array[int],
    places: wp.array[int],
    tiles: wp.array[int],
): ...


@wp.kernel
def count_tiles(
    # In:
    base: int,  # first slice of this launch
    order: wp.array[int],  # [V] visible Gaussians by (depth, index)
    splats: wp.array[Splat],  # [N]
    colors: wp.array[wp.vec3],  # [V] or empty
    per_slice: int,  # splats in a slice
    width: int,  # [pixels]
    height: int,
    # Out:
    ordered_out: wp.array[Splat],  # [V] in depth order, where all later passes read them
    tile_counts_out: wp.array2d[int],  # [slices, tiles] zeroed
    splat_counts_out: wp.array[int],  # [V] tiles that each splat touches
    spans_out: wp.array[wp.uint64],  # [V] columns of its first tile rows
    rows_out: wp.array[int],  # [V] its first tile row, and the last above 16 bits
):
    """Bring the splats into depth order and count intersections per (slice, tile) and splat. One thread per slice."""
    count_slice(
        base + wp.tid(),
        order,
        splats,
        colors,
        per_slice,
        width,
        height,
        ordered_out,
        tile_counts_out,
        splat_counts_out,
        spans_out,
        rows_out,
    )


@wp.kernel
def fill_tiles(
    # In:
    base: int,
    splats: wp.array[Splat],  # [V] in depth order
    per_slice: int,
    width: int,
    height: int,
    entries: wp.array[int],  # [V] first entry of each splat
    spans: wp.array[wp.uint64],  # [V] from `count_tiles`
    rows: wp.array[int],  # [V] from `count_tiles`
    # In and out:
    cursors: wp.array2d[int],  # [slices, tiles] next free place of each (slice, tile)
    # Out:
    listed_out: wp.array[int],  # [I] ranks of the splats, tile by tile, front to back
    places_out: wp.array[int],  # [I] place of each entry; or empty
    tiles_out: wp.array[int],  # [I] tile of each entry; or empty
):
    """Write the tile lists. One thread per slice; the cursors keep slices apart."""
    fill_slice(
        base + wp.tid(),
        splats,
        per_slice,
        width,
        height,
        entries,
        spans,
        rows,
        cursors,
        listed_out,
        places_out,
        tiles_out,
    )
