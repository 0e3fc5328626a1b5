"""Front-to-back compositing, lane schedule (CPU): a thread owns a tile, 16 pixels of one of its rows are one vector.

Every kernel walks a tile's list front to back and, for each, only the rows its footprint touches. The state of a
row (transmittance, accumulated channels) lives in a small scratch that stays in the first-level cache; `slot` names
the scratch of the host thread that runs the launch.
"""

from functools import cache

import warp as wp

from sgwarp.kernels.binning import AHEAD, TILE, Fragment, fragment_of, prefetch
from sgwarp.kernels.compositing_rows import row_walk
from sgwarp.kernels.gaussian import Splat
from sgwarp.kernels.projection import Knobs
from sgwarp.kernels.transmittance import (
    HALF_ROW,
    LANE_OFFSETS,
    LANE_OPTIONS,
    LANES,
    Lanes,
    alpha_from_level,
    attenuated,
    contribution,
)

wp.set_module_options(LANE_OPTIONS)

BATCH = wp.constant(32)  # fragments that are walked row by row
CLOSE_EVERY = wp.constant(32)  # fragments between two looks at which rows are closed


@wp.func
def open_lanes(x: int, width: int) -> Lanes:
    """Transmittance before the first Gaussian: 1 inside the image; lanes beyond its edge start closed."""
    T = Lanes(0.0)
    for i in range(LANES):
        T[i] = wp.where(x + i < width, 1.0, 0.0)
    return T


@wp.func
def row_is_reached(f: Fragment, row: int, knobs: Knobs) -> bool:
    """Whether the footprint touches any of the row's 16 pixel centres."""
    dy = float(row) - f.y
    v = f.c * dy
    middle = f.b * dy + f.a * (HALF_ROW - f.x)
    nearest = wp.max(wp.abs(middle) - HALF_ROW * f.a, 0.0)
    return nearest * nearest + v * v <= f.level - knobs.alpha_min_level


@wp.func
def lane_alphas(f: Fragment, row: int, knobs: Knobs) -> Lanes:
    """Opacity of the fragment at the 16 pixels of a row."""
    dy = float(row) - f.y
    v = f.c * dy
    middle = f.b * dy + f.a * (HALF_ROW - f.x)
    top = f.level - v * v
    ramp = f.a * LANE_OFFSETS
    alphas = Lanes(0.0)
    for i in range(LANES):
        u = middle + ramp[i]
        alphas[i] = alpha_from_level(top - u * u, knobs)
    return alphas


@wp.func
def lane_contributions(alphas: Lanes, T: Lanes, knobs: Knobs) -> Lanes:
    w = Lanes(0.0)
    for i in range(LANES):
        w[i] = contribution(alphas[i], T[i], knobs)
    return w


@wp.func
def lane_attenuated(alphas: Lanes, T: Lanes, knobs: Knobs) -> Lanes:
    next_T = Lanes(0.0)
    for i in range(LANES):
        next_T[i] = attenuated(alphas[i], T[i], knobs)
    return next_T


@wp.func
def open_row_mask(y: int, height: int) -> int:
    """Bit per row of a tile whose first row is y: set where the row lies inside the image."""
    return (1 << wp.min(TILE, height - y)) - 1


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
        batch: wp.array2d[Fragment],
        reached: wp.array3d[int],
    ):
        columns = (width + TILE - 1) / TILE
        x0 = (tile % columns) * TILE
        y0 = (tile / columns) * TILE
        for row in range(TILE):
            state[slot, row, 0] = open_lanes(x0, width)
            for plane in range(1, planes):
                state[slot, row, plane] = Lanes(0.0)
            if wp.static(record):
                state[slot, row, wp.static(planes - 1)] = Lanes(-1.0)
                if wp.static(depth):
                    state[slot, row, 5] = Lanes(-1.0)
        open_rows = open_row_mask(y0, height)
        first = offsets[tile]
        stop = offsets[tile + 1]
        for start in range(first, stop, BATCH):
            size = wp.min(BATCH, stop - start)
            for b in range(size):
                prefetch(splats, listed[wp.min(start + b + AHEAD, stop - 1)])
                f = fragment_of(splats, listed[start + b], x0, y0)
                batch[slot, b] = f
                reached[slot, 0, b] = f.first_row
                reached[slot, 1, b] = f.last_row
            for b in range(size, BATCH):
                reached[slot, 1, b] = -1
            for row in range(TILE):
                if (open_rows >> row) & 1 != 0:
                    composite_row(slot, row, start - first, batch, reached, knobs, state)
            open_rows = still_open(open_rows, state, slot)
            if open_rows == 0:
                break

    return walk


