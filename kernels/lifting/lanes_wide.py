"""Lifting many dense channels, lane schedule (CPU): the matrix A first, then its transpose times the map.

`lanes.py` walks the tiles once for every few channels and writes a row for every intersection, more memory than the
features themselves. Here the weights alpha T are written down once, pair by pair of a fragment and a pixel. Then a
thread takes a group of channels, and if there are fewer groups than threads a range of the depth order, through all
tiles: its sums are small enough to stay in the cache, and nobody else's. They are added up tile by tile, as `lanes.py`
does it, so the result has the same bits as there, for any number of threads.
"""

from functools import cache

import warp as wp

from sgwarp.kernels.binning import AHEAD, TILE, prefetch
from sgwarp.kernels.compositing.lanes import CLOSE_EVERY, open_tile, still_open
from sgwarp.kernels.gaussian import Splat
from sgwarp.kernels.lifting.loops import WIDE as GROUP
from sgwarp.kernels.lifting.loops import clear_sums, deliver_sums, fragment_weights, sum_tile
from sgwarp.kernels.projection.forward import Knobs
from sgwarp.kernels.transmittance import LANE_OPTIONS, Lanes

wp.set_module_options(LANE_OPTIONS)

WIDE = wp.constant(GROUP)  # slices of 16 channels in a group


@cache
def make_list_weights(write: bool, squared: bool) -> wp.Kernel:
    """Kernel that counts the pixels a fragment weighs, or with `write` lists them with alpha T or its square."""
    list_fragment = fragment_weights(write, squared)

    @wp.kernel(module="unique", module_options=LANE_OPTIONS, enable_backward=False)
    def list_weights(
        # In:
        base: int,  # first tile of this launch
        slot: int,  # scratch of this launch
        offsets: wp.array[int],  # [tiles + 1]
        listed: wp.array[int],  # [I]
        splats: wp.array[Splat],  # [V]
        valid: wp.array3d[Lanes],  # [H, tile columns, 1] 1 where the pixel carries semantics, else 0
        starts: wp.array[int],  # [I + 1] first pair of each place; only with `write`
        knobs: Knobs,
        width: int,
        height: int,
        state: wp.array3d[Lanes],  # [slots, 16, 1] scratch
        # Out:
        counts_out: wp.array[int],  # [I] pairs of each place; not written with `write`
        pixels_out: wp.array[wp.uint8],  # [pairs] 16 y + x within the tile; only with `write`
        weights_out: wp.array[float],  # [pairs] alpha T; only with `write`
        totals_out: wp.array[float],  # [I] sum of alpha T of each place; only with `write`
    ):
        """The entries of A, fragment by fragment, for one tile per thread."""
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
            list_fragment(
                slot,
                listed[k],
                k,
                column,
                x0,
                y0,
                open_rows,
                splats,
                valid,
                starts,
                knobs,
                state,
                counts_out,
                pixels_out,
                weights_out,
                totals_out,
            )
            if (k - first) % CLOSE_EVERY == CLOSE_EVERY - 1:
                open_rows = still_open(open_rows, state, slot)

    return list_weights


@wp.kernel
def sum_tiles(
    # In:
    base: int,  # first share of this launch: a group of channels and a range of ranks
    slot: int,  # scratch of this launch
    ranges: int,  # of ranks
    offsets: wp.array[int],  # [tiles + 1]
    listed: wp.array[int],  # [I]
    order: wp.array[int],  # [V] visible Gaussians
    starts: wp.array[int],  # [I + 1] first pair of each place
    pixels: wp.array[wp.uint8],  # [pairs] 16 y + x within the tile
    weights: wp.array[float],  # [pairs] alpha T
    features: wp.array3d[Lanes],  # [H, W, S] channels in slices of 16
    first_feature: int,  # slice of the map, of this pass
    first_slice: int,  # and of the sums
    width: int,
    height: int,
    packed: wp.array2d[Lanes],  # [slots, 256 WIDE] scratch
    sums: wp.array2d[Lanes],  # [slots, ranks of a range WIDE] scratch
    # Out:
    features_out: wp.array2d[Lanes],  # [N, S] added to
):
    """A^T f for one group of channels and one range of ranks per thread, tile by tile."""
    share = base + wp.tid()
    group = WIDE * (share / ranges)
    per_range = (order.shape[0] + ranges - 1) / ranges
    first_rank = (share % ranges) * per_range
    last_rank = wp.min(first_rank + per_range, order.shape[0])
    clear_sums(slot, last_rank - first_rank, sums)
    columns = (width + TILE - 1) / TILE
    tiles = offsets.shape[0] - 1
    for tile in range(tiles):
        next_tile = wp.min(tile + 1, tiles - 1)
        next_x0 = (next_tile % columns) * TILE
        next_y0 = (next_tile / columns) * TILE
        x0 = (tile % columns) * TILE
        y0 = (tile / columns) * TILE
        sum_tile(
            slot,
            x0,
            y0,
            wp.min(TILE, width - x0),
            wp.min(TILE, height - y0),
            next_x0,
            next_y0,
            wp.min(TILE, width - next_x0),
            wp.min(TILE, height - next_y0),
            offsets[tile],
            offsets[tile + 1],
            first_rank,
            last_rank,
            listed,
            starts,
            pixels,
            weights,
            features,
            first_feature + group,
            packed,
            sums,
        )
    deliver_sums(slot, first_rank, last_rank, first_slice + group, order, sums, features_out)
