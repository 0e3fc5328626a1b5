"""The strongest contributors of every pixel, lane schedule (CPU): a sorted list per pixel, 16 lists in one vector.

The lists of a row are kept as vectors, place by place: the largest weight of 16 pixels, then the second largest, and
so on. Fragments come in batches as in compositing, and row by row those that reach it enter the lists (`loops.py`).
"""

import warp as wp

from sgwarp.kernels.binning import TILE
from sgwarp.kernels.compositing.lanes import open_lanes, open_row_mask
from sgwarp.kernels.compositing.loops import gather_batch
from sgwarp.kernels.contributors.loops import rank_row, write_lists
from sgwarp.kernels.gaussian import Splat
from sgwarp.kernels.native import BATCH, Seen
from sgwarp.kernels.projection.forward import Knobs
from sgwarp.kernels.transmittance import LANE_OPTIONS, LANES, LaneIds, Lanes

wp.set_module_options(LANE_OPTIONS)


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
    batch: wp.array2d[Seen],  # [slots, BATCH] scratch
    reached: wp.array2d[int],  # [slots, 16] scratch: the rows that each of them reaches
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
    for start in range(first, stop, BATCH):
        gather_batch(slot, start, stop, x0, y0, listed, splats, knobs, batch, reached)
        for row in range(TILE):
            if (open_rows >> row) & 1 != 0:  # noqa: SIM102 - Warp evaluates both sides of an `and`
                if not rank_row(slot, row, batch, reached, knobs, state, weights, owners, used):
                    open_rows = open_rows & ~(1 << row)
        if open_rows == 0:
            break
    for row in range(wp.min(TILE, height - y0)):
        write_lists(slot, row, y0 + row, x0, wp.min(LANES, width - x0), weights, owners, ids_out, weights_out)
