"""Compositing for training, lane schedule (CPU): it also writes what the backward pass starts from."""

from functools import cache

import warp as wp

from sgwarp.kernels.binning import TILE, Fragment
from sgwarp.kernels.compositing_lanes import PASS, color_planes, color_walk, feature_walk, feature_writer, write_colors
from sgwarp.kernels.projection import Knobs
from sgwarp.kernels.transmittance import LANE_OPTIONS, LANES, Lanes

wp.set_module_options(LANE_OPTIONS)


@cache
def make_record_colors(depth: bool) -> wp.Kernel:
    """`make_composite_colors` for training: it also writes what the backward pass starts from."""
    walk = color_walk(depth, True)
    planes = color_planes(depth, True)

    @wp.kernel(module="unique", module_options=LANE_OPTIONS, enable_backward=False)
    def record_colors(
        # In:
        base: int,
        slot: int,
        offsets: wp.array[int],  # [tiles + 1]
        fragments: wp.array[Fragment],  # [I]
        knobs: Knobs,
        width: int,
        height: int,
        state: wp.array3d[Lanes],  # [slots, 16, planes] scratch
        # Out:
        colors_out: wp.array2d[wp.vec3],  # [H, W] sum of alpha T color
        transmittance_out: wp.array2d[float],  # [H, W]
        depth_sum_out: wp.array2d[float],  # [H, W] sum of alpha T z [m]
        surface_out: wp.array2d[float],  # [H, W] z where accumulated opacity passes alpha_d [m], 0 = no hit
        last_out: wp.array2d[int],  # [H, W] last contributing fragment, counted from its tile's first, -1 = none
        hit_out: wp.array2d[int],  # [H, W] Gaussian of `surface_out`, -1 = no hit
    ):
        """Paper eq. 1 for one tile per thread."""
        tile = base + wp.tid()
        columns = (width + TILE - 1) / TILE
        x0 = (tile % columns) * TILE
        y0 = (tile / columns) * TILE
        walk(tile, slot, offsets, fragments, knobs, width, height, state)
        write_colors(slot, x0, y0, width, height, state, colors_out, transmittance_out)
        for row in range(wp.min(TILE, height - y0)):
            last = state[slot, row, wp.static(planes - 1)]
            for i in range(wp.min(LANES, width - x0)):
                last_out[y0 + row, x0 + i] = int(last[i])
            if wp.static(depth):
                z = state[slot, row, 4]
                surface = state[slot, row, 5]
                for i in range(wp.min(LANES, width - x0)):
                    depth_sum_out[y0 + row, x0 + i] = z[i]
                    hit = int(-1)
                    d = float(0.0)
                    if surface[i] >= 0.0:
                        k = offsets[tile] + int(surface[i])
                        d = fragments[k].depth
                        hit = fragments[k].gaussian
                    surface_out[y0 + row, x0 + i] = d
                    hit_out[y0 + row, x0 + i] = hit

    return record_colors


@cache
def make_record_features(slices: int) -> wp.Kernel:
    """`make_composite_features` for training: it also writes what the backward pass starts from."""
    walk = feature_walk(slices, True)
    write = feature_writer(slices)

    @wp.kernel(module="unique", module_options=LANE_OPTIONS, enable_backward=False)
    def record_features(
        # In:
        base: int,
        slot: int,
        offsets: wp.array[int],  # [tiles + 1]
        fragments: wp.array[Fragment],  # [I]
        features: wp.array3d[Lanes],  # [N, S, 1] channels in slices of 16
        first_slice: int,  # of this pass
        knobs: Knobs,
        width: int,
        height: int,
        state: wp.array3d[Lanes],  # [slots, 16, 2 + 16 slices] scratch
        weights: wp.array3d[Lanes],  # [slots, 16, BATCH] scratch
        owners: wp.array3d[int],  # [slots, 16, BATCH] scratch
        # Out:
        features_out: wp.array3d[float],  # [H, W, C] sum of alpha T x
        transmittance_out: wp.array2d[float],  # [H, W]
        last_out: wp.array2d[int],  # [H, W] last contributing fragment, counted from its tile's first, -1 = none
    ):
        """Paper eq. 1 for any number of channels."""
        tile = base + wp.tid()
        columns = (width + TILE - 1) / TILE
        x0 = (tile % columns) * TILE
        y0 = (tile / columns) * TILE
        walk(tile, slot, offsets, fragments, features, first_slice, knobs, width, height, state, weights, owners)
        write(slot, x0, y0, first_slice, width, height, state, features_out, transmittance_out)
        for row in range(wp.min(TILE, height - y0)):
            last = state[slot, row, wp.static(1 + PASS * slices)]
            for i in range(wp.min(LANES, width - x0)):
                last_out[y0 + row, x0 + i] = int(last[i])

    return record_features
