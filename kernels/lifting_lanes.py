"""Feature lifting, lane schedule (CPU): the transpose of compositing.

The renderer is a matrix A with one entry alpha T per (pixel, Gaussian); lifting applies its transpose to a feature
map. The thread that owns a tile sums each fragment's contribution over the tile's pixels in registers and writes one
row for each place of its list; `lifting.py` adds up the rows of each Gaussian. No two threads write the same memory, so
the result has the same bits for any number of threads.
"""

from functools import cache

import warp as wp

from sgwarp.kernels.binning import AHEAD, TILE, fragment_of, prefetch
from sgwarp.kernels.compositing_lanes import (
    CLOSE_EVERY,
    lane_alphas,
    lane_attenuated,
    lane_contributions,
    open_lanes,
    open_row_mask,
    still_open,
)
from sgwarp.kernels.gaussian import Splat
from sgwarp.kernels.projection import Knobs
from sgwarp.kernels.transmittance import LANE_OPTIONS, LANES, LaneIds, Lanes

wp.set_module_options(LANE_OPTIONS)

FEW_IDS = wp.constant(4)  # up to here a masked sum per id beats adding pixel by pixel


@wp.func
def lane_sum(values: Lanes) -> float:
    total = float(0.0)
    for i in range(LANES):
        total += values[i]
    return total


@wp.func
def lane_sum_of(values: Lanes, ids: LaneIds, wanted: int) -> float:
    """Sum over the lanes whose id is `wanted`."""
    total = float(0.0)
    for i in range(LANES):
        total += wp.where(ids[i] == wanted, values[i], 0.0)
    return total


@cache
def make_lift_dense(slices: int) -> wp.Kernel:
    """Kernel that lifts `16 slices` channels of a dense map (1 or 4 slices)."""

    @wp.kernel(module="unique", module_options=LANE_OPTIONS, enable_backward=False)
    def lift_dense(
        # In:
        base: int,  # first tile of this launch
        slot: int,  # scratch of this launch
        offsets: wp.array[int],  # [tiles + 1]
        listed: wp.array[int],  # [I]
        splats: wp.array[Splat],  # [V]
        features: wp.array3d[Lanes],  # [H, W, S] channels in slices of 16
        valid: wp.array3d[Lanes],  # [H, tile columns, 1] 1 where the pixel carries semantics, else 0
        first_slice: int,  # of this pass
        knobs: Knobs,
        width: int,
        height: int,
        state: wp.array3d[Lanes],  # [slots, 16, 1] scratch
        # Out:
        rows_out: wp.array2d[Lanes],  # [I, slices] sum over the tile's pixels of alpha T f, by place
        weights_out: wp.array[float],  # [I] sum of alpha T over the pixels that carry semantics, by place
    ):
        """A^T f for one tile per thread."""
        tile = base + wp.tid()
        columns = (width + TILE - 1) / TILE
        column = tile % columns
        x0 = column * TILE
        y0 = (tile / columns) * TILE
        inside = wp.min(LANES, width - x0)
        for row in range(TILE):
            state[slot, row, 0] = open_lanes(x0, width)
        open_rows = open_row_mask(y0, height)
        first = offsets[tile]
        stop = offsets[tile + 1]
        for k in range(first, stop):
            prefetch(splats, listed[wp.min(k + AHEAD, stop - 1)])
            f = fragment_of(splats, listed[k], x0, y0)
            sum0 = Lanes(0.0)
            sum1 = Lanes(0.0)
            sum2 = Lanes(0.0)
            sum3 = Lanes(0.0)
            weight = Lanes(0.0)
            for row in range(f.first_row, f.last_row + 1):
                if (open_rows >> row) & 1 != 0:
                    T = state[slot, row, 0]
                    alphas = lane_alphas(f, row, knobs)
                    y = y0 + row
                    w = wp.cw_mul(lane_contributions(alphas, T, knobs), valid[y, column, 0])
                    state[slot, row, 0] = lane_attenuated(alphas, T, knobs)
                    weight += w
                    if wp.static(slices == 1):
                        if inside == LANES:
                            # Four sums in turn: one alone would wait for its own last addition.
                            for i in range(0, LANES, 4):
                                sum0 += w[i] * features[y, x0 + i, first_slice]
                                sum1 += w[i + 1] * features[y, x0 + i + 1, first_slice]
                                sum2 += w[i + 2] * features[y, x0 + i + 2, first_slice]
                                sum3 += w[i + 3] * features[y, x0 + i + 3, first_slice]
                        else:
                            for i in range(inside):
                                sum0 += w[i] * features[y, x0 + i, first_slice]
                    else:
                        for i in range(inside):
                            sum0 += w[i] * features[y, x0 + i, first_slice]
                            sum1 += w[i] * features[y, x0 + i, first_slice + 1]
                            sum2 += w[i] * features[y, x0 + i, first_slice + 2]
                            sum3 += w[i] * features[y, x0 + i, first_slice + 3]
            if wp.static(slices == 1):
                rows_out[k, 0] = (sum0 + sum1) + (sum2 + sum3)
            else:
                rows_out[k, 0] = sum0
                rows_out[k, 1] = sum1
                rows_out[k, 2] = sum2
                rows_out[k, 3] = sum3
            weights_out[k] = lane_sum(weight)
            if (k - first) % CLOSE_EVERY == CLOSE_EVERY - 1:
                open_rows = still_open(open_rows, state, slot)

    return lift_dense


