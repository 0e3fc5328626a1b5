"""Innermost loops of lifting, lane schedule, in C++ (`native.py`): what one fragment of a tile takes from the maps."""

from functools import cache

import warp as wp

from sgwarp.kernels.gaussian import Splat
from sgwarp.kernels.native import snippet
from sgwarp.kernels.projection.forward import Knobs
from sgwarp.kernels.transmittance import LaneIds, Lanes

# The rows that a splat reaches, from the first to the last; `weight_of` gives alpha T, or its square, and steps the row
# behind it.
WALK = """
    const auto& s = splats.data[rank];
    Row middles, tops;
    const unsigned left = see(s, x0, y0, knobs, middles, tops) & open_rows;
    float middle_of[16] __attribute__((aligned(64))), top_of[16] __attribute__((aligned(64)));
    *reinterpret_cast<Row*>(middle_of) = middles, *reinterpret_cast<Row*>(top_of) = tops;
    const auto weight_of = [&](int row) -> Row {
        Row& T = *reinterpret_cast<Row*>(state.data + slot * 16 + row);
        const Row w = take(opacity(offsets * s.a + middle_of[row], top_of[row], knobs), knobs, T);
        return SQUARED ? w * w : w;
    };
"""

DENSE = (
    WALK
    + """
    const int width = features.shape[1], slices = features.shape[2], columns = valid.shape[1];
    Row sums[4] = {zero, zero, zero, zero}, total = zero;
    for (unsigned rest = left; rest; rest &= rest - 1) {
        const int row = __builtin_ctz(rest), y = y0 + row;
        const Row w = weight_of(row) * reinterpret_cast<const Row*>(valid.data)[y * columns + column];
        unsigned pixels = bits(w > zero);
        if (!pixels) continue;
        total += w;
        float weights[16] __attribute__((aligned(64)));
        *reinterpret_cast<Row*>(weights) = w;
        const Row* const x = reinterpret_cast<const Row*>(features.data) + (y * width + x0) * slices + first_slice;
        if (SLICES == 1 && x0 + 16 <= width) {  // one vector a pixel: all of them are faster than finding out which
            for (int i = 0; i < 16; i += 4)
                for (int j = 0; j < 4; ++j) sums[j] += weights[i + j] * x[(i + j) * slices];
        } else {
            for (; pixels; pixels &= pixels - 1) {
                const int i = __builtin_ctz(pixels);
                for (int j = 0; j < SLICES; ++j) sums[j] += weights[i] * x[i * slices + j];
            }
        }
    }
    Row* const out = reinterpret_cast<Row*>(rows.data) + place * SLICES;
    if (SLICES == 1) out[0] = (sums[0] + sums[1]) + (sums[2] + sums[3]);
    else for (int j = 0; j < SLICES; ++j) out[j] = sums[j];
    totals.data[place] = sum(total);
"""
)

IDS = (
    "    if (!ids) return;\n"
    + WALK
    + """
    float* const out = weights_out.data + first;
    if (plain) {
        Row total = zero;
        for (unsigned rest = left; rest; rest &= rest - 1) total += weight_of(__builtin_ctz(rest));
        *out = sum(total);
        return;
    }
    Row totals[FEW_IDS] __attribute__((aligned(64)));
    const bool few = ids <= FEW_IDS;
    if (few) for (int m = 0; m < ids; ++m) totals[m] = zero;
    for (unsigned rest = left; rest; rest &= rest - 1) {
        const int row = __builtin_ctz(rest);
        const Row w = weight_of(row);
        const int shared = uniform.data[tile * 16 + row];
        const Ints pixels = *reinterpret_cast<const Ints*>(local_ids.data + tile * 16 + row);
        if (shared >= 0 && few) totals[shared] += w;
        else if (shared >= 0) out[shared] += sum(w);
        else if (shared == -2 && few)
            for (int m = 0; m < ids; ++m) totals[m] += pixels == m ? w : zero;
        else if (shared == -2)
            for (unsigned some = bits(w > zero); some; some &= some - 1) {
                const int i = __builtin_ctz(some);
                if (pixels[i] >= 0) out[pixels[i]] += w[i];
            }
    }
    if (few) for (int m = 0; m < ids; ++m) out[m] = sum(totals[m]);
"""
)

FEW_IDS = 8  # up to here a masked sum per id beats adding pixel by pixel


@cache
def fragment_lift(slices: int, squared: bool = False) -> wp.Function:
    """Device function that lifts `16 slices` channels of a dense map (1 or 4 slices) onto one fragment of a tile, with
    weight alpha T or its square."""

    @wp.func_native(snippet(DENSE, SLICES=slices, SQUARED=squared))
    def lift_fragment(
        slot: int,
        rank: int,  # of the splat
        place: int,  # of the fragment in the lists
        column: int,  # of the tile
        x0: int,  # first pixel of the tile
        y0: int,
        open_rows: int,  # a bit for each row of which some pixel is open
        splats: wp.array[Splat],  # [V]
        features: wp.array3d[Lanes],  # [H, W, S]
        valid: wp.array3d[Lanes],  # [H, tile columns, 1]
        first_slice: int,
        knobs: Knobs,
        state: wp.array3d[Lanes],  # [slots, 16, 1] transmittance
        rows: wp.array2d[Lanes],  # [I, slices] out
        totals: wp.array[float],  # [I] out
    ): ...

    return lift_fragment


@cache
def fragment_lift_ids(squared: bool) -> wp.Function:
    """Device function that adds one fragment's weights alpha T, or their squares, up by id."""

    @wp.func_native(snippet(IDS, FEW_IDS=FEW_IDS, SQUARED=squared))
    def lift_fragment_ids(
        slot: int,
        rank: int,
        first: int,  # weight of the fragment that belongs to its tile's first id
        tile: int,
        x0: int,
        y0: int,
        open_rows: int,
        ids: int,  # of the tile
        plain: bool,  # all its pixels have the same one
        splats: wp.array[Splat],
        local_ids: wp.array2d[LaneIds],  # [tiles, 16]
        uniform: wp.array2d[int],  # [tiles, 16]
        knobs: Knobs,
        state: wp.array3d[Lanes],
        weights_out: wp.array[float],  # zeroed
    ): ...

    return lift_fragment_ids
