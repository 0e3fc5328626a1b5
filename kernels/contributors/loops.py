"""Innermost loops of ranking contributors, lane schedule, in C++ (`native.py`)."""

import warp as wp

from sgwarp.kernels.compositing.loops import REACHING
from sgwarp.kernels.native import Seen, snippet
from sgwarp.kernels.projection.forward import Knobs
from sgwarp.kernels.transmittance import LaneIds, Lanes

# A fragment enters the 16 lists of a row at once, from the last place up; of equal weights the earlier stays in front.
# Places behind the last used are empty in every list.
RANK = (
    REACHING
    + """
    if (!left) return true;
    const int places = weights.shape[2];
    Row& kept = *reinterpret_cast<Row*>(state.data + slot * 16 + row);
    Row* const w_of = reinterpret_cast<Row*>(weights.data) + size_t(slot * 16 + row) * places;
    Ints* const id_of = reinterpret_cast<Ints*>(owners.data) + size_t(slot * 16 + row) * places;
    int in_use = used.data[slot * 16 + row];
    Row T = kept;
    for (; left; left &= left - 1) {
        const auto& seen = batch.data[slot * BATCH + __builtin_ctz(left)];
        const Row w = take_seen(seen, row, knobs, T);
        const int last = in_use < places ? in_use : places - 1;
        Row here = w_of[last];
        if (!bits(w > here)) continue;
        in_use = last + 1;
        const int gaussian = seen.splat.gaussian;
        int place = last;
        for (; place > 0; --place) {
            const Row before = w_of[place - 1];
            const Ints moves = w > before, enters = w > here;
            w_of[place] = moves ? before : enters ? w : here;
            id_of[place] = moves ? id_of[place - 1] : enters ? gaussian : id_of[place];
            here = before;
            if (!bits(moves)) break;
        }
        if (place == 0) {
            const Ints enters = w > here;
            w_of[0] = enters ? w : here;
            id_of[0] = enters ? gaussian : id_of[0];
        }
    }
    kept = T;
    used.data[slot * 16 + row] = in_use;
    return bits(T > w_of[places - 1]) != 0;
"""
)

# The lists of a row, place by place, as those of its pixels.
WRITE = """
    const int places = weights.shape[2];
    const Row* const w_of = reinterpret_cast<const Row*>(weights.data) + size_t(slot * 16 + row) * places;
    const Row* const id_of = reinterpret_cast<const Row*>(owners.data) + size_t(slot * 16 + row) * places;
    const size_t first = (size_t(y) * ids_out.shape[1] + x0) * places;
    const auto write = [&](const Row* of, float* to) {
        for (int from = 0; from < places; from += 16) {
            const int count = places - from < 16 ? places - from : 16;
            Row square[16];
            for (int j = 0; j < 16; ++j) square[j] = j < count ? of[from + j] : zero;
            if (count > 1) transpose(square);
            for (int i = 0; i < inside; ++i) {
                float* const here = to + size_t(i) * places + from;
                const float* const row_of = reinterpret_cast<const float*>(count > 1 ? square + i : square);
                if (count == 16) *reinterpret_cast<Row*>(here) = square[i];
                else if (count == 1) here[0] = row_of[i];
                else for (int j = 0; j < count; ++j) here[j] = row_of[j];
            }
        }
    };
    write(w_of, weights_out.data + first);
    write(id_of, reinterpret_cast<float*>(ids_out.data + first));
"""


@wp.func_native(snippet(RANK))
def rank_row(
    slot: int,
    row: int,
    batch: wp.array2d[Seen],  # [slots, BATCH]
    reached: wp.array2d[int],  # [slots, 16]
    knobs: Knobs,
    state: wp.array3d[Lanes],  # [slots, 16, 1] transmittance
    weights: wp.array3d[Lanes],  # [slots, 16, K] by descending weight
    owners: wp.array3d[LaneIds],  # [slots, 16, K]
    used: wp.array2d[int],  # [slots, 16] places in use of the longest list of each row
) -> bool: ...  # may a later fragment enter some list of the row?


@wp.func_native(snippet(WRITE))
def write_lists(
    slot: int,
    row: int,
    y: int,  # of the row in the image
    x0: int,  # its first pixel
    inside: int,  # pixels of the row that lie in the image
    weights: wp.array3d[Lanes],
    owners: wp.array3d[LaneIds],
    ids_out: wp.array3d[int],  # [H, W, K]
    weights_out: wp.array3d[float],  # [H, W, K]
): ...
