"""Front-to-back compositing, lane schedule (CPU): a thread owns a tile, 16 pixels of one of its rows are one vector.

Every kernel walks a tile's list front to back and, for each, only the rows its footprint touches. The state of a
row (transmittance, accumulated channels) lives in a small scratch that stays in the first-level cache; `slot` names
the scratch of the host thread that runs the launch.
"""

from functools import cache

import warp as wp

from sgwarp.kernels.binning import TILE
from sgwarp.kernels.compositing.loops import gather_batch, open_state, row_walk, write_last, write_row
from sgwarp.kernels.gaussian import Splat
from sgwarp.kernels.native import BATCH, Seen
from sgwarp.kernels.projection.forward import Knobs
from sgwarp.kernels.transmittance import (
    LANE_OPTIONS,
    LANES,
    Lanes,
)

wp.set_module_options(LANE_OPTIONS)

CLOSE_EVERY = wp.constant(32)  # fragments between two looks at which rows are closed


@wp.func
def open_lanes(x: int, width: int) -> Lanes:
    """Transmittance before the first Gaussian: 1 inside the image; lanes beyond its edge start closed."""
    T = Lanes(0.0)
    for i in range(LANES):
        T[i] = wp.where(x + i < width, 1.0, 0.0)
    return T


@wp.func
def open_row_mask(y: int, height: int) -> int:
    """Bit per row of a tile whose first row is y: set where the row lies inside the image."""
    return (1 << wp.min(TILE, height - y)) - 1


@wp.func
def open_tile(
    slot: int, x0: int, y0: int, width: int, height: int, planes: int, unset: int, state: wp.array3d[Lanes]
) -> int:
    """Scratch of a tile before its first fragment, and a bit for each of its rows in the image.

    Plane 0 is the transmittance; the planes from `unset` on hold numbers of fragments, of which there is none.
    """
    open_state(slot, x0, width, planes, unset, state)
    return open_row_mask(y0, height)


@wp.func
def still_open(mask: int, state: wp.array3d[Lanes], slot: int) -> int:
    """Clear the bits of rows whose 16 pixels are all closed."""
    kept = mask
    for row in range(TILE):
        if wp.max(state[slot, row, 0]) <= 0.0:
            kept = kept & ~(1 << row)
    return kept


@cache
def color_walk(depth: bool, record: bool) -> wp.Function:
    """Device function that composites the three channels that travel with the splats into a tile's scratch.

    Fragments come in batches, and row by row those that reach it are composited.

    Planes of the scratch: transmittance, three channels, with `depth` sum of alpha T z and the surface depth, with
    `record` the last contributor. With both, the surface is kept as a contributor, not as a depth.
    """
    planes = color_planes(depth, record)
    unset = planes - int(record) - int(record and depth)
    composite_row = row_walk(depth, record)

    @wp.func
    def walk(
        tile: int,
        slot: int,
        offsets: wp.array[int],
        listed: wp.array[int],
        splats: wp.array[Splat],
        knobs: Knobs,
        width: int,
        height: int,
        state: wp.array3d[Lanes],
        batch: wp.array2d[Seen],
        reached: wp.array2d[int],
    ):
        columns = (width + TILE - 1) / TILE
        x0 = (tile % columns) * TILE
        y0 = (tile / columns) * TILE
        open_rows = open_tile(slot, x0, y0, width, height, planes, unset, state)
        first = offsets[tile]
        stop = offsets[tile + 1]
        for start in range(first, stop, BATCH):
            gather_batch(slot, start, stop, x0, y0, listed, splats, knobs, batch, reached)
            for row in range(TILE):
                if (open_rows >> row) & 1 != 0:  # noqa: SIM102 - Warp evaluates both sides of an `and`
                    if not composite_row(slot, row, start - first, batch, reached, knobs, state):
                        open_rows = open_rows & ~(1 << row)
            if open_rows == 0:
                break

    return walk


def color_planes(depth: bool, record: bool) -> int:
    """Scratch vectors per row that compositing colours needs."""
    return (6 if depth else 4) + int(record)


@cache
def make_composite_colors(depth: bool, record: bool) -> wp.Kernel:
    """Kernel that composites three channels that travel with the splats.

    Args:
        depth: Also write the sum of alpha T z and the surface depth.
        record: Also write what the backward pass starts from.
    """
    walk = color_walk(depth, record)
    last_plane = color_planes(depth, record) - 1

    @wp.kernel(module="unique", module_options=LANE_OPTIONS, enable_backward=False)
    def composite_colors(
        # In:
        base: int,  # first tile of this launch
        slot: int,  # scratch of this launch
        offsets: wp.array[int],  # [tiles + 1] first place of each tile
        listed: wp.array[int],  # [I] ranks, tile by tile, front to back
        splats: wp.array[Splat],  # [V] in depth order
        knobs: Knobs,
        width: int,  # [pixels]
        height: int,
        state: wp.array3d[Lanes],  # [slots, 16, planes] scratch
        batch: wp.array2d[Seen],  # [slots, BATCH] scratch
        reached: wp.array2d[int],  # [slots, 16] scratch: the rows that each of them reaches
        # Out:
        colors_out: wp.array2d[wp.vec3],  # [H, W] sum of alpha T color
        transmittance_out: wp.array2d[float],  # [H, W]
        alpha_out: wp.array2d[float],  # [H, W] accumulated opacity, 1 - transmittance
        depth_sum_out: wp.array2d[float],  # [H, W] sum of alpha T z [m] (depth)
        surface_out: wp.array2d[float],  # [H, W] z where accumulated opacity passes alpha_d [m], 0 = no hit (depth)
        last_out: wp.array2d[int],  # [H, W] last contributor, counted from its tile's first, -1 = none (record)
        hit_out: wp.array2d[int],  # [H, W] Gaussian of `surface_out`, -1 = no hit (depth and record)
    ):
        """Paper eq. 1 for one tile per thread."""
        tile = base + wp.tid()
        columns = (width + TILE - 1) / TILE
        x0 = (tile % columns) * TILE
        y0 = (tile / columns) * TILE
        walk(tile, slot, offsets, listed, splats, knobs, width, height, state, batch, reached)
        for row in range(wp.min(TILE, height - y0)):
            inside = wp.min(LANES, width - x0)
            write_row(slot, row, y0 + row, x0, inside, state, colors_out, transmittance_out, alpha_out)
        if wp.static(record):
            write_last(slot, x0, y0, width, height, state, last_plane, last_out)
        if wp.static(depth):
            for row in range(wp.min(TILE, height - y0)):
                z = state[slot, row, 4]
                surface = state[slot, row, 5]
                for i in range(wp.min(LANES, width - x0)):
                    depth_sum_out[y0 + row, x0 + i] = z[i]
                    d = surface[i]
                    if wp.static(record):
                        hit = int(-1)
                        d = float(0.0)
                        if surface[i] >= 0.0:
                            splat = splats[listed[offsets[tile] + int(surface[i])]]
                            d = splat.depth
                            hit = splat.gaussian
                        hit_out[y0 + row, x0 + i] = hit
                    surface_out[y0 + row, x0 + i] = d

    return composite_colors