def color_planes(depth: bool, record: bool) -> int:
    """Scratch vectors per row that compositing colours needs."""
    return (6 if depth else 4) + int(record)


@wp.func
def latest(w: Lanes, k: float, last: Lanes) -> Lanes:
    """k in the lanes to which its fragment contributes. Floats count exactly to 2^24 places of one tile."""
    newest = last
    for i in range(LANES):
        newest[i] = wp.where(w[i] > 0.0, k, last[i])
    return newest


@wp.func
def write_last(
    slot: int,
    x0: int,
    y0: int,
    width: int,
    height: int,
    state: wp.array3d[Lanes],
    plane: int,
    last_out: wp.array2d[int],
):
    """Last contributors of a tile, from lanes to pixels."""
    for row in range(wp.min(TILE, height - y0)):
        last = state[slot, row, plane]
        for i in range(wp.min(LANES, width - x0)):
            last_out[y0 + row, x0 + i] = int(last[i])


@wp.func
def write_colors(
    slot: int,
    x0: int,
    y0: int,
    width: int,
    height: int,
    state: wp.array3d[Lanes],
    colors_out: wp.array2d[wp.vec3],
    transmittance_out: wp.array2d[float],
):
    """Colours and transmittance of a tile, from lanes to pixels."""
    for row in range(wp.min(TILE, height - y0)):
        T = state[slot, row, 0]
        r = state[slot, row, 1]
        g = state[slot, row, 2]
        b = state[slot, row, 3]
        for i in range(wp.min(LANES, width - x0)):
            colors_out[y0 + row, x0 + i] = wp.vec3(r[i], g[i], b[i])
            transmittance_out[y0 + row, x0 + i] = wp.abs(T[i])


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
        batch: wp.array2d[Fragment],  # [slots, BATCH] scratch
        reached: wp.array3d[int],  # [slots, 2, BATCH] scratch: first and last row of each
        # Out:
        colors_out: wp.array2d[wp.vec3],  # [H, W] sum of alpha T color
        transmittance_out: wp.array2d[float],  # [H, W]
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
        write_colors(slot, x0, y0, width, height, state, colors_out, transmittance_out)
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


PASS = 16  # channels accumulated in registers at a time
Accumulator = wp.types.matrix(shape=(PASS, LANES), dtype=wp.float32)


@wp.func
def add_products(
    weights: wp.array3d[Lanes],
    owners: wp.array3d[int],
    slot: int,
    row: int,
    count: int,
    features: wp.array3d[Lanes],
    s: int,
    state: wp.array3d[Lanes],
    plane: int,
):
    """Add sum_b w_b x_b for 16 channels of a row: one register per channel, one load per weight."""
    acc = Accumulator()
    for c in range(PASS):
        acc[c] = state[slot, row, plane + c]
    for b in range(count):
        w = weights[slot, row, b]
        x = features[owners[slot, row, b], s, 0]
        for c in range(PASS):
            acc[c] = acc[c] + w * x[c]
    for c in range(PASS):
        state[slot, row, plane + c] = acc[c]


