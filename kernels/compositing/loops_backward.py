"""Loops of the backward pass of compositing, lane schedule, in C++ (`native.py`): a patch, fragment by fragment."""

from functools import cache

import warp as wp

from sgwarp.kernels.binning import AHEAD, TILE
from sgwarp.kernels.binning_lanes import PATCH
from sgwarp.kernels.gaussian import Splat
from sgwarp.kernels.native import columns, snippet
from sgwarp.kernels.projection.forward import Knobs
from sgwarp.kernels.transmittance import Lanes

# The gradient of a tile's pixels, [H, W, S] in slices of 16 channels, with 16 pixels of a row in a vector.
READ = """
    for (int row = 0; row < inside_rows; ++row)
        for (int s = 0; s < slices; ++s) {
            const Row* const from = reinterpret_cast<const Row*>(pixels.data) + ((y0 + row) * width + x0) * slices + s;
            Row square[16];
#pragma clang loop unroll(full)
            for (int i = 0; i < 16; ++i) square[i] = i < inside ? from[i * slices] : zero;
            transpose(square);
            Row* const to = reinterpret_cast<Row*>(gradient.data) + (slot * 16 + row) * gradient.shape[2] + 16 * s;
#pragma clang loop unroll(full)
            for (int i = 0; i < 16; ++i) to[i] = square[i];
        }
"""

# The value of a splat at each of its rows: its features under the image's gradient, four rows at a time.
VALUES = """
    Row values[16];
    const float* const x = reinterpret_cast<const float*>(features.data + s.gaussian * slices);
    for (unsigned rest = left; rest;) {
        const Row* v_at[4];
        int of[4];
        for (int j = 0; j < 4; ++j) {
            of[j] = rest ? __builtin_ctz(rest) : of[j - 1];
            rest &= rest - 1;
            v_at[j] = reinterpret_cast<const Row*>(gradient.data + (slot * 16 + of[j]) * planes);
        }
        Row a = zero, b = zero, c = zero, d = zero;
        for (int i = 0; i < 16 * slices; ++i) {
            const float xi = x[i];
            a += xi * v_at[0][i], b += xi * v_at[1][i], c += xi * v_at[2][i], d += xi * v_at[3][i];
        }
        values[of[0]] = a, values[of[1]] = b, values[of[2]] = c, values[of[3]] = d;
    }
"""

# The gradient of a splat's features: the image's gradient under its weights.
FEATURES = """
    for (int first = 0; first < features_out.shape[1]; first += 4) {
        Row sums[4] = {zero, zero, zero, zero};
        const int count = slices - first < 4 ? slices - first : 4;
        for (unsigned rest = left; rest; rest &= rest - 1) {
            const int row = __builtin_ctz(rest);
            const Row* const v = reinterpret_cast<const Row*>(pixels.data) + ((y0 + row) * width + x0) * slices + first;
            const float* const w = reinterpret_cast<const float*>(weights + row);
            unsigned some = bits(weights[row] > zero);
            if (slices == 1 && x0 + 16 <= width)  // one vector a pixel: all are faster than finding out which
                for (int i = 0; i < 16; i += 4)
                    for (int j = 0; j < 4; ++j) sums[j] += w[i + j] * v[i + j];
            else if (count == 4)
                for (; some; some &= some - 1) {
                    const int i = __builtin_ctz(some);
                    for (int j = 0; j < 4; ++j) sums[j] += w[i] * v[i * slices + j];
                }
            else
                for (; some; some &= some - 1) {
                    const int i = __builtin_ctz(some);
                    for (int j = 0; j < count; ++j) sums[j] += w[i] * v[i * slices + j];
                }
        }
        Row* const out = reinterpret_cast<Row*>(features_out.data) + row_of_sums * slices + first;
        if (slices == 1) sums[0] = (sums[0] + sums[1]) + (sums[2] + sums[3]);
        for (int j = 0; j < count; ++j) out[j] = taken ? out[j] + sums[j] : sums[j];
    }
"""

