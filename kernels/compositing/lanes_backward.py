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

A thread owns a patch of 4 x 4 tiles and replays them one after the other. What it adds up of a splat goes to one row:
no two threads write the same memory, and no number of threads changes the order of a sum. Rows of splats that no
pixel of the patch saw stay as they are: `used` says so in one byte each.
"""

from functools import cache

import warp as wp

from sgwarp.kernels.compositing.loops_backward import patch_replay
from sgwarp.kernels.gaussian import Splat
from sgwarp.kernels.projection.forward import Knobs
from sgwarp.kernels.transmittance import LANE_OPTIONS, Lanes

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
    replay_patch = patch_replay(wide, depth, absolute, MIN_PASSED)

    @wp.kernel(module="unique", module_options=LANE_OPTIONS, enable_backward=False)
    def composite_backward(
        # In:
        base: int,  # first place in `order` of this launch
        slot: int,  # scratch of this launch
        order: wp.array[int],  # [patches]
        offsets: wp.array[int],  # [tiles + 1]
        listed: wp.array[int],  # [I]
        row_places: wp.array2d[int],  # [V, 2] a, b: the row of sums in patch (r, c) is a + b r + c
        splats: wp.array[Splat],  # [V]
        features: wp.array3d[Lanes],  # [N, S, 1] channels in slices of 16 (wide)
        transmittance: wp.array2d[float],  # [H, W]
        v_alpha: wp.array2d[float],  # [H, W] gradient of 1 - transmittance
        last: wp.array2d[int],  # [H, W] last contributor, counted from its tile's first, -1 = none
        v_image: wp.array3d[float],  # [H, W, 3] gradient of the image
        pixels: wp.array3d[Lanes],  # [H, W, S] the same (wide)
        v_depth: wp.array2d[float],  # [H, W] gradient of the depth sum (depth)
        knobs: Knobs,
        width: int,
        height: int,
        gradient: wp.array3d[Lanes],  # [slots, 16, 16 S] scratch: the gradient of a tile's pixels (wide)
        # Out:
        rows_out: wp.array[Lanes],  # [R] rows of sums, column q in lane q; written where used
        used_out: wp.array[wp.uint8],  # [R] whether some pixel saw the splat in this patch; zeroed
        features_out: wp.array2d[Lanes],  # [R, S] gradient of the features; or empty (wide)
    ):
        """Paper eq. 1, differentiated, for one patch of tiles per thread."""
        replay_patch(
            slot,
            order[base + wp.tid()],
            offsets,
            listed,
            row_places,
            splats,
            features,
            transmittance,
            v_alpha,
            last,
            v_image,
            pixels,
            v_depth,
            knobs,
            width,
            height,
            gradient,
            rows_out,
            used_out,
            features_out,
        )

    return composite_backward
