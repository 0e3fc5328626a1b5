"""Backward pass of compositing, block schedule (CUDA): 256 threads own a tile and replay it from its last fragment.

The mathematics is that of `lanes_backward.py`. For a batch of 16 fragments

1. each thread computes w and g at its own pixel, and puts them into shared memory;
2. thread (fragment, column of pixels) sums g, d g, d^2 g and w v over the 16 pixels, d their row counted from where the
   fragment is strongest: down a column u and v change by b and c, so that the six moments follow from these three.
   Counted from anywhere else the three would be large and the moments small differences of them;
3. thread (fragment, column of the result) adds the 16 sums up.

The sum goes to the Gaussian by one atomic addition per (tile, fragment, column) or, in the ordered variant, to the row
of its place in the lists; `sum_intersections` adds the rows up in a fixed order. Shared memory is padded so that the
threads of a warp meet no bank twice in any of the three. A pixel that a fragment does not reach skips the work; where
no pixel of a warp is reached, the warp does.
"""

from functools import cache

import warp as wp

from sgwarp.kernels.binning import TILE
from sgwarp.kernels.blocks import BLOCK, barrier, power_of_two, put, put_vector, reciprocal
from sgwarp.kernels.compositing.block import whitened
from sgwarp.kernels.compositing.lanes_backward import MIN_PASSED, MOMENTS, row_columns
from sgwarp.kernels.gaussian import Splat
from sgwarp.kernels.projection.backward import SEEN
from sgwarp.kernels.projection.forward import Knobs
from sgwarp.kernels.transmittance import BLOCK_OPTIONS, LANES

wp.set_module_options(BLOCK_OPTIONS)

BATCH = LANES  # fragments whose sums are taken at a time
PIXELS = BLOCK + TILE  # floats between the shares of two fragments
SUMS = BLOCK + 1  # floats between two columns of the partial sums
HALF = 8  # fragments whose features meet the pixels' gradients at a time
Half = wp.types.vector(length=HALF, dtype=wp.float32)
QUADS = BLOCK // HALF  # groups of four channels that are staged at a time
BLOCKS = 3  # that a multiprocessor should hold: no more than 80 registers


