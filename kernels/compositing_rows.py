"""Innermost loops of the lane schedule, forward and backward, in C++ with the compiler's vector types.

Warp builds these snippets into its CPU kernels as they stand. Written in Warp, what a loop carries from one step to the
next would go through memory; here it stays in registers, which takes about a quarter off compositing and a sixth off
its backward pass. The arithmetic is that of `transmittance.py`, and the tests hold both to the same oracle.
"""

from functools import cache

import warp as wp

from sgwarp.kernels.binning import AHEAD, Fragment
from sgwarp.kernels.gaussian import Splat
from sgwarp.kernels.projection import Knobs
from sgwarp.kernels.transmittance import LaneIds, Lanes

# Aligned like a float: views of a caller's tensors start anywhere.
TYPES = """
    typedef float Row __attribute__((ext_vector_type(16), aligned(4)));
    typedef int Ints __attribute__((ext_vector_type(16), aligned(4)));
    const Row offsets = {-7.5f, -6.5f, -5.5f, -4.5f, -3.5f, -2.5f, -1.5f, -0.5f,
                         0.5f, 1.5f, 2.5f, 3.5f, 4.5f, 5.5f, 6.5f, 7.5f};
    const Row zero = 0.0f, one = 1.0f;
"""

# Opacity of fragment f at the 16 pixels of a row: `alpha_from_level` and `exp2_falling`.
ALPHA = """
        const float at = row, dy = at - f.y, v = f.c * dy;
        const Row u = offsets * f.a + (f.b * dy + f.a * (7.5f - f.x));
        const Row level = (f.level - v * v) - u * u;
        const Row t = level * 0.0625f;
        Row p = 1.2747483491e-03f + t * 1.0902324732e-04f;
        p = 9.5791797294e-03f + t * p;
        p = 5.5490757104e-02f + t * p;
        p = 2.4022436783e-01f + t * p;
        p = 6.9314706433e-01f + t * p;
        p = 1.0f + t * p;
        p = p * p;
        p = p * p;
        p = p * p;
        p = p * p;
        Row alpha = level < knobs.alpha_min_level ? zero : __builtin_elementwise_min(p, one * knobs.alpha_max);
"""

