"""Innermost loops of compositing colours and of the backward pass, lane schedule, in C++ (`native.py`)."""

from functools import cache

import warp as wp

from sgwarp.kernels.binning import AHEAD
from sgwarp.kernels.gaussian import Splat
from sgwarp.kernels.native import Seen, snippet
from sgwarp.kernels.projection.forward import Knobs
from sgwarp.kernels.transmittance import LaneIds, Lanes

# The splats of a batch as the tile sees them; rows_of[b] has a bit for each row that splat b reaches.
GATHER = """
    unsigned short* const rows_of = reinterpret_cast<unsigned short*>(reached.data + slot * 16);
    const int count = stop - start < BATCH ? stop - start : BATCH;
    for (int b = 0; b < count; ++b) {
        const int ahead = start + b + AHEAD;
        __builtin_prefetch(splats.data + listed.data[ahead < stop ? ahead : stop - 1]);
        const auto& s = splats.data[listed.data[start + b]];
        auto& seen = batch.data[slot * BATCH + b];
        Row middle, top;
        rows_of[b] = see(s, x0, y0, knobs, middle, top);
        reinterpret_cast<Row&>(seen.middle) = middle;
        reinterpret_cast<Row&>(seen.top) = top;
        reinterpret_cast<Row&>(seen.splat) = reinterpret_cast<const Row&>(s);
    }
    for (int b = count; b < BATCH; ++b) rows_of[b] = 0;
"""

# Bit b: splat b of the batch reaches the row.
REACHING = """
    typedef unsigned short Shorts __attribute__((ext_vector_type(BATCH), aligned(4)));
    using Bits = bool __attribute__((ext_vector_type(BATCH)));
    const Shorts rows_of = *reinterpret_cast<const Shorts*>(reached.data + slot * 16);
    const Shorts here = rows_of & (unsigned short)(1 << row);
    unsigned left = __builtin_bit_cast(unsigned, __builtin_convertvector(here != (unsigned short)0, Bits));
"""

# A row of the scratch as pixels of the image.
WRITE = """
    const int pixel = y * colors_out.shape[1] + x0;
    const Row* const row_state = reinterpret_cast<const Row*>(state.data + (slot * 16 + row) * state.shape[2]);
    const Row T = __builtin_elementwise_abs(row_state[0]);
    float* const rgb = reinterpret_cast<float*>(colors_out.data + pixel);
    float* const left = transmittance_out.data + pixel;
    for (int i = 0; i < inside; ++i) {
        rgb[3 * i] = row_state[1][i], rgb[3 * i + 1] = row_state[2][i], rgb[3 * i + 2] = row_state[3][i];
        left[i] = T[i];
    }
"""

FORWARD = (
    REACHING
    + """
    if (!left) return true;
    const int planes = state.shape[2];
    Row* const row_state = reinterpret_cast<Row*>(state.data + (slot * 16 + row) * planes);
    Row T = row_state[0], red = row_state[1], green = row_state[2], blue = row_state[3];
    Row z = zero, surface = zero, last = zero;
    if (DEPTH) z = row_state[4], surface = row_state[5];
    if (RECORD) last = row_state[planes - 1];
    for (; left; left &= left - 1) {
        const int b = __builtin_ctz(left);
        const auto& s = batch.data[slot * BATCH + b].splat;
        const Row before = T, w = take_seen(batch.data[slot * BATCH + b], row, knobs, T);
        red += w * s.color[0];
        green += w * s.color[1];
        blue += w * s.color[2];
        const float place = order + b;
        if (RECORD) last = w > zero ? one * place : last;
        if (DEPTH) {
            z += w * s.depth;
            const Row here = before - w <= knobs.surface_transmittance ? one * (RECORD ? place : s.depth) : surface;
            surface = before > knobs.surface_transmittance ? here : surface;
        }
    }
    row_state[0] = T, row_state[1] = red, row_state[2] = green, row_state[3] = blue;
    if (DEPTH) row_state[4] = z, row_state[5] = surface;
    if (RECORD) row_state[planes - 1] = last;
    return bits(T > zero) != 0;
"""
)

