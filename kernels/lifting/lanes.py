"""Feature lifting, lane schedule (CPU): the transpose of compositing.

The renderer is a matrix A with one entry alpha T per (pixel, Gaussian); lifting applies its transpose to a feature
map. The thread that owns a tile sums each fragment's contribution over the tile's pixels in registers and writes one
row for each place of its list; `shared.py` adds up the rows of each Gaussian. No two threads write the same memory, so
the result has the same bits for any number of threads.
"""

from functools import cache

import warp as wp

from sgwarp.kernels.binning import AHEAD, TILE, prefetch
from sgwarp.kernels.compositing.lanes import CLOSE_EVERY, open_tile, still_open
from sgwarp.kernels.gaussian import Splat
from sgwarp.kernels.lifting.loops import fragment_lift, fragment_lift_ids
from sgwarp.kernels.projection.forward import Knobs
from sgwarp.kernels.transmittance import LANE_OPTIONS, LaneIds, Lanes

wp.set_module_options(LANE_OPTIONS)


@cache
def make_lift_dense(slices: int, squared: bool = False) -> wp.Kernel:
    """Kernel that lifts `16 slices` channels of a dense map (1 or 4 slices), with weight alpha T or its square."""
    lift_fragment = fragment_lift(slices, squared)

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
        open_rows = open_tile(slot, x0, y0, width, height, 1, 1, state)
        first = offsets[tile]
        stop = offsets[tile + 1]
        for k in range(first, stop):
            prefetch(splats, listed[wp.min(k + AHEAD, stop - 1)])
            lift_fragment(
                slot,
                listed[k],
                k,
                column,
                x0,
                y0,
                open_rows,
                splats,
                features,
                valid,
                first_slice,
                knobs,
                state,
                rows_out,
                weights_out,
            )
            if (k - first) % CLOSE_EVERY == CLOSE_EVERY - 1:
                open_rows = still_open(open_rows, state, slot)

    return lift_dense


@cache
def make_lift_ids(squared: bool) -> wp.Kernel:
    """Kernel that adds alpha T, or its square, up by id."""
    lift_fragment_ids = fragment_lift_ids(squared)

    @wp.kernel(module="unique", module_options=LANE_OPTIONS, enable_backward=False)
    def lift_ids(
        # In:
        base: int,
        slot: int,
        chosen: wp.array[int],  # tiles to lift, or empty: all
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
        if chosen.shape[0] > 0:
            tile = chosen[tile]
        columns = (width + TILE - 1) / TILE
        x0 = (tile % columns) * TILE
        y0 = (tile / columns) * TILE
        open_rows = open_tile(slot, x0, y0, width, height, 1, 1, state)
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
            place = row_starts[tile] + (k - first) * ids
            starts_out[k] = place
            lift_fragment_ids(
                slot,
                listed[k],
                place,
                tile,
                x0,
                y0,
                open_rows,
                ids,
                plain,
                splats,
                local_ids,
                uniform,
                knobs,
                state,
                weights_out,
            )
            if (k - first) % CLOSE_EVERY == CLOSE_EVERY - 1:
                open_rows = still_open(open_rows, state, slot)

    return lift_ids


lift_ids = make_lift_ids(False)
