"""Backward pass of compositing, lane schedule (CPU): every tile is replayed from its last fragment to its first.

With w = alpha T the weight of a fragment at a pixel, c its value under the image's gradient v (sum_i color_i v_i) and B
the same value of all that lies behind it, per unit of light that reaches it,

    dL/d color_i = sum_pixels w v_i,    dL/d log alpha = w (c - B),    B <- B + alpha (c - B) on the way to the front,

which starts from the background: B = dL/dT. Nothing is stored per fragment and pixel: T is recovered by division, and
alpha = 2^(level - u^2 - v^2) again by the forward's own device functions. What the geometry needs are the moments of
g = w (c - B) under 1, u, v, u^2, u v, v^2. In these whitened coordinates the moments stay of order one, so that needles
lose no digits on the way back to three dimensions (`projection_backward.py`).

Along a row only u changes, and from row to row u and v change by b and c. So a row adds g, d g and d^2 g to three
vectors, d its distance to the middle one of the rows at work, and the six moments follow once per fragment. Counted
from the middle, d b stays as small as a tile, and nothing large cancels.

The thread that owns a tile writes one row per intersection, so no two threads write the same memory.
"""

from functools import cache

import warp as wp

from sgwarp.kernels.binning import AHEAD, TILE, fragment_of, prefetch
from sgwarp.kernels.compositing_lanes import lane_alphas
from sgwarp.kernels.gaussian import Splat
from sgwarp.kernels.projection import Knobs
from sgwarp.kernels.transmittance import HALF_ROW, LANE_OFFSETS, LANE_OPTIONS, LANES, LaneIds, Lanes

wp.set_module_options(LANE_OPTIONS)

MIN_PASSED = wp.constant(1.0e-6)  # 1 - alpha is never taken for less
MOST_COLUMNS = 12
ROW = wp.constant(MOST_COLUMNS)
SUMS = MOST_COLUMNS + MOST_COLUMNS // 2  # vectors of scratch per fragment: two levels of the tree that sums the lanes
MOMENTS = 6  # columns of a row: the moments of g, then colours, depth, |d mean| where they are asked for
BATCH = wp.constant(16)  # fragments whose values under the gradient are computed at a time


def row_columns(wide: bool, depth: bool, absolute: bool) -> tuple[int, int, int]:
    """Where a row holds the depth and the first of |d mean|, and how many columns it has."""
    at_depth = MOMENTS + (0 if wide else 3)
    at_absolute = at_depth + int(depth)
    return at_depth, at_absolute, at_absolute + 2 * int(absolute)