# Where a tile begins: what lies behind its last fragment. Beyond the image's edge nothing was seen.
OPEN = """
    const int columns = (width + TILE - 1) / TILE;
    const int x0 = column * TILE, y0 = tile_row * TILE, tile = tile_row * columns + column;
    const int inside_rows = height - y0 < TILE ? height - y0 : TILE, inside = width - x0 < TILE ? width - x0 : TILE;
    const auto read = [&](const float* from, Row outside) -> Row {  // a row of the image
        if (inside == TILE) return *reinterpret_cast<const Row*>(from);
        for (int i = 0; i < inside; ++i) outside[i] = from[i];
        return outside;
    };
    const auto read_places = [&](const int* from, Ints outside) -> Ints {
        if (inside == TILE) return *reinterpret_cast<const Ints*>(from);
        for (int i = 0; i < inside; ++i) outside[i] = from[i];
        return outside;
    };
    const Ints unseen = -1;
    Row lights[TILE] __attribute__((aligned(64))), behind[TILE] __attribute__((aligned(64)));
    Row v_rows[TILE][3] __attribute__((aligned(64))), v_depths[TILE] __attribute__((aligned(64)));
    Ints ends[TILE] __attribute__((aligned(64))), row_ends = unseen;
    int tile_end = -1;
    for (int row = 0; row < inside_rows; ++row) {
        const int pixel = (y0 + row) * width + x0;
        ends[row] = read_places(last.data + pixel, unseen);
        row_ends[row] = __builtin_reduce_max(ends[row]);
        tile_end = row_ends[row] > tile_end ? row_ends[row] : tile_end;
        lights[row] = read(transmittance.data + pixel, one);
        behind[row] = zero - read(v_alpha.data + pixel, zero);
        if (DEPTH) v_depths[row] = read(v_depth.data + pixel, zero);
#if !SGWARP_WIDE
        const float* const from = v_image.data + 3 * pixel;
        float padded[3 * TILE] = {};
        for (int e = 0; inside < TILE && e < 3 * inside; ++e) padded[e] = from[e];
        split_3(inside < TILE ? padded : from, v_rows[row]);
#endif
    }
"""

REPLAY = """
    const auto& s = splats.data[rank];
    Row middles, tops;
    const unsigned left = see(s, x0, y0, knobs, middles, tops) & bits(row_ends >= order);
    if (!left) continue;
    float middle_of[16] __attribute__((aligned(64))), top_of[16] __attribute__((aligned(64)));
    *reinterpret_cast<Row*>(middle_of) = middles, *reinterpret_cast<Row*>(top_of) = tops;
    const float above = y0, y = s.mean[1] - above - 0.5f;
    const int middle_row = (__builtin_ctz(left) + 31 - __builtin_clz(left)) / 2;
#if SGWARP_WIDE
    Row weights[16] __attribute__((aligned(64)));
    VALUES
#endif
    Row g0 = zero, g1 = zero, g2 = zero, red = zero, green = zero, blue = zero, z = zero, across = zero, down = zero;
    for (unsigned rest = left; rest; rest &= rest - 1) {
        const int row = __builtin_ctz(rest);
        const Row u = offsets * s.a + middle_of[row];
        Row alpha = opacity(u, top_of[row], knobs);
        alpha = ends[row] >= order ? alpha : zero;
        const Row T = lights[row] * reciprocal(__builtin_elementwise_max(one - alpha, one * MIN_PASSED));
        const Row w = alpha * T;
        Row value = zero;
#if SGWARP_WIDE
        value = values[row];
        weights[row] = w;
#else
        const Row* const v_row = v_rows[row];
        value = s.color[0] * v_row[0] + s.color[1] * v_row[1] + s.color[2] * v_row[2];
        red += w * v_row[0];
        green += w * v_row[1];
        blue += w * v_row[2];
#endif
        if (DEPTH) {
            value += s.depth * v_depths[row];
            z += w * v_depths[row];
        }
        const Row excess = value - behind[row];
        lights[row] = T;
        behind[row] += alpha * excess;
        const Row g = alpha < knobs.alpha_max ? w * excess : zero;
        const float d = row - middle_row;
        g0 += g;
        g1 += d * g;
        g2 += (d * d) * g;
        if (ABSOLUTE) {
            const float v = s.c * (row - y);
            across += __builtin_elementwise_abs(s.a * u * g);
            down += __builtin_elementwise_abs((s.b * u + s.c * v) * g);
        }
    }
    const float v = s.c * (middle_row - y);
    const Row u = offsets * s.a + middle_of[middle_row];
    const Row gu = u * g0 + s.b * g1, gv = v * g0 + s.c * g1, gu1 = u * g1 + s.b * g2;
    Row sums[12] = {g0, gu, gv, u * gu + s.b * gu1, v * gu + s.c * gu1, v * gv + s.c * (v * g1 + s.c * g2)};
    int next = 6;
    if (!WIDE) sums[6] = red, sums[7] = green, sums[8] = blue, next = 9;
    if (DEPTH) sums[next++] = z;
    if (ABSOLUTE) sums[next] = across, sums[next + 1] = down;
    // Add up the lanes of all columns at once, by halves: column q ends in lane q.
#define FOLD_8(x, y) __builtin_shufflevector(x, y, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23) \
                   + __builtin_shufflevector(x, y, 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31)
#define FOLD_4(x, y) __builtin_shufflevector(x, y, 0, 1, 2, 3, 8, 9, 10, 11, 16, 17, 18, 19, 24, 25, 26, 27) \
                   + __builtin_shufflevector(x, y, 4, 5, 6, 7, 12, 13, 14, 15, 20, 21, 22, 23, 28, 29, 30, 31)
#define FOLD_2(x, y) __builtin_shufflevector(x, y, 0, 1, 4, 5, 8, 9, 12, 13, 16, 17, 20, 21, 24, 25, 28, 29) \
                   + __builtin_shufflevector(x, y, 2, 3, 6, 7, 10, 11, 14, 15, 18, 19, 22, 23, 26, 27, 30, 31)
#define FOLD_1(x, y) __builtin_shufflevector(x, y, 0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30) \
                   + __builtin_shufflevector(x, y, 1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31)
    const Row p0 = FOLD_8(sums[0], sums[1]), p1 = FOLD_8(sums[2], sums[3]), p2 = FOLD_8(sums[4], sums[5]);
    const Row p3 = FOLD_8(sums[6], sums[7]), p4 = FOLD_8(sums[8], sums[9]), p5 = FOLD_8(sums[10], sums[11]);
    const Row q0 = FOLD_4(p0, p1), q1 = FOLD_4(p2, p3), q2 = FOLD_4(p4, p5);
    const Row r0 = FOLD_2(q0, q1), r1 = FOLD_2(q2, zero);
    const int row_of_sums = row_of(rank);
    Row* const to = reinterpret_cast<Row*>(rows.data + row_of_sums);
    auto& taken = used.data[row_of_sums];
    const Row nothing = zero;
    *to = *(taken ? to : &nothing) + FOLD_1(r0, r1);
#if SGWARP_WIDE
    FEATURES
#endif
    taken = 1;
""".replace("    VALUES\n", VALUES).replace("    FEATURES\n", FEATURES)

