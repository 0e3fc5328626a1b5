"""Backward pass of compositing, block schedule (CUDA): 256 threads own a tile and replay it from its last fragment.

The mathematics is that of `lanes_backward.py`. For a batch of 16 fragments each thread computes w and g at
its own pixel, then thread (fragment, column) sums one column of the fragment's row over the 256 pixels. The sum goes to
the Gaussian by one atomic addition per (tile, fragment, column) or, in the ordered variant, to the row of its place in
the lists; `projection/backward.py`'s `sum_intersections` adds the rows up in a fixed order.
"""

from functools import cache

import warp as wp

from sgwarp.kernels.binning import TILE
from sgwarp.kernels.compositing.block import BLOCK, alpha_at, whitened
from sgwarp.kernels.compositing.lanes_backward import MIN_PASSED, MOMENTS, row_columns
from sgwarp.kernels.gaussian import Splat
from sgwarp.kernels.projection.backward import SEEN
from sgwarp.kernels.projection.forward import Knobs
from sgwarp.kernels.transmittance import BLOCK_OPTIONS, LANES, Lanes

wp.set_module_options(BLOCK_OPTIONS)

BATCH = LANES  # fragments whose weights meet the pixels' gradients at a time


@wp.func
def moment(q: int, u: float, v: float) -> float:
    """1, u, v, u^2, u v, v^2 for q = 0 to 5, without branches: 16 neighbouring threads differ in q."""
    left = wp.where(q == 1 or q == 3 or q == 4, u, wp.where(q == 2 or q == 5, v, 1.0))
    right = wp.where(q == 3, u, wp.where(q == 4 or q == 5, v, 1.0))
    return left * right


@cache
def make_composite_backward_block(wide: bool, depth: bool, absolute: bool, ordered: bool) -> wp.Kernel:
    """Block-schedule counterpart of `make_composite_backward`."""
    at_depth, at_absolute, columns_of_row = row_columns(wide, depth, absolute)

    @wp.kernel(module="unique", module_options=BLOCK_OPTIONS, enable_backward=False)
    def composite_backward_block(
        # In:
        offsets: wp.array[int],  # [tiles + 1]
        listed: wp.array[int],  # [I]
        splats: wp.array[Splat],  # [V]
        features: wp.array2d[Lanes],  # [N, S] channels in slices of 16 (wide)
        transmittance: wp.array2d[float],  # [H, W]
        v_transmittance: wp.array2d[float],  # [H, W] its gradient
        v_image: wp.array3d[float],  # [H, W, C] gradient of the image
        v_depth: wp.array2d[float],  # [H, W] gradient of the depth sum (depth)
        last: wp.array2d[int],  # [H, W] last contributor, counted from its tile's first, -1 = none
        knobs: Knobs,
        width: int,
        height: int,
        # Out:
        rows_out: wp.array2d[float],  # [I, 16] by place (ordered), or [N, 16] added to
    ):
        """Paper eq. 1, differentiated; one block per tile."""
        tile, t = wp.tid()
        columns = (width + TILE - 1) / TILE
        x0 = (tile % columns) * TILE
        y0 = (tile / columns) * TILE
        x = x0 + t % TILE
        y = y0 + t / TILE
        inside = x < width and y < height
        T = float(1.0)
        behind = float(0.0)
        latest = int(-1)
        v_pixel = wp.vec4(0.0, 0.0, 0.0, 0.0)  # gradient of three colours and of the depth sum
        if inside:
            T = transmittance[y, x]
            behind = v_transmittance[y, x]
            latest = last[y, x]
            if wp.static(not wide):
                for c in range(3):
                    if c < v_image.shape[2]:
                        v_pixel[c] = v_image[y, x, c]
            if wp.static(depth):
                v_pixel[3] = v_depth[y, x]
        planes = wp.tile_zeros(shape=(4, BLOCK), dtype=float, storage="shared")
        wp.tile_assign(planes, wp.tile(v_pixel), offset=(0, 0))
        # Rows 0 to 15 are g of the batch's fragments, rows 16 to 31 are w.
        shares = wp.tile_zeros(shape=(wp.static(2 * BATCH), BLOCK), dtype=float, storage="shared")
        j = t / LANES
        q = t % LANES
        reached = wp.tile_max(wp.tile(latest))
        first = offsets[tile]
        count = reached[0] + 1
        if wp.static(ordered):
            for k in range(first + count + t, offsets[tile + 1], BLOCK):
                for e in range(LANES):
                    rows_out[k, e] = 0.0
        for done in range(0, count, BATCH):
            start = wp.max(count - done - BATCH, 0)  # counted from the tile's first fragment
            size = count - done - start
            # The barriers of this load and of the assignments below keep readers and writers of `shares` apart.
            ranks = wp.tile_load(listed, shape=BATCH, offset=first + start, storage="shared")
            staged = wp.tile_load_indexed(splats, indices=ranks, shape=(BATCH,), storage="shared")
            values = Lanes(0.0)
            if wp.static(wide) and inside:
                for s in range(features.shape[1]):
                    for c in range(wp.min(LANES, v_image.shape[2] - LANES * s)):
                        v = v_image[y, x, LANES * s + c]
                        for b in range(BATCH):
                            if b < size:
                                values[b] = values[b] + v * features[staged[b].gaussian, s][c]
            weights = Lanes(0.0)
            excesses = Lanes(0.0)
            for step in range(BATCH):
                b = wp.static(BATCH - 1) - step
                if b < size:
                    f = staged[b]
                    alpha = wp.where(start + b <= latest, alpha_at(f, x, y, knobs), 0.0)
                    T = T / wp.max(1.0 - alpha, MIN_PASSED)
                    w = alpha * T
                    value = values[b] + f.color[0] * v_pixel[0] + f.color[1] * v_pixel[1] + f.color[2] * v_pixel[2]
                    if wp.static(wide):
                        value = values[b]
                    if wp.static(depth):
                        value += f.depth * v_pixel[3]
                    excess = value - behind
                    behind += alpha * excess
                    weights[b] = w
                    excesses[b] = wp.where(alpha < knobs.alpha_max, w * excess, 0.0)
            wp.tile_assign(shares, wp.tile(excesses), offset=(0, 0))
            wp.tile_assign(shares, wp.tile(weights), offset=(BATCH, 0))
            if j < size and q < columns_of_row:
                f = staged[j]
                is_moment = q < MOMENTS
                is_absolute = q >= at_absolute
                source = wp.where(is_moment or is_absolute, j, BATCH + j)
                plane = wp.where(q == at_depth, 3, wp.clamp(q - MOMENTS, 0, 3))
                total = float(0.0)
                for step in range(BLOCK):
                    p = (step + q) % BLOCK  # start apart, so that 16 columns read 16 banks
                    u, v = whitened(f, x0 + p % TILE, y0 + p / TILE)
                    factor = wp.where(is_moment, moment(q, u, v), planes[plane, p])
                    if wp.static(absolute):
                        slope = wp.where(q == at_absolute, f.a * u, f.b * u + f.c * v)
                        factor = wp.where(is_absolute, wp.abs(slope), factor)
                        share = wp.where(is_absolute, wp.abs(shares[source, p]), shares[source, p])
                        total += share * factor
                    else:
                        total += shares[source, p] * factor
                if wp.static(ordered):
                    rows_out[first + start + j, q] = total
                else:
                    wp.atomic_add(rows_out, f.gaussian, q, total)
            if wp.static(not ordered) and j < size and q == SEEN:
                rows_out[staged[j].gaussian, q] = 1.0  # by all who write it

    return composite_backward_block