# Fragments of a batch, and which rows of the tile each reaches: `fragment_of` and `row_range`, 16 at a time.
GATHER = """
    for (int half = 0; half < 32; half += 16) {
        Row x, y, a, b, c, inv_bc, half_width;
        for (int i = 0; i < 16; ++i) {
            const int k = start + half + i < stop ? start + half + i : stop - 1;
            __builtin_prefetch(splats.data + listed.data[k + AHEAD < stop ? k + AHEAD : stop - 1]);
            const auto& s = splats.data[listed.data[k]];
            auto& f = batch.data[slot * 32 + half + i];
            const float left = x0, top = y0;
            f.x = s.mean[0] - left - 0.5f, f.y = s.mean[1] - top - 0.5f;
            f.a = s.a, f.b = s.b, f.c = s.c, f.level = s.level, f.depth = s.depth, f.color = s.color;
            x[i] = f.x, y[i] = f.y, a[i] = s.a, b[i] = s.b, c[i] = s.c;
            inv_bc[i] = s.inv_bc, half_width[i] = s.half_width;
        }
        const Row lo = __builtin_elementwise_max(-x, -half_width);
        const Row hi = __builtin_elementwise_min(15.0f - x, half_width);
        const Row summit = -half_width * b * inv_bc, unit = a * inv_bc * inv_bc, w2 = half_width * half_width;
        const Row below = __builtin_elementwise_min(__builtin_elementwise_max(summit, lo), hi);
        const Row above = __builtin_elementwise_min(__builtin_elementwise_max(-summit, lo), hi);
        const Row down = c * __builtin_elementwise_sqrt(__builtin_elementwise_max(w2 - below * below, zero));
        const Row up = c * __builtin_elementwise_sqrt(__builtin_elementwise_max(w2 - above * above, zero));
        const Row last = y + (down - b * below) * unit, first = y - (up + b * above) * unit;
        const Row top_row = __builtin_elementwise_min(__builtin_elementwise_max(first, zero), one * 16.0f);
        const Row bottom_row = __builtin_elementwise_min(__builtin_elementwise_max(last, -one), one * 15.0f);
        Ints* const rows = reinterpret_cast<Ints*>(reached.data + slot * 64 + half);
        rows[0] = __builtin_convertvector(__builtin_elementwise_ceil(top_row), Ints);
        rows[2] = __builtin_convertvector(__builtin_elementwise_floor(bottom_row), Ints);
        for (int i = 0; i < 16; ++i)
            if (start + half + i >= stop) reached.data[slot * 64 + 32 + half + i] = -1;  // beyond the list
    }
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

FORWARD = """
    const int planes = state.shape[2];
    Row* const row_state = reinterpret_cast<Row*>(state.data + (slot * 16 + row) * planes);
    // Bit b: fragment b of the batch reaches the row.
    using Bits = bool __attribute__((ext_vector_type(16)));
    const Ints* const limits = reinterpret_cast<const Ints*>(reached.data + slot * 64);
    const Bits low = __builtin_convertvector(limits[0] <= row & limits[2] >= row, Bits);
    const Bits high = __builtin_convertvector(limits[1] <= row & limits[3] >= row, Bits);
    unsigned left = __builtin_bit_cast(unsigned short, low) | unsigned(__builtin_bit_cast(unsigned short, high)) << 16;
    if (!left) return true;
    Row T = row_state[0], red = row_state[1], green = row_state[2], blue = row_state[3];
    Row z = zero, surface = zero, last = zero;
    if (DEPTH) z = row_state[4], surface = row_state[5];
    if (RECORD) last = row_state[planes - 1];
    for (; left; left &= left - 1) {
        const int b = __builtin_ctz(left);
        const auto& f = batch.data[slot * 32 + b];
        ALPHA
        const Row weight = alpha * T, behind = T - weight;
        const Row w = behind > knobs.transmittance_min ? weight : zero;
        red += w * f.color[0];
        green += w * f.color[1];
        blue += w * f.color[2];
        const float place = order + b;
        if (RECORD) last = w > zero ? one * place : last;
        if (DEPTH) {
            z += w * f.depth;
            const Row here = T - w <= knobs.surface_transmittance ? one * (RECORD ? place : f.depth) : surface;
            surface = T > knobs.surface_transmittance ? here : surface;
        }
        T = behind > knobs.transmittance_min ? behind : -__builtin_elementwise_abs(T);
    }
    row_state[0] = T, row_state[1] = red, row_state[2] = green, row_state[3] = blue;
    if (DEPTH) row_state[4] = z, row_state[5] = surface;
    if (RECORD) row_state[planes - 1] = last;
    return __builtin_reduce_max(T) > 0.0f;
