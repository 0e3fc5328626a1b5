"""The strongest contributors of every pixel, lane schedule (CPU): a sorted list per pixel, 16 lists in one vector.

The lists of a row are kept as vectors, place by place: the largest weight of 16 pixels, then the second largest, and
so on. A fragment enters all 16 lists at once, from the last place up, without a branch per pixel.
"""

import warp as wp

from sgwarp.kernels.binning import AHEAD, TILE, fragment_of, prefetch
from sgwarp.kernels.compositing.lanes import (
    CLOSE_EVERY,
    lane_alphas,
    lane_attenuated,
    lane_contributions,
    open_lanes,
    open_row_mask,
)
from sgwarp.kernels.gaussian import Splat
from sgwarp.kernels.projection.forward import Knobs
from sgwarp.kernels.transmittance import LANE_OPTIONS, LANES, LaneIds, Lanes

wp.set_module_options(LANE_OPTIONS)

ABOVE_ALL = wp.constant(2.0)  # no weight exceeds 1


@wp.func
def enter_lists(
    w: Lanes,
    gaussian: int,
    last: int,
    slot: int,
    row: int,
    weights: wp.array3d[Lanes],
    owners: wp.array3d[LaneIds],
) -> bool:
    """Enter a Gaussian with weights w into the lists of a row; whether it entered any.

    Places behind `last` are empty in every list. Of equal weights the earlier stays in front: its place is taken only
    by a larger one.
    """
    place = last
    while place >= 0:
        here = weights[slot, row, place]
        if wp.max(w - here) <= 0.0:  # then it enters none further up
            break
        owner = owners[slot, row, place]
        before = Lanes(ABOVE_ALL)
        owner_before = owner
        if place > 0:
            before = weights[slot, row, place - 1]
            owner_before = owners[slot, row, place - 1]
        for i in range(LANES):
            moves = w[i] > before[i]
            enters = w[i] > here[i]
            owner[i] = wp.where(moves, owner_before[i], wp.where(enters, gaussian, owner[i]))
            here[i] = wp.where(moves, before[i], wp.where(enters, w[i], here[i]))
        weights[slot, row, place] = here
        owners[slot, row, place] = owner
        place -= 1
    return place < last


@wp.func
def still_ranked(mask: int, slot: int, places: int, state: wp.array3d[Lanes], weights: wp.array3d[Lanes]) -> int:
    """Clear the bits of rows that are decided: what is left of T is no more than the least weight in every list."""
    kept = mask
    for row in range(TILE):
        if wp.max(state[slot, row, 0] - weights[slot, row, places - 1]) <= 0.0:
            kept = kept & ~(1 << row)
    return kept


@wp.kernel
def rank_contributors(
    # In:
    base: int,
    slot: int,
    offsets: wp.array[int],  # [tiles + 1] first place of each tile
    listed: wp.array[int],  # [I] ranks, tile by tile, front to back
    splats: wp.array[Splat],  # [V] in depth order
    knobs: Knobs,
    width: int,  # [pixels]
    height: int,
    state: wp.array3d[Lanes],  # [slots, 16, 1] scratch
    weights: wp.array3d[Lanes],  # [slots, 16, K] scratch
    owners: wp.array3d[LaneIds],  # [slots, 16, K] scratch
    used: wp.array2d[int],  # [slots, 16] scratch: places in use of the longest list of each row
    # Out:
    ids_out: wp.array3d[int],  # [H, W, K] Gaussians by descending alpha T, then by depth; -1 = none
    weights_out: wp.array3d[float],  # [H, W, K] their alpha T; 0 = none
):
    """The K largest alpha T of paper eq. 1 at each pixel, for one tile per thread."""
    tile = base + wp.tid()
    columns = (width + TILE - 1) / TILE
    x0 = (tile % columns) * TILE
    y0 = (tile / columns) * TILE
    places = ids_out.shape[2]
    for row in range(TILE):
        state[slot, row, 0] = open_lanes(x0, width)
        used[slot, row] = 0
        for place in range(places):
            weights[slot, row, place] = Lanes(0.0)
            owners[slot, row, place] = LaneIds(-1)
    open_rows = open_row_mask(y0, height)
    first = offsets[tile]
    stop = offsets[tile + 1]
    for k in range(first, stop):
        prefetch(splats, listed[wp.min(k + AHEAD, stop - 1)])
        f = fragment_of(splats, listed[k], x0, y0)
        for row in range(f.first_row, f.last_row + 1):
            if (open_rows >> row) & 1 != 0:
                T = state[slot, row, 0]
                alphas = lane_alphas(f, row, knobs)
                w = lane_contributions(alphas, T, knobs)
                state[slot, row, 0] = lane_attenuated(alphas, T, knobs)
                last = wp.min(used[slot, row], places - 1)
                if enter_lists(w, f.gaussian, last, slot, row, weights, owners):
                    used[slot, row] = last + 1
        if (k - first) % CLOSE_EVERY == CLOSE_EVERY - 1:
            open_rows = still_ranked(open_rows, slot, places, state, weights)
            if open_rows == 0:
                break
    for row in range(wp.min(TILE, height - y0)):
        for place in range(places):
            w = weights[slot, row, place]
            owner = owners[slot, row, place]
            for i in range(wp.min(LANES, width - x0)):
                ids_out[y0 + row, x0 + i, place] = owner[i]
                weights_out[y0 + row, x0 + i, place] = w[i]
