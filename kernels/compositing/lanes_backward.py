"""Backward pass of compositing, lane schedule (CPU): every tile is replayed from its last fragment to its first.

With w = alpha T the weight of a fragment at a pixel, c its value under the image's gradient v (sum_i color_i v_i) and B
the same value of all that lies behind it, per unit of light that reaches it,

    dL/d color_i = sum_pixels w v_i,    dL/d log alpha = w (c - B),    B <- B + alpha (c - B) on the way to the front,

which starts from the background: B = dL/dT. Nothing is stored per fragment and pixel: T is recovered by division, and
alpha = 2^(level - u^2 - v^2) again by the forward's own device functions. What the geometry needs are the moments of
g = w (c - B) under 1, u, v, u^2, u v, v^2. In these whitened coordinates the moments stay of order one, so that needles
lose no digits on the way back to three dimensions (`projection/backward.py`).

Along a row only u changes, and from row to row u and v change by b and c. So a row adds g, d g and d^2 g to three
vectors, d its distance to the middle one of the rows at work, and the six moments follow once per fragment. Counted
from the middle, d b stays as small as a tile, and nothing large cancels.

The thread that owns a tile writes one row for each place of its list, so no two threads write the same memory. Places
that no pixel saw, a third in a room, have none: `used` says so in one byte each.
"""

from functools import cache

import warp as wp

from sgwarp.kernels.binning import AHEAD, TILE, prefetch
from sgwarp.kernels.compositing.loops import fragment_replay, read_tile
from sgwarp.kernels.gaussian import Splat
from sgwarp.kernels.projection.forward import Knobs
from sgwarp.kernels.transmittance import LANE_OPTIONS, LaneIds, Lanes

wp.set_module_options(LANE_OPTIONS)

MIN_PASSED = 1.0e-6  # 1 - alpha is never taken for less
MOMENTS = 6  # columns of a row: the moments of g, then colours, depth, |d mean| where they are asked for


def row_columns(wide: bool, depth: bool, absolute: bool) -> tuple[int, int, int]:
    """Column of the depth, first column of |d mean|, and number of columns of a row."""
    at_depth = MOMENTS + (0 if wide else 3)
    at_absolute = at_depth + int(depth)
    return at_depth, at_absolute, at_absolute + 2 * int(absolute)


@cache
def make_composite_backward(wide: bool, depth: bool, absolute: bool) -> wp.Kernel:
    """Kernel that differentiates compositing.

    Args:
        wide: The values are `features` of any number of channels instead of the splats' three colours. Their
            gradient is the image's gradient lifted: here, where there is room for it, or by `lifting/lanes.py`.
        depth: The sum of alpha T z has a gradient too.
        absolute: Also sum the magnitudes of each pixel's gradient of the projected mean.
    """
    replay_fragment = fragment_replay(wide, depth, absolute, MIN_PASSED)

    @wp.kernel(module="unique", module_options=LANE_OPTIONS, enable_backward=False)
    def composite_backward(
        # In:
        base: int,  # first tile of this launch
        slot: int,  # scratch of this launch
        offsets: wp.array[int],  # [tiles + 1]
        listed: wp.array[int],  # [I]
        splats: wp.array[Splat],  # [V]
        features: wp.array3d[Lanes],  # [N, S, 1] channels in slices of 16 (wide)
        transmittance: wp.array2d[Lanes],  # [H, tile columns]
        v_transmittance: wp.array2d[Lanes],  # [H, tile columns] its gradient
        last: wp.array2d[LaneIds],  # [H, tile columns] last contributor, counted from its tile's first, -1 = none
        gradient: wp.array3d[Lanes],  # [H, tile columns, 3] of the image; or scratch [slots, 16, 16 S] (wide)
        pixels: wp.array3d[Lanes],  # [H, W, S] gradient of the image (wide)
        depth_gradient: wp.array2d[Lanes],  # [H, tile columns] of the depth sum (depth)
        knobs: Knobs,
        width: int,
        height: int,
        state: wp.array3d[Lanes],  # [slots, 16, 2] scratch: transmittance, value behind
        reach: wp.array2d[int],  # [slots, 16] scratch: last contributor of each row
        # Out:
        rows_out: wp.array[Lanes],  # [I] by place, column q in lane q; written where used
        used_out: wp.array[wp.uint8],  # [I] by place: whether some pixel saw the fragment
        features_out: wp.array2d[Lanes],  # [I, S] gradient of the features, by place; or empty (wide)
    ):
        """Paper eq. 1, differentiated, for one tile per thread."""
        tile = base + wp.tid()
        columns = (width + TILE - 1) / TILE
        column = tile % columns
        x0 = column * TILE
        y0 = (tile / columns) * TILE
        tile_reach = int(-1)
        for row in range(TILE):
            row_reach = int(-1)
            if y0 + row < height:
                state[slot, row, 0] = transmittance[y0 + row, column]
                state[slot, row, 1] = v_transmittance[y0 + row, column]
                row_reach = wp.max(last[y0 + row, column])
            reach[slot, row] = row_reach
            tile_reach = wp.max(tile_reach, row_reach)
        first = offsets[tile]
        for k in range(first + tile_reach + 1, offsets[tile + 1]):
            used_out[k] = wp.uint8(0)
            if wp.static(wide):
                for s in range(features_out.shape[1]):
                    features_out[k, s] = Lanes(0.0)
        if wp.static(wide):
            read_tile(slot, x0, y0, wp.min(TILE, height - y0), wp.min(TILE, width - x0), pixels, gradient)
        for done in range(tile_reach + 1):
            order = tile_reach - done  # counted from the tile's first, as all orders here
            k = first + order
            prefetch(splats, listed[first + wp.max(order - AHEAD, 0)])
            replay_fragment(
                slot,
                listed[k],
                k,
                order,
                column,
                x0,
                y0,
                splats,
                features,
                last,
                gradient,
                pixels,
                depth_gradient,
                knobs,
                state,
                reach,
                rows_out,
                used_out,
                features_out,
            )

    return composite_backward