@cache
def make_fold(half: int) -> wp.Function:
    """Device function that folds every block of 2 `half` lanes of two vectors in half, and joins them in one."""

    @wp.func
    def fold(x: Lanes, y: Lanes) -> Lanes:
        folded = Lanes(0.0)
        for block in range(wp.static(8 // half)):
            for i in range(half):
                low = 2 * half * block + i
                folded[half * block + i] = x[low] + x[low + half]
                folded[8 + half * block + i] = y[low] + y[low + half]
        return folded

    return fold


@wp.func
def feature_value(
    features: wp.array3d[Lanes], gaussian: int, gradient: wp.array3d[Lanes], y: int, column: int, slices: int
) -> Lanes:
    """sum_i x_i v_i at the 16 pixels of a row, over all slices of channels."""
    even = Lanes(0.0)  # two sums in turn: one alone would wait for its own last addition
    odd = Lanes(0.0)
    for s in range(slices):
        x = features[gaussian, s, 0]
        for c in range(0, LANES, 2):
            even += x[c] * gradient[y, column, LANES * s + c]
            odd += x[c + 1] * gradient[y, column, LANES * s + c + 1]
    return even + odd


@cache
def make_composite_backward(wide: bool, depth: bool, absolute: bool) -> wp.Kernel:
    """Kernel that differentiates compositing.

    Args:
        wide: The values are `features` of any number of channels instead of the splats' three colours; gradients with
            respect to features are not computed here: they are the image's gradient, lifted.
        depth: The sum of alpha T z has a gradient too; it is the plane after the channels.
        absolute: Also sum the magnitudes of each pixel's gradient of the projected mean.
    """
    at_depth, at_absolute, columns_of_row = row_columns(wide, depth, absolute)
    pairs = (columns_of_row + 1) // 2
    quads = (pairs + 1) // 2
    fold_8, fold_4, fold_2, fold_1 = (make_fold(half) for half in (8, 4, 2, 1))

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
        gradient: wp.array3d[Lanes],  # [H, tile columns, padded C (+ 1)] gradient of the image (and depth sum)
        knobs: Knobs,
        width: int,
        height: int,
        state: wp.array3d[Lanes],  # [slots, 16, 2] scratch: transmittance, value behind
        reach: wp.array2d[int],  # [slots, 16] scratch: last contributor of each row
        sums: wp.array3d[Lanes],  # [slots, BATCH, SUMS] scratch: rows of a batch before the lanes are summed
        # Out:
        rows_out: wp.array[Lanes],  # [I] by place, column q in lane q
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
            rows_out[k] = Lanes(0.0)
        for done in range(0, tile_reach + 1, BATCH):
            newest = tile_reach - done  # counted from the tile's first, as all orders here
            size = wp.min(BATCH, newest + 1)
            for b in range(size):
                order = newest - b
                prefetch(splats, listed[first + wp.max(order - AHEAD, 0)])
                f = fragment_of(splats, listed[first + order], x0, y0)
                ramp = f.a * LANE_OFFSETS
                middle_row = float((f.first_row + f.last_row) / 2)
                g0 = Lanes(0.0)
                g1 = Lanes(0.0)
                g2 = Lanes(0.0)
                red = Lanes(0.0)
                green = Lanes(0.0)
                blue = Lanes(0.0)
                z = Lanes(0.0)
                across = Lanes(0.0)
                down = Lanes(0.0)
                for row in range(f.first_row, f.last_row + 1):
                    # Leaving early keeps the sums in registers: after an `if` Warp selects them through memory.
                    if order > reach[slot, row]:
                        continue
                    alphas = lane_alphas(f, row, knobs)
                    y = y0 + row
                    last_order = last[y, column]
                    T = state[slot, row, 0]
                    behind = state[slot, row, 1]
                    for i in range(LANES):
                        alphas[i] = wp.where(order <= last_order[i], alphas[i], 0.0)
                        T[i] = T[i] / wp.max(1.0 - alphas[i], MIN_PASSED)
                    w = wp.cw_mul(alphas, T)
                    value = Lanes(0.0)
                    if wp.static(wide):
                        value = feature_value(features, f.gaussian, gradient, y, column, features.shape[1])
                    else:
                        value = f.color[0] * gradient[y, column, 0]
                        value += f.color[1] * gradient[y, column, 1]
                        value += f.color[2] * gradient[y, column, 2]
                        red += wp.cw_mul(w, gradient[y, column, 0])
                        green += wp.cw_mul(w, gradient[y, column, 1])
                        blue += wp.cw_mul(w, gradient[y, column, 2])
                    if wp.static(depth):
                        v_sum = gradient[y, column, gradient.shape[2] - 1]
                        value += f.depth * v_sum
                        z += wp.cw_mul(w, v_sum)
                    excess = value - behind
                    state[slot, row, 0] = T
                    state[slot, row, 1] = behind + wp.cw_mul(alphas, excess)
                    g = wp.cw_mul(w, excess)
                    for i in range(LANES):
                        g[i] = wp.where(alphas[i] < knobs.alpha_max, g[i], 0.0)
                    d = float(row) - middle_row
                    g0 += g
                    g1 += d * g
                    g2 += (d * d) * g
                    if wp.static(absolute):
                        dy = float(row) - f.y
                        middle = f.b * dy + f.a * (HALF_ROW - f.x)
                        for i in range(LANES):
                            g_u = g[i] * (ramp[i] + middle)
                            across[i] = across[i] + wp.abs(f.a * g_u)
                            down[i] = down[i] + wp.abs(f.b * g_u + f.c * f.c * dy * g[i])
                v = f.c * (middle_row - f.y)
                u = ramp
                middle = f.b * (middle_row - f.y) + f.a * (HALF_ROW - f.x)
                for i in range(LANES):
                    u[i] = ramp[i] + middle
                gu = wp.cw_mul(u, g0) + f.b * g1
                gv = v * g0 + f.c * g1
                gu1 = wp.cw_mul(u, g1) + f.b * g2
                sums[slot, b, 0] = g0
                sums[slot, b, 1] = gu
                sums[slot, b, 2] = gv
                sums[slot, b, 3] = wp.cw_mul(u, gu) + f.b * gu1
                sums[slot, b, 4] = v * gu + f.c * gu1
                sums[slot, b, 5] = v * gv + f.c * (v * g1 + f.c * g2)
                if wp.static(not wide):
                    sums[slot, b, 6] = red
                    sums[slot, b, 7] = green
                    sums[slot, b, 8] = blue
                if wp.static(depth):
                    sums[slot, b, at_depth] = z
                if wp.static(absolute):
                    sums[slot, b, at_absolute] = across
                    sums[slot, b, wp.static(at_absolute + 1)] = down
            # Column q ends up in lane q. Level by level over the whole batch: what was stored just now cannot be read
            # in other pieces without waiting.
            for b in range(size):
                for p in range(pairs):
                    other = wp.min(2 * p + 1, columns_of_row - 1)
                    sums[slot, b, ROW + p] = fold_8(sums[slot, b, 2 * p], sums[slot, b, other])
            for b in range(size):
                for p in range(quads):
                    other = wp.min(2 * p + 1, pairs - 1)
                    sums[slot, b, p] = fold_4(sums[slot, b, ROW + 2 * p], sums[slot, b, ROW + other])
            for b in range(size):
                for p in range(2):
                    other = wp.min(2 * p + 1, quads - 1)
                    sums[slot, b, ROW + p] = fold_2(sums[slot, b, 2 * p], sums[slot, b, other])
            for b in range(size):
                rows_out[first + newest - b] = fold_1(sums[slot, b, ROW], sums[slot, b, ROW + 1])

    return composite_backward
