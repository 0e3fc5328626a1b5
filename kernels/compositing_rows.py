"""The innermost loop of the lane schedule: a row of 16 pixels walks the fragments that reach it.

Written in C++ with the compiler's vector types, which Warp builds into the kernel as it stands: the state of the row has
to stay in registers from fragment to fragment, and Warp's own vectors go through memory there, which costs half of the
time. The arithmetic is that of `transmittance.py`, and the tests hold both to the same oracle.
"""

from functools import cache

import warp as wp

from sgwarp.kernels.binning import Fragment
from sgwarp.kernels.projection import Knobs
from sgwarp.kernels.transmittance import Lanes

ROW_WALK = """
    using Row = float __attribute__((ext_vector_type(16)));
    const int planes = state.shape[2];
    Row* const row_state = reinterpret_cast<Row*>(state.data + (slot * 16 + row) * planes);
    // Bit b: fragment b of the batch reaches the row.
    using Ints = int __attribute__((ext_vector_type(16)));
    using Bits = bool __attribute__((ext_vector_type(16)));
    const Ints* const limits = reinterpret_cast<const Ints*>(reached.data + slot * 64);
    const Bits low = __builtin_convertvector(limits[0] <= row & limits[2] >= row, Bits);
    const Bits high = __builtin_convertvector(limits[1] <= row & limits[3] >= row, Bits);
    unsigned left = unsigned(__builtin_bit_cast(unsigned short, low)) | unsigned(__builtin_bit_cast(unsigned short, high)) << 16;
    if (!left) return;
    const Row offsets = {-7.5f, -6.5f, -5.5f, -4.5f, -3.5f, -2.5f, -1.5f, -0.5f,
                         0.5f, 1.5f, 2.5f, 3.5f, 4.5f, 5.5f, 6.5f, 7.5f};
    const Row zero = 0.0f, alpha_max = knobs.alpha_max, alpha_min_level = knobs.alpha_min_level;
    const Row cut_off = knobs.transmittance_min, surface_level = knobs.surface_transmittance;
    Row T = row_state[0], red = row_state[1], green = row_state[2], blue = row_state[3];
    Row z = zero, surface = zero, last = zero;
    if (DEPTH) z = row_state[4], surface = row_state[5];
    if (RECORD) last = row_state[planes - 1];
    for (; left; left &= left - 1) {
        const int b = __builtin_ctz(left);
        const auto& f = batch.data[slot * 32 + b];
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
        const Row alpha = level < alpha_min_level ? zero : __builtin_elementwise_min(p, alpha_max);
        const Row weight = alpha * T, behind = T - weight;
        const Row w = behind > cut_off ? weight : zero;
        red += w * f.color[0];
        green += w * f.color[1];
        blue += w * f.color[2];
        const float place = order + b;
        if (RECORD) last = w > zero ? Row(place) : last;
        if (DEPTH) {
            z += w * f.depth;
            const Row found = RECORD ? place : f.depth;
            const Row here = T - w <= surface_level ? found : surface;
            surface = T > surface_level ? here : surface;
        }
        T = behind > cut_off ? behind : -__builtin_elementwise_abs(T);
    }
    row_state[0] = T, row_state[1] = red, row_state[2] = green, row_state[3] = blue;
    if (DEPTH) row_state[4] = z, row_state[5] = surface;
    if (RECORD) row_state[planes - 1] = last;
"""


@cache
def row_walk(depth: bool, record: bool) -> wp.Function:
    """Device function that composites the listed fragments of a batch into the scratch of one row."""
    snippet = ROW_WALK.replace("DEPTH", str(int(depth))).replace("RECORD", str(int(record)))

    @wp.func_native(snippet)
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
