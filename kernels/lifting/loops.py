"""Innermost loops of lifting, lane schedule, in C++ (`native.py`): what one fragment of a tile takes from the maps."""

from functools import cache

import warp as wp

from sgwarp.kernels.binning import AHEAD
from sgwarp.kernels.gaussian import Splat
from sgwarp.kernels.native import snippet
from sgwarp.kernels.projection.forward import Knobs
from sgwarp.kernels.transmittance import LaneIds, Lanes

WIDE = 4  # slices of 16 channels that are summed at once

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

# Entries of A of one fragment. `starts` keeps room for as many as were counted.
WEIGHTS = (
    WALK
    + """
    const int columns = valid.shape[1];
    int at = WRITE ? starts.data[place] : 0;
    Row total = zero;
    for (unsigned rest = left; rest; rest &= rest - 1) {
        const int row = __builtin_ctz(rest), y = y0 + row;
        const Row w = weight_of(row) * reinterpret_cast<const Row*>(valid.data)[y * columns + column];
        unsigned some = bits(w > zero);
        if (!WRITE) at += __builtin_popcount(some);
        if (!WRITE || !some) continue;
        total += w;
        float of[16] __attribute__((aligned(64)));
        *reinterpret_cast<Row*>(of) = w;
        for (; some; some &= some - 1, ++at) {
            const int i = __builtin_ctz(some);
            pixels.data[at] = 16 * row + i, weights.data[at] = of[i];
        }
    }
    if (WRITE) totals.data[place] = sum(total);
    else counts.data[place] = at;
"""
)

# What a tile's pixels add to its Gaussians, for one group of channels. The pixels of the tile are copied together
# first: where they lie in the map, a few lines of each would compete for the same places of the cache.
TILE_SUMS = """
    const int width = features.shape[1], slices = features.shape[2];
    const Row* const map =
        reinterpret_cast<const Row*>(features.data) + (size_t(y0) * width + x0) * slices + first_feature;
    Row* const block = reinterpret_cast<Row*>(packed.data) + size_t(slot) * 256 * SLICES;
    Row* const sums = reinterpret_cast<Row*>(sums_out.data) + size_t(slot) * sums_out.shape[1];
    int k = first;
    while (k < stop && listed.data[k] < first_rank) ++k;
    if (k == stop || listed.data[k] >= last_rank) return;
    for (int row = 0; row < rows; ++row)
        for (int i = 0; i < inside; ++i)
            for (int j = 0; j < SLICES; ++j)
                block[(16 * row + i) * SLICES + j] = map[(size_t(row) * width + i) * slices + j];
    // Meanwhile the pixels of the next tile come from memory, a few for each Gaussian of this one.
    const Row* const next = map + ((long long)(next_y0 - y0) * width + (next_x0 - x0)) * slices;
    const int per_fragment = (256 + stop - k - 1) / (stop - k);
    int wanted = 0;
    for (; k < stop; ++k) {
        for (int last = wanted + per_fragment; wanted < last; ++wanted)
            if (wanted < 16 * next_rows && (wanted & 15) < next_inside)
                for (int j = 0; j < SLICES; ++j)
                    __builtin_prefetch(next + (size_t(wanted >> 4) * width + (wanted & 15)) * slices + j, 0, 2);
        const int rank = listed.data[k], ahead = listed.data[k + AHEAD < stop ? k + AHEAD : stop - 1];
        if (rank >= last_rank) break;
        if (ahead < last_rank)
            for (int j = 0; j < SLICES; ++j) __builtin_prefetch(sums + size_t(ahead - first_rank) * SLICES + j, 1);
        Row of[SLICES];
        for (int j = 0; j < SLICES; ++j) of[j] = zero;
        const int end = starts.data[k + 1];
        for (int p = starts.data[k]; p < end; ++p) {
            const Row* const x = block + pixels.data[p] * SLICES;
            const float w = weights.data[p];
            for (int j = 0; j < SLICES; ++j) of[j] += w * x[j];
        }
        Row* const to = sums + size_t(rank - first_rank) * SLICES;
        for (int j = 0; j < SLICES; ++j) to[j] += of[j];
    }
"""

# Sums of a range of ranks before the first tile, and their way to the features.
CLEAR = """
    Row* const sums = reinterpret_cast<Row*>(sums_out.data) + size_t(slot) * sums_out.shape[1];
    for (int i = 0; i < count * SLICES; ++i) sums[i] = zero;
"""
DELIVER = """
    const Row* const sums = reinterpret_cast<const Row*>(summed.data) + size_t(slot) * summed.shape[1];
    for (int i = 0; i < last_rank - first_rank; ++i) {
        Row* const to = reinterpret_cast<Row*>(features_out.data)
                        + size_t(order.data[first_rank + i]) * features_out.shape[1] + first_slice;
        for (int j = 0; j < SLICES; ++j) to[j] += sums[size_t(i) * SLICES + j];
    }
"""

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
def fragment_weights(write: bool, squared: bool) -> wp.Function:
    """Device function that counts the pixels that one fragment of a tile weighs, or with `write` lists them with
    alpha T or its square."""

    @wp.func_native(snippet(WEIGHTS, WRITE=write, SQUARED=squared))
    def list_fragment(
        slot: int,
        rank: int,  # of the splat
        place: int,  # of the fragment in the lists
        column: int,  # of the tile
        x0: int,  # first pixel of the tile
        y0: int,
        open_rows: int,  # a bit for each row of which some pixel is open
        splats: wp.array[Splat],  # [V]
        valid: wp.array3d[Lanes],  # [H, tile columns, 1]
        starts: wp.array[int],  # [I + 1]
        knobs: Knobs,
        state: wp.array3d[Lanes],  # [slots, 16, 1] transmittance
        counts: wp.array[int],  # [I] out
        pixels: wp.array[wp.uint8],  # [pairs] out
        weights: wp.array[float],  # [pairs] out
        totals: wp.array[float],  # [I] out
    ): ...

    return list_fragment


@wp.func_native(snippet(TILE_SUMS, SLICES=WIDE, AHEAD=int(AHEAD)))
def sum_tile(
    slot: int,
    x0: int,  # first pixel of the tile
    y0: int,
    inside: int,  # columns of the tile that lie in the image
    rows: int,
    next_x0: int,  # the same of the next tile
    next_y0: int,
    next_inside: int,
    next_rows: int,
    first: int,  # place of the tile
    stop: int,
    first_rank: int,  # of the Gaussians to sum
    last_rank: int,  # one behind them
    listed: wp.array[int],  # [I]
    starts: wp.array[int],  # [I + 1]
    pixels: wp.array[wp.uint8],  # [pairs]
    weights: wp.array[float],  # [pairs]
    features: wp.array3d[Lanes],  # [H, W, S]
    first_feature: int,
    packed: wp.array2d[Lanes],  # [slots, 256 WIDE] scratch
    sums_out: wp.array2d[Lanes],  # [slots, ranks WIDE] added to
): ...


@wp.func_native(snippet(CLEAR, SLICES=WIDE))
def clear_sums(slot: int, count: int, sums_out: wp.array2d[Lanes]): ...


@wp.func_native(snippet(DELIVER, SLICES=WIDE))
def deliver_sums(
    slot: int,
    first_rank: int,
    last_rank: int,
    first_slice: int,
    order: wp.array[int],  # [V]
    summed: wp.array2d[Lanes],  # [slots, ranks WIDE]
    features_out: wp.array2d[Lanes],  # [N, S] added to
): ...


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