@cache
def make_composite_backward_block(wide: bool, depth: bool, absolute: bool, ordered: bool) -> wp.Kernel:
    """Block-schedule counterpart of `make_composite_backward`."""
    at_depth, at_absolute, columns_of_row = row_columns(wide, depth, absolute)
    colors = 0 if wide else 3
    valued = at_depth + int(depth) - MOMENTS  # colours, and the depth, at MOMENTS of a row
    planes_of_pixel = max(valued, 1)
    Row = wp.types.vector(length=columns_of_row, dtype=wp.float32)
    bounds = None if wide else (BLOCK, BLOCKS)  # wide, 80 registers do for sm_90 and spill on sm_80

    @wp.kernel(module="unique", module_options=BLOCK_OPTIONS, enable_backward=False, launch_bounds=bounds)
    def composite_backward_block(
        # In:
        offsets: wp.array[int],  # [tiles + 1]
        listed: wp.array[int],  # [I]
        splats: wp.array[Splat],  # [V]
        features: wp.array2d[wp.vec4],  # [N, 4 S] channels by four (wide)
        transmittance: wp.array2d[float],  # [H, W]
        v_alpha: wp.array2d[float],  # [H, W] gradient of 1 - transmittance
        v_colors: wp.array3d[float],  # [H, W, C] gradient of the image
        v_features: wp.array3d[wp.vec4],  # [H, W, 4 S] the same by four channels (wide)
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
        tile_columns = (width + TILE - 1) / TILE
        x0 = (tile % tile_columns) * TILE
        y0 = (tile / tile_columns) * TILE
        x = x0 + t % TILE
        y = y0 + t / TILE
        inside = x < width and y < height
        T = float(1.0)
        behind = float(0.0)
        latest = int(-1)
        v_color = wp.vec3(0.0, 0.0, 0.0)
        v_z = float(0.0)
        if inside:
            T = transmittance[y, x]
            behind = -v_alpha[y, x]
            latest = last[y, x]
            if wp.static(not wide):
                for c in range(3):
                    if c < v_colors.shape[2]:
                        v_color[c] = v_colors[y, x, c]
            if wp.static(depth):
                v_z = v_depth[y, x]
        planes = wp.tile_empty(shape=(wp.static(planes_of_pixel * BLOCK),), dtype=float, storage="shared")
        if wp.static(not wide):
            for c in range(3):
                put(planes, BLOCK * c + t, v_color[c])
        if wp.static(depth):
            put(planes, BLOCK * colors + t, v_z)
        # Rows 0 to 15 are g of the batch's fragments, rows 16 to 31 are w.
        shares = wp.tile_empty(shape=(wp.static(2 * BATCH * PIXELS),), dtype=float, storage="shared")
        partial = wp.tile_empty(shape=(wp.static(columns_of_row * SUMS),), dtype=float, storage="shared")
        if wp.static(wide):
            staged_features = wp.tile_empty(shape=(BLOCK,), dtype=wp.vec4, storage="shared")
        j = t / TILE
        q = t % TILE
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
            # The barriers of these loads keep readers of the last batch and writers of this one apart.
            ranks = wp.tile_load(listed, shape=BATCH, offset=first + start, storage="shared")
            staged = wp.tile_load_indexed(splats, indices=ranks, shape=(BATCH,), storage="shared")
            if wp.static(wide):
                for b0 in range(0, size, HALF):
                    values = Half(0.0)
                    for group in range(0, features.shape[1], QUADS):
                        fetched = wp.vec4(0.0, 0.0, 0.0, 0.0)
                        quad = group + t % QUADS
                        if b0 + t / QUADS < size and quad < features.shape[1]:
                            fetched = features[wp.tile_extract(staged, b0 + t / QUADS).gaussian, quad]
                        barrier()
                        put_vector(staged_features, t, fetched)
                        barrier()
                        if inside:
                            for k in range(wp.min(QUADS, features.shape[1] - group)):
                                v_quad = v_features[y, x, group + k]
                                for b in range(HALF):
                                    f_quad = wp.tile_extract(staged_features, QUADS * b + k)
                                    values[b] = values[b] + wp.dot(v_quad, f_quad)
                    for b in range(HALF):
                        put(shares, PIXELS * (b0 + b) + t, values[b])  # until its own thread makes it g
            for step in range(size):
                b = size - 1 - step
                f = wp.tile_extract(staged, b)
                u, v = whitened(f, x, y)
                level = f.level - v * v - u * u
                w = float(0.0)
                g = float(0.0)
                if level >= knobs.alpha_min_level and start + b <= latest:
                    alpha = wp.min(power_of_two(level), knobs.alpha_max)
                    T = T * reciprocal(wp.max(1.0 - alpha, MIN_PASSED))
                    w = alpha * T
                    value = float(0.0)
                    if wp.static(wide):
                        value = wp.tile_extract(shares, PIXELS * b + t)
                    else:
                        value = wp.dot(f.color, v_color)
                    if wp.static(depth):
                        value += f.depth * v_z
                    excess = value - behind
                    behind += alpha * excess
                    g = wp.where(alpha < knobs.alpha_max, w * excess, 0.0)
                put(shares, PIXELS * b + t, g)
                put(shares, PIXELS * (BATCH + b) + t, w)
            barrier()
            if j < size:
                f = wp.tile_extract(staged, j)
                across = f.a * (float(x0 + q) + 0.5 - f.mean[0])
                top = float(y0) + 0.5 - f.mean[1]
                steep = f.b * f.b + f.c * f.c
                middle = wp.clamp(-top - f.b * across * reciprocal(steep), 0.0, wp.static(float(TILE - 1)))
                dy = top + middle
                u = across + f.b * dy
                v = f.c * dy
                slope = f.b * u + f.c * v
                g0 = float(0.0)
                g1 = float(0.0)
                g2 = float(0.0)
                sums = Row(0.0)
                for i in range(TILE):
                    d = float(i) - middle
                    g = wp.tile_extract(shares, PIXELS * j + TILE * i + q)
                    g0 += g
                    dg = d * g
                    g1 += dg
                    g2 += d * dg
                    if wp.static(valued > 0):
                        w = wp.tile_extract(shares, PIXELS * (BATCH + j) + TILE * i + q)
                        for c in range(valued):
                            v_plane = wp.tile_extract(planes, BLOCK * c + TILE * i + q)
                            sums[MOMENTS + c] = sums[MOMENTS + c] + w * v_plane
                    if wp.static(absolute):
                        sums[at_absolute] = sums[at_absolute] + wp.abs(g * (u + d * f.b))
                        sums[at_absolute + 1] = sums[at_absolute + 1] + wp.abs(g * (slope + d * steep))
                if wp.static(absolute):
                    sums[at_absolute] = f.a * sums[at_absolute]
                sums[0] = g0
                sums[1] = u * g0 + f.b * g1
                sums[2] = v * g0 + f.c * g1
                sums[3] = u * u * g0 + 2.0 * u * f.b * g1 + f.b * f.b * g2
                sums[4] = u * v * g0 + (u * f.c + v * f.b) * g1 + f.b * f.c * g2
                sums[5] = v * v * g0 + 2.0 * v * f.c * g1 + f.c * f.c * g2
                for c in range(columns_of_row):
                    put(partial, SUMS * c + t, sums[c])
            barrier()
            if j < size and q < columns_of_row:
                total = float(0.0)
                for i in range(TILE):
                    total += wp.tile_extract(partial, SUMS * q + TILE * j + i)
                if wp.static(ordered):
                    rows_out[first + start + j, q] = total
                else:
                    wp.atomic_add(rows_out, wp.tile_extract(staged, j).gaussian, q, total)
            if wp.static(not ordered) and j < size and q == SEEN:
                rows_out[wp.tile_extract(staged, j).gaussian, q] = 1.0  # by all who write it

    return composite_backward_block