@cache
def feature_walk(slices: int, record: bool) -> wp.Function:
    """Device function that composites 16 `slices` channels of a tile into its scratch.

    Planes of the scratch: transmittance, the channels, with `record` the last contributor.
    """
    last_plane = 1 + PASS * slices

    @wp.func
    def walk(
        tile: int,
        slot: int,
        offsets: wp.array[int],
        listed: wp.array[int],
        splats: wp.array[Splat],
        features: wp.array3d[Lanes],
        first_slice: int,
        knobs: Knobs,
        width: int,
        height: int,
        state: wp.array3d[Lanes],
        weights: wp.array3d[Lanes],
        owners: wp.array3d[int],
    ):
        columns = (width + TILE - 1) / TILE
        x0 = (tile % columns) * TILE
        y0 = (tile / columns) * TILE
        rows = wp.min(TILE, height - y0)
        for row in range(rows):
            state[slot, row, 0] = open_lanes(x0, width)
            for plane in range(1, wp.static(1 + PASS * slices)):
                state[slot, row, plane] = Lanes(0.0)
            if wp.static(record):
                state[slot, row, last_plane] = Lanes(-1.0)
        open_rows = open_row_mask(y0, height)
        first = offsets[tile]
        stop = offsets[tile + 1]
        for start in range(first, stop, BATCH):
            end = wp.min(start + BATCH, stop)
            for row in range(rows):
                if (open_rows >> row) & 1 != 0:
                    count = int(0)
                    T = state[slot, row, 0]
                    for k in range(start, end):
                        f = fragment_of(splats, listed[k], x0, y0)
                        if row_is_reached(f, row, knobs):
                            alphas = lane_alphas(f, row, knobs)
                            w = lane_contributions(alphas, T, knobs)
                            weights[slot, row, count] = w
                            owners[slot, row, count] = f.gaussian
                            T = lane_attenuated(alphas, T, knobs)
                            count += 1
                            if wp.static(record):
                                state[slot, row, last_plane] = latest(w, float(k - first), state[slot, row, last_plane])
                    state[slot, row, 0] = T
                    for s in range(wp.static(slices)):
                        add_products(weights, owners, slot, row, count, features, first_slice + s, state, 1 + PASS * s)
            open_rows = still_open(open_rows, state, slot)
            if open_rows == 0:
                break

    return walk


@cache
def feature_writer(slices: int) -> wp.Function:
    """Device function that writes what `feature_walk` left in the scratch."""

    @wp.func
    def write(
        slot: int,
        x0: int,
        y0: int,
        first_slice: int,
        width: int,
        height: int,
        state: wp.array3d[Lanes],
        features_out: wp.array3d[float],
        transmittance_out: wp.array2d[float],
    ):
        inside = wp.min(LANES, width - x0)
        channels = features_out.shape[2]
        for row in range(wp.min(TILE, height - y0)):
            T = state[slot, row, 0]
            for i in range(inside):
                transmittance_out[y0 + row, x0 + i] = wp.abs(T[i])
            for c in range(wp.min(wp.static(PASS * slices), channels - PASS * first_slice)):
                values = state[slot, row, 1 + c]
                for i in range(inside):
                    features_out[y0 + row, x0 + i, PASS * first_slice + c] = values[i]

    return write


@cache
def make_composite_features(slices: int, record: bool) -> wp.Kernel:
    """Kernel that composites passes of `16 slices` channels; with `record` also what the backward pass starts from."""
    walk = feature_walk(slices, record)
    write = feature_writer(slices)

    @wp.kernel(module="unique", module_options=LANE_OPTIONS, enable_backward=False)
    def composite_features(
        # In:
        base: int,
        slot: int,
        offsets: wp.array[int],  # [tiles + 1]
        listed: wp.array[int],  # [I]
        splats: wp.array[Splat],  # [V]
        features: wp.array3d[Lanes],  # [N, S, 1] channels in slices of 16
        first_slice: int,  # of this pass
        knobs: Knobs,
        width: int,
        height: int,
        state: wp.array3d[Lanes],  # [slots, 16, 1 + 16 slices (+ 1)] scratch
        weights: wp.array3d[Lanes],  # [slots, 16, BATCH] scratch
        owners: wp.array3d[int],  # [slots, 16, BATCH] scratch
        # Out:
        features_out: wp.array3d[float],  # [H, W, C] sum of alpha T x
        transmittance_out: wp.array2d[float],  # [H, W]
        last_out: wp.array2d[int],  # [H, W] last contributor, counted from its tile's first, -1 = none (record)
    ):
        """Paper eq. 1 for any number of channels."""
        tile = base + wp.tid()
        columns = (width + TILE - 1) / TILE
        x0 = (tile % columns) * TILE
        y0 = (tile / columns) * TILE
        walk(tile, slot, offsets, listed, splats, features, first_slice, knobs, width, height, state, weights, owners)
        write(slot, x0, y0, first_slice, width, height, state, features_out, transmittance_out)
        if wp.static(record):
            write_last(slot, x0, y0, width, height, state, wp.static(1 + PASS * slices), last_out)

    return composite_features
