"""Loading kernels side by side, before the first of them is asked for."""

from __future__ import annotations

import torch
import warp as wp

from sgwarp.kernels import binning_lanes, ordering_lanes
from sgwarp.kernels.compositing.lanes import make_composite_colors
from sgwarp.kernels.compositing.lanes_backward import make_composite_backward
from sgwarp.kernels.compositing.lanes_features import make_composite_features
from sgwarp.kernels.compositing.lanes_sums import sum_used_rows
from sgwarp.kernels.harmonics.lanes import shade_groups_backward
from sgwarp.kernels.projection import lanes as projection_lanes
from sgwarp.kernels.projection.lanes_backward import differentiate_groups, project_groups_backward
from sgwarp.kernels.transmittance import LANES
from sgwarp.ops.launcher import load_together

WIDE_PASS = 4  # slices of 16 channels that one walk over the tiles takes; more would leave the cache


def load_rendering(
    device: torch.device, *, harmonics: bool, depth: bool, backward: bool = False, absolute: bool = False
) -> None:
    """Load what compositing three channels on the CPU needs; with an empty cache, compile it on several threads.

    Args:
        device: Where the scene lies; on CUDA kernels are loaded one by one.
        harmonics: The channels are colours of harmonics.
        depth: Depths are composited as well.
        backward: A backward pass follows.
        absolute: And it adds up magnitudes.
    """
    if device.type == "cpu":
        load_together(rendering_kernels(harmonics=harmonics, depth=depth, backward=backward, absolute=absolute))


def load_wide_rendering(device: torch.device, channels: int, *, depth: bool) -> None:
    """Load what compositing more than three channels on the CPU needs, without a backward pass."""
    if device.type == "cpu":
        load_together(wide_rendering_kernels(channels, depth=depth))


def rendering_kernels(
    *, harmonics: bool, depth: bool, backward: bool = False, absolute: bool = False
) -> list[wp.Kernel]:
    """Kernels of `load_rendering`, one of each module."""
    colors = make_composite_colors(depth, backward)
    needed: list[wp.Kernel] = [make_composite_backward(False, depth, absolute)] * backward
    needed += [projection_lanes.project_groups, ordering_lanes.sort_depths, binning_lanes.count_tiles, colors]
    if harmonics and not absolute:
        return needed + [differentiate_groups] * backward
    return (
        needed
        + [sum_used_rows, project_groups_backward] * backward
        + [shade_groups_backward] * (harmonics and backward)
    )


def wide_rendering_kernels(channels: int, *, depth: bool) -> list[wp.Kernel]:
    """Kernels of `load_wide_rendering`."""
    needed: list[wp.Kernel] = [make_composite_features(width, False) for width in pass_widths(channels)]
    needed += [projection_lanes.project_groups, ordering_lanes.sort_depths, binning_lanes.count_tiles]
    return needed + [make_composite_colors(True, False)] * depth


def pass_widths(channels: int) -> list[int]:
    """Different widths of the passes over so many channels [slices of 16]."""
    wide, narrow = divmod(-(-channels // LANES), WIDE_PASS)
    return [WIDE_PASS] * (wide > 0) + [1] * (narrow > 0)
