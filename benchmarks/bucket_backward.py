"""The backward pass of Taming 3DGS and Faster-GS, as far as it takes to count its instructions; it is not used.

A warp takes 32 fragments of a tile, one to a lane, and the tile's 256 pixels run through the lanes: a lane replays its
fragment at a pixel, adds to its nine sums, and hands the pixel's transmittance and what is still to come behind it to
the next lane. The first lane gets both from what the forward pass stored for this bucket and pixel. Published in
Mallick et al., Taming 3DGS, SIGGRAPH Asia 2024; written anew in terms of `kernels/compositing/block_backward.py`.
"""

import warp as wp

from sgwarp.kernels.binning import TILE
from sgwarp.kernels.blocks import BLOCK, power_of_two, put, reciprocal
from sgwarp.kernels.compositing.block import whitened
from sgwarp.kernels.gaussian import Splat
from sgwarp.kernels.projection.forward import Knobs
from sgwarp.kernels.transmittance import BLOCK_OPTIONS

wp.set_module_options(BLOCK_OPTIONS)

LANES = 32
STEPS = BLOCK + LANES - 1  # that the pixels of a tile take to run through all lanes


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __shfl_up_sync(0xffffffffu, x, 1);
#else
    return x;
#endif
""")
def from_the_lane_before(x: float) -> float: ...


@wp.kernel(module="unique", module_options=BLOCK_OPTIONS, enable_backward=False)
def replay_buckets(
    # In:
    bucket_tiles: wp.array[int],  # [buckets]
    bucket_starts: wp.array[int],  # [buckets] first place
    bucket_ends: wp.array[int],  # [buckets] end of the tile's list
    offsets: wp.array[int],  # [tiles + 1]
    listed: wp.array[int],  # [I]
    splats: wp.array[Splat],  # [V]
    stored: wp.array2d[wp.vec2],  # [buckets, 256] transmittance, and gradient of all that lies behind, of each pixel
    v_colors: wp.array3d[float],  # [H, W, 3]
    last: wp.array2d[int],  # [H, W] last contributor
    knobs: Knobs,
    width: int,
    height: int,
    # Out:
    sums_out: wp.array2d[float],  # [N, 16] added to
):
    """Eight buckets a block; a lane per fragment."""
    block, t = wp.tid()
    lane = t % LANES
    bucket = (BLOCK // LANES) * block + t / LANES
    tile = bucket_tiles[bucket]
    columns = (width + TILE - 1) / TILE
    x0 = (tile % columns) * TILE
    y0 = (tile / columns) * TILE
    place = bucket_starts[bucket] + lane
    mine = place < bucket_ends[bucket]
    f = splats[listed[wp.min(place, bucket_ends[bucket] - 1)]]
    counted = place - offsets[tile]
    planes = wp.tile_empty(shape=(wp.static(4 * BLOCK * (BLOCK // LANES)),), dtype=float, storage="shared")
    base = 4 * BLOCK * (t / LANES)
    for p in range(lane, BLOCK, LANES):
        x = x0 + p % TILE
        y = y0 + p / TILE
        if x < width and y < height:
            for c in range(3):
                put(planes, base + 4 * p + c, v_colors[y, x, c])
            put(planes, base + 4 * p + 3, float(last[y, x]))
        else:
            put(planes, base + 4 * p + 3, -1.0)
    g0 = float(0.0)
    gu = float(0.0)
    gv = float(0.0)
    guu = float(0.0)
    guv = float(0.0)
    gvv = float(0.0)
    color = wp.vec3(0.0, 0.0, 0.0)
    T = float(0.0)
    behind = float(0.0)
    for step in range(STEPS):
        T = from_the_lane_before(T)
        behind = from_the_lane_before(behind)
        p = step - lane
        if lane == 0 and p < BLOCK:
            state = stored[bucket, p]
            T = state[0]
            behind = state[1]
        if p >= 0 and p < BLOCK and mine:
            latest = wp.tile_extract(planes, base + 4 * p + 3)
            if float(counted) <= latest:
                u, v = whitened(f, x0 + p % TILE, y0 + p / TILE)
                level = f.level - v * v - u * u
                if level >= knobs.alpha_min_level:
                    alpha = wp.min(power_of_two(level), knobs.alpha_max)
                    w = alpha * T
                    v_color = wp.vec3(
                        wp.tile_extract(planes, base + 4 * p),
                        wp.tile_extract(planes, base + 4 * p + 1),
                        wp.tile_extract(planes, base + 4 * p + 2),
                    )
                    value = wp.dot(f.color, v_color)
                    behind -= w * value
                    T = T * (1.0 - alpha)
                    g = w * value - alpha * behind * reciprocal(1.0 - alpha)
                    g = wp.where(alpha < knobs.alpha_max, g, 0.0)
                    g0 += g
                    gu += g * u
                    gv += g * v
                    guu += g * u * u
                    guv += g * u * v
                    gvv += g * v * v
                    color += w * v_color
    if mine:
        wp.atomic_add(sums_out, f.gaussian, 0, g0)
        wp.atomic_add(sums_out, f.gaussian, 1, gu)
        wp.atomic_add(sums_out, f.gaussian, 2, gv)
        wp.atomic_add(sums_out, f.gaussian, 3, guu)
        wp.atomic_add(sums_out, f.gaussian, 4, guv)
        wp.atomic_add(sums_out, f.gaussian, 5, gvv)
        for c in range(3):
            wp.atomic_add(sums_out, f.gaussian, 6 + c, color[c])