# The gradient of a tile's pixels, [H, W, S] in slices of 16 channels, with 16 pixels of a row in a vector.
READ = """
    const int width = pixels.shape[1], slices = pixels.shape[2];
    for (int row = 0; row < rows; ++row)
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
    const int slices = features.shape[1];
    const float* const x = reinterpret_cast<const float*>(features.data + s.gaussian * slices);
    for (unsigned rest = left; rest;) {
        const Row* v_rows[4];
        int of[4];
        for (int j = 0; j < 4; ++j) {
            of[j] = rest ? __builtin_ctz(rest) : of[j - 1];
            rest &= rest - 1;
            v_rows[j] = reinterpret_cast<const Row*>(gradient.data + (slot * 16 + of[j]) * planes);
        }
        Row a = zero, b = zero, c = zero, d = zero;
        for (int i = 0; i < 16 * slices; ++i) {
            const float xi = x[i];
            a += xi * v_rows[0][i], b += xi * v_rows[1][i], c += xi * v_rows[2][i], d += xi * v_rows[3][i];
        }
        values[of[0]] = a, values[of[1]] = b, values[of[2]] = c, values[of[3]] = d;
    }
"""

# The gradient of a splat's features: the image's gradient under its weights.
FEATURES = """
    const int width = pixels.shape[1];
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
        Row* const out = reinterpret_cast<Row*>(features_out.data) + place * slices + first;
        if (slices == 1) out[0] = (sums[0] + sums[1]) + (sums[2] + sums[3]);
        else for (int j = 0; j < count; ++j) out[j] = sums[j];
    }
"""

BACKWARD = """
    const int columns = last.shape[1], planes = gradient.shape[2];
    const auto& s = splats.data[rank];
    Row middles, tops;
    const Ints row_ends = *reinterpret_cast<const Ints*>(reach.data + slot * 16);
    const unsigned left = see(s, x0, y0, knobs, middles, tops) & bits(row_ends >= order);
    if (!left) {
        used.data[place] = 0;
        for (int j = 0; WIDE && j < features_out.shape[1]; ++j)
            reinterpret_cast<Row*>(features_out.data)[place * features_out.shape[1] + j] = zero;
        return;
    }
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
        const int at = (y0 + row) * columns + column;
        Row* const row_state = reinterpret_cast<Row*>(state.data + (slot * 16 + row) * 2);
        const Row u = offsets * s.a + middle_of[row];
        Row alpha = opacity(u, top_of[row], knobs);
        alpha = *reinterpret_cast<const Ints*>(last.data + at) >= order ? alpha : zero;
        const Row T = row_state[0] * reciprocal(__builtin_elementwise_max(one - alpha, one * MIN_PASSED));
        const Row w = alpha * T;
        Row value = zero;
#if SGWARP_WIDE
        value = values[row];
        weights[row] = w;
#else
        const Row* const v_row = reinterpret_cast<const Row*>(gradient.data + at * planes);
        value = s.color[0] * v_row[0] + s.color[1] * v_row[1] + s.color[2] * v_row[2];
        red += w * v_row[0];
        green += w * v_row[1];
        blue += w * v_row[2];
#endif
        if (DEPTH) {
            const Row v_depth = reinterpret_cast<const Row*>(depth_gradient.data)[at];
            value += s.depth * v_depth;
            z += w * v_depth;
        }
        const Row excess = value - row_state[1];
        row_state[0] = T;
        row_state[1] += alpha * excess;
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
    *reinterpret_cast<Row*>(rows.data + place) = FOLD_1(r0, r1);
    used.data[place] = 1;
#if SGWARP_WIDE
    FEATURES
#endif
""".replace("    VALUES\n", VALUES).replace("    FEATURES\n", FEATURES)