# Tile by tile, row-major; in a tile from the last fragment to the first.
PATCH_WALK = (
    columns(3)
    + """
    const int across_image = (width + TILE - 1) / TILE, down_image = (height + TILE - 1) / TILE;
    const int patches = (across_image + PATCH - 1) / PATCH;
    const int first_column = patch % patches * PATCH, first_row = patch / patches * PATCH;
    const auto row_of = [&](int rank) -> int {
        return row_places.data[2 * rank] + row_places.data[2 * rank + 1] * (patch / patches) + patch % patches;
    };
    const int end_column = first_column + PATCH < across_image ? first_column + PATCH : across_image;
    const int end_row = first_row + PATCH < down_image ? first_row + PATCH : down_image;
    for (int tile_row = first_row; tile_row < end_row; ++tile_row)
        for (int column = first_column; column < end_column; ++column) {
            OPEN
#if SGWARP_WIDE
            const int planes = gradient.shape[2], slices = pixels.shape[2];
            READ
#endif
            const int first = offsets_of.data[tile];
            for (int order = tile_end; order >= 0; --order) {
                const int place = first + order, rank = listed.data[place];
                const int ahead = listed.data[place - AHEAD > first ? place - AHEAD : first];
                __builtin_prefetch(splats.data + ahead);
                __builtin_prefetch(row_places.data + 2 * ahead);
                const int soon = listed.data[place - AHEAD / 2 > first ? place - AHEAD / 2 : first];
                __builtin_prefetch(rows.data + row_of(soon), 1);
                REPLAY
            }
        }
""".replace("            OPEN\n", OPEN)
    .replace("            READ\n", READ)
    .replace("                REPLAY\n", REPLAY)
)


@cache
def patch_replay(wide: bool, depth: bool, absolute: bool, min_passed: float) -> wp.Function:
    """Device function that differentiates the tiles of a patch."""
    constants = {
        "WIDE": wide,
        "DEPTH": depth,
        "ABSOLUTE": absolute,
        "MIN_PASSED": float(min_passed),
        "TILE": int(TILE),
        "PATCH": PATCH,
        "AHEAD": int(AHEAD),
    }

    # The preprocessor does not see constants of C++, and without features there is nothing to take 16 of.
    switch = f"\n#define SGWARP_WIDE {int(wide)}\n"

    @wp.func_native(f"{switch}{snippet(PATCH_WALK, **constants)}\n#undef SGWARP_WIDE\n")
    def replay_patch(
        slot: int,
        patch: int,
        offsets_of: wp.array[int],  # [tiles + 1] first place of each tile
        listed: wp.array[int],  # [I]
        row_places: wp.array2d[int],  # [V, 2]
        splats: wp.array[Splat],  # [V]
        features: wp.array3d[Lanes],  # [N, S, 1] (wide)
        transmittance: wp.array2d[float],  # [H, W]
        v_alpha: wp.array2d[float],  # [H, W]
        last: wp.array2d[int],  # [H, W]
        v_image: wp.array3d[float],  # [H, W, 3]
        pixels: wp.array3d[Lanes],  # [H, W, S] (wide)
        v_depth: wp.array2d[float],  # [H, W] (depth)
        knobs: Knobs,
        width: int,
        height: int,
        gradient: wp.array3d[Lanes],  # [slots, 16, 16 S] scratch (wide)
        rows: wp.array[Lanes],  # [R] rows of sums, column q in lane q
        used: wp.array[wp.uint8],  # [R] whether something was added; zeroed
        features_out: wp.array2d[Lanes],  # [R, S] the features' part of the rows, or empty (wide)
    ): ...

    return replay_patch