@wp.kernel
def lift_ids(
    # In:
    base: int,
    slot: int,
    offsets: wp.array[int],  # [tiles + 1]
    listed: wp.array[int],  # [I]
    splats: wp.array[Splat],  # [V]
    local_ids: wp.array2d[LaneIds],  # [tiles, 16] place of each pixel's id in its tile's list, -1 = none
    uniform: wp.array2d[int],  # [tiles, 16] the local id if the whole row shares it, else -2
    row_starts: wp.array[int],  # [tiles + 1] first weight of each tile
    knobs: Knobs,
    width: int,
    height: int,
    state: wp.array3d[Lanes],  # [slots, 16, 1] scratch
    # Out:
    weights_out: wp.array[float],  # zeroed; for each place one weight per id of its tile
    starts_out: wp.array[int],  # [I] first weight of each place
):
    """Sum of alpha T by id: the cost does not depend on the number of feature channels."""
    tile = base + wp.tid()
    columns = (width + TILE - 1) / TILE
    x0 = (tile % columns) * TILE
    y0 = (tile / columns) * TILE
    for row in range(TILE):
        state[slot, row, 0] = open_lanes(x0, width)
    open_rows = open_row_mask(y0, height)
    first = offsets[tile]
    stop = offsets[tile + 1]
    count = wp.max(stop - first, 1)
    ids = (row_starts[tile + 1] - row_starts[tile]) / count
    plain = ids == 1
    for row in range(TILE):
        if uniform[tile, row] != 0:
            plain = False
    for k in range(first, stop):
        prefetch(splats, listed[wp.min(k + AHEAD, stop - 1)])
        f = fragment_of(splats, listed[k], x0, y0)
        place = row_starts[tile] + (k - first) * ids
        starts_out[k] = place
        if plain:
            total = Lanes(0.0)
            for row in range(f.first_row, f.last_row + 1):
                if (open_rows >> row) & 1 != 0:
                    T = state[slot, row, 0]
                    alphas = lane_alphas(f, row, knobs)
                    total += lane_contributions(alphas, T, knobs)
                    state[slot, row, 0] = lane_attenuated(alphas, T, knobs)
            weights_out[place] = lane_sum(total)
            if (k - first) % CLOSE_EVERY == CLOSE_EVERY - 1:
                open_rows = still_open(open_rows, state, slot)
            continue
        run = int(-1)  # id shared by the rows summed in `total` so far
        total = Lanes(0.0)
        for row in range(f.first_row, f.last_row + 1):
            if (open_rows >> row) & 1 != 0:
                T = state[slot, row, 0]
                alphas = lane_alphas(f, row, knobs)
                w = lane_contributions(alphas, T, knobs)
                state[slot, row, 0] = lane_attenuated(alphas, T, knobs)
                shared = uniform[tile, row]
                if shared == -2:
                    pixels = local_ids[tile, row]
                    if ids <= FEW_IDS:
                        for m in range(ids):
                            weights_out[place + m] += lane_sum_of(w, pixels, m)
                    else:
                        for i in range(LANES):
                            if pixels[i] >= 0:
                                weights_out[place + pixels[i]] += w[i]
                elif shared == run:
                    total += w
                else:
                    if run >= 0:
                        weights_out[place + run] += lane_sum(total)
                    run = shared
                    total = w
        if run >= 0:
            weights_out[place + run] += lane_sum(total)
        if (k - first) % CLOSE_EVERY == CLOSE_EVERY - 1:
            open_rows = still_open(open_rows, state, slot)
