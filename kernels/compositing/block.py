"""Front-to-back compositing, block schedule (CUDA): 256 threads own a 16 x 16 tile and stage its splats in batches.

The arithmetic of a pixel is that of the lane schedule (`transmittance.py`). On the CPU these kernels run as
cooperative fibers when `wp.config.enable_cpu_blocks` is set; that is how they are tested without a GPU. With the flag
off Warp would run them with blocks of one thread, so the host never launches them then.
"""

from functools import cache

import warp as wp

from sgwarp.kernels.binning import TILE
from sgwarp.kernels.blocks import power_of_two
from sgwarp.kernels.gaussian import Splat
from sgwarp.kernels.projection.forward import Knobs
from sgwarp.kernels.transmittance import BLOCK_OPTIONS, LANES, Lanes, attenuated, contribution

wp.set_module_options(BLOCK_OPTIONS)

STAGE = 64  # splats staged at a time


@wp.func
def whitened(splat: Splat, x: int, y: int):
    """(u, v) of a splat at a pixel."""
    dx = float(x) + 0.5 - splat.mean[0]
    dy = float(y) + 0.5 - splat.mean[1]
    return splat.a * dx + splat.b * dy, splat.c * dy


@wp.func
def alpha_at(splat: Splat, x: int, y: int, knobs: Knobs) -> float:
    """Opacity of a splat at a pixel."""
    u, v = whitened(splat, x, y)
    level = splat.level - v * v - u * u
    alpha = float(0.0)
    if level >= knobs.alpha_min_level:
        alpha = wp.min(power_of_two(level), knobs.alpha_max)
    return alpha


@cache
def pixel_walk(depth: bool, record: bool) -> wp.Function:
    """Device function that composites three channels of one pixel per thread.

    It returns transmittance, colour, sum of alpha T z, the splat that is the surface (-1 = none) and the last
    contributor (with `record`), both counted from the tile's first.
    """

    @wp.func
    def walk(
        tile: int,
        x: int,
        y: int,
        inside: bool,
        offsets: wp.array[int],
        listed: wp.array[int],
        splats: wp.array[Splat],
        knobs: Knobs,
    ):
        T = wp.where(inside, 1.0, 0.0)
        color = wp.vec3(0.0, 0.0, 0.0)
        depth_sum = float(0.0)
        surface = int(-1)
        latest = int(-1)
        first = offsets[tile]
        stop = offsets[tile + 1]
        for start in range(first, stop, STAGE):
            ranks = wp.tile_load(listed, shape=STAGE, offset=start, storage="shared")
            staged = wp.tile_load_indexed(splats, indices=ranks, shape=(STAGE,), storage="shared")
            for j in range(wp.min(STAGE, stop - start)):
                f = wp.tile_extract(staged, j)
                alpha = alpha_at(f, x, y, knobs)
                w = contribution(alpha, T, knobs)
                if w > 0.0:  # colours that are not finite stay with the pixels they reach
                    color += w * f.color
                    if wp.static(record):
                        latest = start - first + j
                    if wp.static(depth):
                        depth_sum += w * f.depth
                        if T > knobs.surface_transmittance and T - w <= knobs.surface_transmittance:
                            surface = start - first + j
                T = attenuated(alpha, T, knobs)
            open_pixels = wp.tile_sum(wp.tile(wp.where(T > 0.0, 1, 0)))
            if open_pixels[0] == 0:
                break
        return T, color, depth_sum, surface, latest

    return walk


@cache
def make_composite_colors_block(depth: bool, record: bool) -> wp.Kernel:
    """Block-schedule counterpart of `make_composite_colors`."""
    walk = pixel_walk(depth, record)

    @wp.kernel(module="unique", module_options=BLOCK_OPTIONS, enable_backward=False)
    def composite_colors_block(
        # In:
        offsets: wp.array[int],  # [tiles + 1] first place of each tile
        listed: wp.array[int],  # [I] ranks, tile by tile, front to back
        splats: wp.array[Splat],  # [V] in depth order
        knobs: Knobs,
        width: int,  # [pixels]
        height: int,
        # Out:
        colors_out: wp.array2d[wp.vec3],  # [H, W] sum of alpha T color
        transmittance_out: wp.array2d[float],  # [H, W]
        alpha_out: wp.array2d[float],  # [H, W] accumulated opacity, 1 - transmittance
        depth_sum_out: wp.array2d[float],  # [H, W] sum of alpha T z [m] (depth)
        surface_out: wp.array2d[float],  # [H, W] z where accumulated opacity passes alpha_d [m], 0 = no hit (depth)
        last_out: wp.array2d[int],  # [H, W] last contributor, counted from its tile's first, -1 = none (record)
        hit_out: wp.array2d[int],  # [H, W] Gaussian of `surface_out`, -1 = no hit (depth and record)
    ):
        """Paper eq. 1; one block per tile."""
        tile, t = wp.tid()
        columns = (width + TILE - 1) / TILE
        x = (tile % columns) * TILE + t % TILE
        y = (tile / columns) * TILE + t / TILE
        inside = x < width and y < height
        T, color, depth_sum, surface, latest = walk(tile, x, y, inside, offsets, listed, splats, knobs)
        if inside:
            colors_out[y, x] = color
            transmittance_out[y, x] = wp.abs(T)
            alpha_out[y, x] = 1.0 - wp.abs(T)
            if wp.static(record):
                last_out[y, x] = latest
            if wp.static(depth):
                depth_sum_out[y, x] = depth_sum
                d = float(0.0)
                hit = int(-1)
                if surface >= 0:
                    splat = splats[listed[offsets[tile] + surface]]
                    d = splat.depth
                    hit = splat.gaussian
                surface_out[y, x] = d
                if wp.static(record):
                    hit_out[y, x] = hit

    return composite_colors_block


