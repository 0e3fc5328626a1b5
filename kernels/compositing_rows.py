"""Innermost loops of the lane schedule, forward and backward, in C++ with the compiler's vector types.

Warp builds these snippets into its CPU kernels as they stand. Written in Warp, what a loop carries from one step to the
next would go through memory; here it stays in registers, which makes compositing a fifth faster, its backward pass a
third. The arithmetic is that of `transmittance.py`, and the tests hold both to the same oracle.
"""

from functools import cache

import warp as wp

from sgwarp.kernels.binning import Fragment
from sgwarp.kernels.projection import Knobs
from sgwarp.kernels.transmittance import LaneIds, Lanes

# Aligned like a float: views of a caller's tensors start anywhere.
TYPES = """
    using Row = float __attribute__((ext_vector_type(16), aligned(4)));
    using Ints = int __attribute__((ext_vector_type(16), aligned(4)));
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

FORWARD = """
    const int planes = state.shape[2];
    Row* const row_state = reinterpret_cast<Row*>(state.data + (slot * 16 + row) * planes);
    // Bit b: fragment b of the batch reaches the row.
    using Bits = bool __attribute__((ext_vector_type(16)));
    const Ints* const limits = reinterpret_cast<const Ints*>(reached.data + slot * 64);
    const Bits low = __builtin_convertvector(limits[0] <= row & limits[2] >= row, Bits);
    const Bits high = __builtin_convertvector(limits[1] <= row & limits[3] >= row, Bits);
    unsigned left = __builtin_bit_cast(unsigned short, low) | unsigned(__builtin_bit_cast(unsigned short, high)) << 16;
    if (!left) return;
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
    Row* const out = reinterpret_cast<Row*>(sums.data + (slot * sums.shape[1] + b) * sums.shape[2]);
    out[0] = g0, out[1] = gu, out[2] = gv;
    out[3] = u * gu + f.b * gu1, out[4] = v * gu + f.c * gu1, out[5] = v * gv + f.c * (v * g1 + f.c * g2);
    int next = 6;
    if (!WIDE) out[6] = red, out[7] = green, out[8] = blue, next = 9;
    if (DEPTH) out[next++] = z;
    if (ABSOLUTE) out[next] = across, out[next + 1] = down;
"""


def snippet(body: str, **constants: object) -> str:
    """The C++ of a loop, with its options filled in; what they switch off the compiler removes."""
    body = TYPES + body.replace("ALPHA\n", ALPHA)
    for name, value in constants.items():
        body = body.replace(name, str(int(value)) if isinstance(value, bool) else str(value))
    return body


@cache
def row_walk(depth: bool, record: bool) -> wp.Function:
    """Device function that composites the fragments of a batch into the scratch of one row."""

    @wp.func_native(snippet(FORWARD, DEPTH=depth, RECORD=record))
    def composite_row(
        slot: int,
        row: int,
        order: int,  # of the batch's first fragment in the tile's list
        batch: wp.array2d[Fragment],  # [slots, 32]
        reached: wp.array3d[int],  # [slots, 2, 32] first and last row that each of them reaches
        knobs: Knobs,
        state: wp.array3d[Lanes],  # [slots, 16, planes] as in `color_walk`
    ): ...

    return composite_row


@cache
def fragment_replay(wide: bool, depth: bool, absolute: bool, min_passed: float) -> wp.Function:
    """Device function that differentiates one fragment of a tile and steps the tile's state to the front of it."""
    constants = {"WIDE": wide, "DEPTH": depth, "ABSOLUTE": absolute, "MIN_PASSED": f"{min_passed}f"}

    @wp.func_native(snippet(BACKWARD, **constants))
    def replay_fragment(
        slot: int,
        b: int,  # of the fragment in its batch
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
        sums: wp.array3d[Lanes],  # [slots, BATCH, SUMS] the fragment's row, still a number for every lane
    ): ...

    return replay_fragment