@wp.func_native(snippet(GATHER, AHEAD=int(AHEAD)))
def gather_batch(
    slot: int,
    start: int,  # first place of the batch
    stop: int,  # end of the tile's list
    x0: int,  # first pixel of the tile
    y0: int,
    listed: wp.array[int],  # [I]
    splats: wp.array[Splat],  # [V]
    knobs: Knobs,
    batch: wp.array2d[Seen],  # [slots, BATCH] out
    reached: wp.array2d[int],  # [slots, 16] out: for each of them 16 bits, the rows that it reaches
): ...


@wp.func_native(snippet(WRITE))
def write_row(
    slot: int,
    row: int,
    y: int,  # of the row in the image
    x0: int,  # its first pixel
    inside: int,  # pixels of the row that lie in the image
    state: wp.array3d[Lanes],  # [slots, 16, planes]
    colors_out: wp.array2d[wp.vec3],  # [H, W]
    transmittance_out: wp.array2d[float],  # [H, W]
): ...


@cache
def row_walk(depth: bool, record: bool) -> wp.Function:
    """Device function that composites the fragments of a batch into the scratch of one row; is any pixel open still?"""

    @wp.func_native(snippet(FORWARD, DEPTH=depth, RECORD=record))
    def composite_row(
        slot: int,
        row: int,
        order: int,  # of the batch's first fragment in the tile's list
        batch: wp.array2d[Seen],  # [slots, BATCH]
        reached: wp.array2d[int],  # [slots, 16]
        knobs: Knobs,
        state: wp.array3d[Lanes],  # [slots, 16, planes] as in `color_walk`
    ) -> bool: ...

    return composite_row


@wp.func_native(snippet(READ))
def read_tile(
    slot: int,
    x0: int,  # first pixel of the tile
    y0: int,
    rows: int,  # that lie in the image
    inside: int,  # columns
    pixels: wp.array3d[Lanes],  # [H, W, S]
    gradient: wp.array3d[Lanes],  # [slots, 16, 16 S] out
): ...


@cache
def fragment_replay(wide: bool, depth: bool, absolute: bool, min_passed: float) -> wp.Function:
    """Device function that differentiates one fragment of a tile and steps the tile's state to the front of it."""
    constants = {"WIDE": wide, "DEPTH": depth, "ABSOLUTE": absolute, "MIN_PASSED": float(min_passed)}

    # The preprocessor does not see constants of C++, and without features there is nothing to take 16 of.
    switch = f"\n#define SGWARP_WIDE {int(wide)}\n"

    @wp.func_native(f"{switch}{snippet(BACKWARD, **constants)}\n#undef SGWARP_WIDE\n")
    def replay_fragment(
        slot: int,
        rank: int,  # of the splat
        place: int,  # of the fragment in the lists
        order: int,  # of the fragment in the tile's list
        column: int,  # of the tile
        x0: int,  # first pixel of the tile
        y0: int,
        splats: wp.array[Splat],  # [V]
        features: wp.array3d[Lanes],  # [N, S, 1] (wide)
        last: wp.array2d[LaneIds],  # [H, tile columns]
        gradient: wp.array3d[Lanes],  # [H, tile columns, 3], or of the tile, as `read_tile` leaves it (wide)
        pixels: wp.array3d[Lanes],  # [H, W, S] the same pixel by pixel (wide)
        depth_gradient: wp.array2d[Lanes],  # [H, tile columns] (depth)
        knobs: Knobs,
        state: wp.array3d[Lanes],  # [slots, 16, 2] transmittance, value behind
        reach: wp.array2d[int],  # [slots, 16]
        rows: wp.array[Lanes],  # [I] by place, column q in lane q
        used: wp.array[wp.uint8],  # [I] whether there is one
        features_out: wp.array2d[Lanes],  # [I, S] by place, or empty (wide)
    ): ...

    return replay_fragment