"""

BACKWARD = """
    const int columns = last.shape[1], planes = gradient.shape[2];
    const int middle_row = (f.first_row + f.last_row) / 2;
    Row g0 = zero, g1 = zero, g2 = zero, red = zero, green = zero, blue = zero, z = zero, across = zero, down = zero;
    for (int row = f.first_row; row <= f.last_row; ++row) {
        if (order > reach.data[slot * 16 + row]) continue;
        const int pixels = (y0 + row) * columns + column;
        const Row* const v_row = reinterpret_cast<const Row*>(gradient.data + pixels * planes);
        Row* const row_state = reinterpret_cast<Row*>(state.data + (slot * 16 + row) * 2);
        ALPHA
        alpha = *reinterpret_cast<const Ints*>(last.data + pixels) >= order ? alpha : zero;
        const Row T = row_state[0] / __builtin_elementwise_max(one - alpha, one * MIN_PASSED);
        const Row w = alpha * T;
        Row value = zero;
        if (WIDE) {
            Row odd = zero;  // two sums in turn: one alone would wait for its own last addition
            const int slices = features.shape[1];
            for (int s = 0; s < slices; ++s) {
                const auto& x = features.data[f.gaussian * slices + s];
                for (int c = 0; c < 16; c += 2) {
                    value += x[c] * v_row[16 * s + c];
                    odd += x[c + 1] * v_row[16 * s + c + 1];
                }
            }
            value += odd;
        } else {
            value = f.color[0] * v_row[0] + f.color[1] * v_row[1] + f.color[2] * v_row[2];
            red += w * v_row[0];
            green += w * v_row[1];
            blue += w * v_row[2];
        }
        if (DEPTH) {
            value += f.depth * v_row[planes - 1];
            z += w * v_row[planes - 1];
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
            across += __builtin_elementwise_abs(f.a * u * g);
            down += __builtin_elementwise_abs((f.b * u + f.c * v) * g);
        }
    }
    const float middle = middle_row, v = f.c * (middle - f.y);
    const Row u = offsets * f.a + (f.b * (middle - f.y) + f.a * (7.5f - f.x));
    const Row gu = u * g0 + f.b * g1, gv = v * g0 + f.c * g1, gu1 = u * g1 + f.b * g2;
    Row sums[12] = {g0, gu, gv, u * gu + f.b * gu1, v * gu + f.c * gu1, v * gv + f.c * (v * g1 + f.c * g2)};
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
"""


def snippet(body: str, **constants: object) -> str:
    """The C++ of a loop, with its options filled in; what they switch off the compiler removes."""
    body = TYPES + body.replace("ALPHA\n", ALPHA)
    for name, value in constants.items():
        body = body.replace(name, str(int(value)) if isinstance(value, bool) else str(value))
    return body


@wp.func_native(snippet(GATHER, AHEAD=int(AHEAD)))
def gather_batch(
    slot: int,
    start: int,  # first place of the batch
    stop: int,  # end of the tile's list
    x0: int,  # first pixel of the tile
    y0: int,
    listed: wp.array[int],  # [I]
    splats: wp.array[Splat],  # [V]
    batch: wp.array2d[Fragment],  # [slots, 32] out
    reached: wp.array3d[int],  # [slots, 2, 32] out: first and last row that each of them reaches
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
        batch: wp.array2d[Fragment],  # [slots, 32]
        reached: wp.array3d[int],  # [slots, 2, 32] first and last row that each of them reaches
        knobs: Knobs,
        state: wp.array3d[Lanes],  # [slots, 16, planes] as in `color_walk`
    ) -> bool: ...

    return composite_row


@cache
def fragment_replay(wide: bool, depth: bool, absolute: bool, min_passed: float) -> wp.Function:
    """Device function that differentiates one fragment of a tile and steps the tile's state to the front of it."""
    constants = {"WIDE": wide, "DEPTH": depth, "ABSOLUTE": absolute, "MIN_PASSED": f"{min_passed}f"}

    @wp.func_native(snippet(BACKWARD, **constants))
    def replay_fragment(
        slot: int,
        place: int,  # of the fragment in the lists
        order: int,  # of the fragment in the tile's list
        column: int,  # of the tile
        y0: int,  # first row of the tile
        f: Fragment,
        features: wp.array3d[Lanes],  # [N, S, 1] (wide)
        last: wp.array2d[LaneIds],  # [H, tile columns]
        gradient: wp.array3d[Lanes],  # [H, tile columns, padded C (+ 1)]
        knobs: Knobs,
        state: wp.array3d[Lanes],  # [slots, 16, 2] transmittance, value behind
        reach: wp.array2d[int],  # [slots, 16]
        rows: wp.array[Lanes],  # [I] by place, column q in lane q
    ): ...

    return replay_fragment
