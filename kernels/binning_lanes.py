"""Tile lists on the CPU: the counting passes of `binning.py`, each slice of the depth order in one C++ loop.

The maths of a splat's tiles is that of `tile_rows`, `box_columns` and `tile_columns` there, operation by operation, for
eight rows of tiles at a time; the tests hold the lists of both to each other.

For gradients, PATCH x PATCH tiles are a patch, which one thread replays: in it all tiles of a splat add to one row of
sums. A splat has a row in every patch of the rectangle that its tiles span; rows are counted rank by rank.
"""

import warp as wp

from sgwarp.kernels.binning import TILE
from sgwarp.kernels.gaussian import EXACT_OPTIONS, Splat

wp.set_module_options(EXACT_OPTIONS)

SPANS = 8  # tile rows of a splat whose columns the counting pass keeps for the filling pass
SPAN_WORDS = 2  # that they take, 64 bits each
MOST_COLUMNS = 256  # of tiles, so that a column takes eight bits
AHEAD = 12  # splats between the one at work and the one that is fetched
PATCH = 4  # tiles along the side of a patch

TILES_OF_A_SPLAT = f"""
    constexpr int TILE = {int(TILE)}, SPANS = {SPANS}, MOST_COLUMNS = {MOST_COLUMNS}, AHEAD = {AHEAD}, PATCH = {PATCH};
    typedef float Floats __attribute__((ext_vector_type(SPANS)));
    typedef int Rows __attribute__((ext_vector_type(SPANS)));
    struct Range {{
        int first, last;  // empty if first > last
    }};
    struct Ranges {{
        Rows first, last;  // of SPANS rows of tiles
    }};
    const auto least = [](auto x, auto y) {{ return x < y ? x : y; }};
    const auto most = [](auto x, auto y) {{ return x > y ? x : y; }};
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
    const auto box_columns = [&](const auto& s) -> Range {{
        return tiles_between(s.mean[0] - s.half_width, s.mean[0] + s.half_width, width);
    }};
    // Of the rows of tiles from `row` on; without square roots where the bounding box is one tile wide and not cut by
    // the image.
    const auto tile_columns = [&](const auto& s, int row, Range box) -> Ranges {{
        const float edge = width;
        if (box.first >= box.last && !(s.mean[0] < s.half_width || s.mean[0] + s.half_width > edge))
            return {{box.first, box.last}};
        const Floats zero = 0.0f;
        const Rows steps = {{0, 1, 2, 3, 4, 5, 6, 7}}, one = 1;
        const Floats top = __builtin_convertvector((row + steps) * TILE, Floats) + 0.5f, bottom = top + (TILE - 1);
        const Floats low = most(top - s.mean[1], zero - s.half_height);
        const Floats high = least(bottom - s.mean[1], zero + s.half_height);
        const Floats y_right = least(most(zero + s.summit, low), high);
        const Floats y_left = least(most(zero - s.summit, low), high);
        const Floats cr = s.c * y_right, cl = s.c * y_left;
        const float inv_a = 1.0f / s.a;
        const Floats right = (__builtin_elementwise_sqrt(most(s.reach - cr * cr, zero)) - s.b * y_right) * inv_a;
        const Floats left = (-__builtin_elementwise_sqrt(most(s.reach - cl * cl, zero)) - s.b * y_left) * inv_a;
        // As in `tiles_between`.
        const Floats from = least(most(s.mean[0] + left - 0.5f, zero), zero + edge);
        const Floats to = least(most(s.mean[0] + right - 0.5f, zero - 1.0f), zero + (edge - 1.0f));
        const Rows first = __builtin_convertvector(__builtin_elementwise_ceil(from), Rows);
        const Rows last = __builtin_convertvector(__builtin_elementwise_floor(to), Rows);
        const Rows empty = (low > high) | (first > last);
        return {{empty ? one : first / TILE, empty ? one - 1 : last / TILE}};
    }};
    const int columns = (width + TILE - 1) / TILE, total = order.shape[0];
    const int end = (slice + 1) * per_slice < total ? (slice + 1) * per_slice : total;
"""

