"""Innermost loops of compositing colours, lane schedule, in C++ (`native.py`)."""

from functools import cache

import warp as wp

from sgwarp.kernels.binning import AHEAD
from sgwarp.kernels.gaussian import Splat
from sgwarp.kernels.native import Seen, snippet
from sgwarp.kernels.projection.forward import Knobs
from sgwarp.kernels.transmittance import Lanes

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
    float* const held = alpha_out.data + pixel;
    for (int i = 0; i < inside; ++i) {
        rgb[3 * i] = row_state[1][i], rgb[3 * i + 1] = row_state[2][i], rgb[3 * i + 2] = row_state[3][i];
        left[i] = T[i], held[i] = 1.0f - T[i];
    }
"""

# Last contributors of a tile's rows, from lanes to pixels.
WRITE_LAST = """
    const int rows = height - y0 < 16 ? height - y0 : 16, inside = width - x0 < 16 ? width - x0 : 16;
    for (int row = 0; row < rows; ++row) {
        int* const to = last_out.data + (y0 + row) * last_out.shape[1] + x0;
        const Row* const row_state = reinterpret_cast<const Row*>(state.data + (slot * 16 + row) * state.shape[2]);
        const Ints last = __builtin_convertvector(row_state[plane], Ints);
        if (inside == 16) *reinterpret_cast<Ints*>(to) = last;
        else for (int i = 0; i < inside; ++i) to[i] = last[i];
    }
"""

# A tile's scratch before its first fragment.
OPEN = """
    const float columns = width - x0;
    const Row inside = offsets + 7.5f < columns ? one : zero;
    for (int row = 0; row < 16; ++row) {
        Row* const row_state = reinterpret_cast<Row*>(state.data + (slot * 16 + row) * state.shape[2]);
        row_state[0] = inside;
        for (int plane = 1; plane < planes; ++plane) row_state[plane] = plane < unset ? zero : -one;
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
    alpha_out: wp.array2d[float],  # [H, W]
): ...


@wp.func_native(snippet(WRITE_LAST))
def write_last(
    slot: int,
    x0: int,  # first pixel of the tile
    y0: int,
    width: int,
    height: int,
    state: wp.array3d[Lanes],  # [slots, 16, planes]
    plane: int,
    last_out: wp.array2d[int],  # [H, W]
): ...


@wp.func_native(snippet(OPEN))
def open_state(
    slot: int,
    x0: int,  # first pixel of the tile; lanes beyond the image start closed
    width: int,
    planes: int,
    unset: int,  # first plane that holds numbers of fragments, of which there is none
    state: wp.array3d[Lanes],  # [slots, 16, planes] out
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