@cache
def feature_pixel_walk(record: bool) -> wp.Function:
    """Device function that composites 16 channels of one pixel per thread.

    It returns transmittance, channels and, with `record`, the last contributor counted from the tile's first.
    """

    @wp.func
    def walk(
        tile: int,
        s: int,
        x: int,
        y: int,
        inside: bool,
        offsets: wp.array[int],
        listed: wp.array[int],
        splats: wp.array[Splat],
        features: wp.array2d[Lanes],
        knobs: Knobs,
    ):
        T = wp.where(inside, 1.0, 0.0)
        total = Lanes(0.0)
        latest = int(-1)
        first = offsets[tile]
        stop = offsets[tile + 1]
        for start in range(first, stop, STAGE):
            ranks = wp.tile_load(listed, shape=STAGE, offset=start, storage="shared")
            staged = wp.tile_load_indexed(splats, indices=ranks, shape=(STAGE,), storage="shared")
            for j in range(wp.min(STAGE, stop - start)):
                f = wp.tile_extract(staged, j)
                alpha = alpha_at(f, x, y, knobs)
                w = contribution(alpha, T, knobs)
                if w > 0.0:
                    total += w * features[f.gaussian, s]
                    if wp.static(record):
                        latest = start - first + j
                T = attenuated(alpha, T, knobs)
            open_pixels = wp.tile_sum(wp.tile(wp.where(T > 0.0, 1, 0)))
            if open_pixels[0] == 0:
                break
        return T, total, latest

    return walk


@wp.func
def write_channels(total: Lanes, y: int, x: int, s: int, features_out: wp.array3d[float]):
    for c in range(LANES):
        if s * LANES + c < features_out.shape[2]:
            features_out[y, x, s * LANES + c] = total[c]


@cache
def make_composite_features_block(record: bool) -> wp.Kernel:
    """Block-schedule counterpart of `make_composite_features`; every block composites 16 channels of a tile."""
    walk = feature_pixel_walk(record)

    @wp.kernel(module="unique", module_options=BLOCK_OPTIONS, enable_backward=False)
    def composite_features_block(
        # In:
        offsets: wp.array[int],  # [tiles + 1]
        listed: wp.array[int],  # [I]
        splats: wp.array[Splat],  # [V]
        features: wp.array2d[Lanes],  # [N, S] channels in slices of 16
        knobs: Knobs,
        width: int,
        height: int,
        # Out:
        features_out: wp.array3d[float],  # [H, W, C] sum of alpha T x
        transmittance_out: wp.array2d[float],  # [H, W]
        alpha_out: wp.array2d[float],  # [H, W] accumulated opacity, 1 - transmittance
        last_out: wp.array2d[int],  # [H, W] last contributor, counted from its tile's first, -1 = none (record)
    ):
        """Paper eq. 1 for any number of channels; one block per (tile, slice)."""
        tile, s, t = wp.tid()
        columns = (width + TILE - 1) / TILE
        x = (tile % columns) * TILE + t % TILE
        y = (tile / columns) * TILE + t / TILE
        inside = x < width and y < height
        T, total, latest = walk(tile, s, x, y, inside, offsets, listed, splats, features, knobs)
        if inside:
            write_channels(total, y, x, s, features_out)
            if s == 0:
                transmittance_out[y, x] = wp.abs(T)
                alpha_out[y, x] = 1.0 - wp.abs(T)
                if wp.static(record):
                    last_out[y, x] = latest

    return composite_features_block