COUNT = (
    TILES_OF_A_SPLAT
    + """
    typedef float Line __attribute__((ext_vector_type(16), aligned(4)));  // a splat
    typedef unsigned short Kept __attribute__((ext_vector_type(SPANS), aligned(8)));
    int* const counts = tile_counts.data + slice * tile_counts.shape[1];
    __builtin_memset(counts, 0, tile_counts.shape[1] * sizeof(int));
    const int slices = tile_counts.shape[0], each = (ranges.shape[0] + slices - 1) / slices;
    const int cleared = least(each * slice, ranges.shape[0]), until = least(cleared + each, ranges.shape[0]);
    __builtin_memset(ranges.data + 2 * cleared, 0, (until - cleared) * 2 * sizeof(int));
    long long entries = 0, rows_of_sums = 0;
    for (int k = slice * per_slice; k < end; ++k) {
        const int ahead = k + AHEAD < total ? k + AHEAD : total - 1;
        __builtin_prefetch(splats.data + order.data[ahead]);
        const auto& s = splats.data[order.data[k]];
        auto& out = ordered.data[k];
        reinterpret_cast<Line&>(out) = reinterpret_cast<const Line&>(s);
        out.gaussian = order.data[k];
        if (colors.shape[0] > 0) out.color = colors.data[k];
        const Range rows = tile_rows(s), box = box_columns(s);
        int leftmost = columns, rightmost = -1;
        for (int start = rows.first; start <= rows.last; start += SPANS) {
            const Ranges ranges = tile_columns(s, start, box);
            if (start == rows.first)
                *reinterpret_cast<Kept*>(spans.data + 2 * k) =
                    __builtin_convertvector(ranges.first | ranges.last << 8, Kept);
            const int here = rows.last - start < SPANS - 1 ? rows.last - start : SPANS - 1;
            for (int i = 0; i <= here; ++i) {
                const int first = ranges.first[i], last = ranges.last[i];
                if (first > last) continue;
                int* const of_row = counts + (start + i) * columns;
#pragma clang loop unroll(disable) vectorize(disable)
                for (int column = first; column <= last; ++column) ++of_row[column];  // most often one or two
                entries += last - first + 1;
                leftmost = least(leftmost, first), rightmost = most(rightmost, last);
            }
        }
        const int from = leftmost / PATCH, across = rightmost < 0 ? 0 : rightmost / PATCH - from + 1;
        rows_of_sums += across * (rows.last / PATCH - rows.first / PATCH + 1);
        rows_of.data[k] = rows.first | rows.last << 16;
        patches_of.data[k] = from | across << 16;
    }
    totals.data[2 * slice] = entries, totals.data[2 * slice + 1] = rows_of_sums;
"""
)

PLACE = """
    const int slices = cursors.shape[0], tiles = cursors.shape[1];
    int place = 0;
    for (int tile = 0; tile < tiles; ++tile) {
        offsets.data[tile] = place;
        for (int slice = 0; slice < slices; ++slice) {
            int& cursor = cursors.data[slice * tiles + tile];
            const int here = cursor;
            cursor = place, place += here;
        }
    }
    offsets.data[tiles] = place;
    long long before[2] = {0, 0};
    for (int slice = 0; slice <= slices; ++slice)
        for (int j = 0; j < 2; ++j) {
            auto& sum = totals.data[2 * slice + j];
            const long long here = sum;
            sum = before[j], before[j] += here;
        }
"""

FILL = (
    TILES_OF_A_SPLAT
    + """
    int* const next = cursors.data + slice * cursors.shape[1];
    const bool keeps_places = places.shape[0] > 0, keeps_tiles = tiles.shape[0] > 0;
    const bool keeps_rows = row_places.shape[0] > 0;
    int entry = totals.data[2 * slice], row_of_sums = totals.data[2 * slice + 1];
    for (int k = slice * per_slice; k < end; ++k) {
        const Range rows = {rows_of.data[k] & 0xffff, rows_of.data[k] >> 16};
        const int left = patches_of.data[k] & 0xffff, across = patches_of.data[k] >> 16, above = rows.first / PATCH;
        const unsigned short* const kept = reinterpret_cast<const unsigned short*>(spans.data + 2 * k);
        const int rows_here = across * (across ? rows.last / PATCH - above + 1 : 0);
        entries.data[k] = entry;
        if (keeps_rows) {
            row_places.data[2 * k] = row_of_sums - above * across - left;
            row_places.data[2 * k + 1] = across;
            ranges.data[2 * order.data[k]] = row_of_sums;
            ranges.data[2 * order.data[k] + 1] = rows_here;
        }
        Ranges later;
        for (int row = rows.first; row <= rows.last; ++row) {
            const int step = row - rows.first;
            Range range;
            if (step < SPANS && columns <= MOST_COLUMNS) range = {kept[step] & 255, kept[step] >> 8};
            else {
                if (step % SPANS == 0) later = tile_columns(splats.data[k], row, box_columns(splats.data[k]));
                range = {later.first[step % SPANS], later.last[step % SPANS]};
            }
            int* const next_of_row = next + row * columns;
#pragma clang loop unroll(disable)
            for (int column = range.first; column <= range.last; ++column, ++entry) {
                const int place = next_of_row[column]++;
                listed.data[place] = k;
                if (keeps_places) places.data[entry] = place;
                if (keeps_tiles) tiles.data[entry] = row * columns + column;
            }
        }
        row_of_sums += rows_here;
    }
    if (slice == cursors.shape[0] - 1) {
        entries.data[total] = entry;
        if (keeps_rows) ranges.data[2 * ranges.shape[0] - 2] = row_of_sums;
    }
"""
)

# Longest first, to an eighth of a power of two: the bits of a float that say that are few enough to count.
ORDER_PATCHES = f"""
    constexpr int TILE = {int(TILE)}, PATCH = {PATCH}, BINS = 1 << 11;
    const int columns = (width + TILE - 1) / TILE, down = (height + TILE - 1) / TILE;
    const int across = (columns + PATCH - 1) / PATCH, patches = order_out.shape[0];
    const auto bin = [&](int patch) -> int {{
        const int left = patch % across * PATCH, top = patch / across * PATCH;
        const int right = left + PATCH < columns ? left + PATCH : columns;
        const int bottom = top + PATCH < down ? top + PATCH : down;
        int length = 0;
        for (int row = top; row < bottom; ++row)
            length += offsets.data[row * columns + right] - offsets.data[row * columns + left];
        return BINS - 1 - (__builtin_bit_cast(int, (float)length) >> 20);
    }};
    int places[BINS] = {{}};
    for (int patch = 0; patch < patches; ++patch) ++places[bin(patch)];
    for (int k = 0, place = 0; k < BINS; ++k) {{
        const int here = places[k];
        places[k] = place, place += here;
    }}
    for (int patch = 0; patch < patches; ++patch) order_out.data[places[bin(patch)]++] = patch;
    __builtin_memset(used_out.data, 0, used_out.shape[0]);
"""


@wp.func_native(ORDER_PATCHES)
def put_longest_first(
    offsets: wp.array[int], width: int, height: int, order_out: wp.array[int], used_out: wp.array[wp.uint8]
): ...


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
    totals: wp.array2d[wp.int64],
    spans: wp.array[wp.uint64],
    rows_of: wp.array[int],
    patches_of: wp.array[int],
    ranges: wp.array2d[int],
): ...


@wp.func_native(PLACE)
def place_counts(cursors: wp.array2d[int], totals: wp.array2d[wp.int64], offsets: wp.array[int]): ...


@wp.func_native(FILL)
def fill_slice(
    slice: int,
    order: wp.array[int],
    splats: wp.array[Splat],
    per_slice: int,
    width: int,
    height: int,
    totals: wp.array2d[wp.int64],
    spans: wp.array[wp.uint64],
    rows_of: wp.array[int],
    patches_of: wp.array[int],
    cursors: wp.array2d[int],
    listed: wp.array[int],
    entries: wp.array[int],
    places: wp.array[int],
    tiles: wp.array[int],
    row_places: wp.array2d[int],
    ranges: wp.array2d[int],
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
    tile_counts_out: wp.array2d[int],  # [slices, tiles]
    totals_out: wp.array2d[wp.int64],  # [slices + 1, 2] intersections of each slice, and rows of sums; zeroed
    spans_out: wp.array[wp.uint64],  # [2 V] columns of its first tile rows
    rows_out: wp.array[int],  # [V] its first tile row, and the last above 16 bits
    patches_out: wp.array[int],  # [V] its first column of patches, and their number above 16 bits
    ranges_out: wp.array2d[int],  # [N + 1, 2] cleared; or empty
):
    """Bring the splats into depth order and count intersections per (slice, tile). One thread per slice."""
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
        totals_out,
        spans_out,
        rows_out,
        patches_out,
        ranges_out,
    )


@wp.kernel
def place_slices(
    # In:
    base: int,  # 0: one thread does it all
    # In and out:
    cursors: wp.array2d[int],  # [slices, tiles] counts, then the first place of each (slice, tile)
    totals: wp.array2d[wp.int64],  # [slices + 1, 2] of each slice, then of all slices before it
    # Out:
    offsets_out: wp.array[int],  # [tiles + 1] first place of each tile
):
    """Tile by tile, and within a tile slice by slice, so that each slice continues where the one in front ended."""
    place_counts(cursors, totals, offsets_out)


@wp.kernel
def fill_tiles(
    # In:
    base: int,
    order: wp.array[int],  # [V] visible Gaussians
    splats: wp.array[Splat],  # [V] in depth order
    per_slice: int,
    width: int,
    height: int,
    totals: wp.array2d[wp.int64],  # [slices + 1, 2] from `place_slices`
    spans: wp.array[wp.uint64],  # [2 V] from `count_tiles`
    rows: wp.array[int],  # [V] from `count_tiles`
    patches: wp.array[int],  # [V] from `count_tiles`
    # In and out:
    cursors: wp.array2d[int],  # [slices, tiles] next free place of each (slice, tile)
    # Out:
    listed_out: wp.array[int],  # [I] ranks of the splats, tile by tile, front to back
    entries_out: wp.array[int],  # [V + 1] first entry of each splat
    places_out: wp.array[int],  # [I] place of each entry; or empty
    tiles_out: wp.array[int],  # [I] tile of each entry; or empty
    row_places_out: wp.array2d[int],  # [V, 2] a, b: the row of sums in patch (r, c) is a + b r + c; or empty, as below
    ranges_out: wp.array2d[int],  # [N + 1, 2] first row of sums of each Gaussian and their number; last: all
):
    """Write the tile lists. One thread per slice; the cursors keep slices apart."""
    fill_slice(
        base + wp.tid(),
        order,
        splats,
        per_slice,
        width,
        height,
        totals,
        spans,
        rows,
        patches,
        cursors,
        listed_out,
        entries_out,
        places_out,
        tiles_out,
        row_places_out,
        ranges_out,
    )


@wp.kernel
def order_patches(
    # In:
    base: int,  # 0: one thread does it all
    offsets: wp.array[int],  # [tiles + 1]
    width: int,  # [pixels]
    height: int,
    # Out:
    order_out: wp.array[int],  # [patches] of tiles, those with the most intersections first
    used_out: wp.array[wp.uint8],  # [R] cleared
):
    """Prepare the replay of the patches: threads that begin with the longest end together."""
    put_longest_first(offsets, width, height, order_out, used_out)
