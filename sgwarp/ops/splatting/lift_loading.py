"""Loading the kernels of lifting side by side, before the first of them is asked for."""

from __future__ import annotations

import torch
import warp as wp

from sgwarp.kernels import binning_lanes, ordering_lanes
from sgwarp.kernels.lifting import lanes, lanes_wide, shared
from sgwarp.kernels.projection import lanes as projection_lanes
from sgwarp.kernels.transmittance import LANES
from sgwarp.ops.launcher import load_together
from sgwarp.ops.splatting.loading import pass_widths
from sgwarp.ops.splatting.wide_lifting import LEAST_SLICES


def load_lifting(device: torch.device, channels: int, *, ids: bool, squared: bool) -> None:
    """Load what lifting by the weights of pixels on the CPU needs; with an empty cache, compile it on several threads.

    Args:
        device: Where the scene lies; on CUDA kernels are loaded one by one.
        channels: Of the map.
        ids: It is a map of ids.
        squared: The weights are squared.
    """
    if device.type == "cpu":
        load_together(lifting_kernels(channels, ids=ids, squared=squared))


def lifting_kernels(channels: int, *, ids: bool, squared: bool) -> list[wp.Kernel]:
    """Kernels of `load_lifting`, one of each module."""
    if ids:
        kernels: list[wp.Kernel] = [lanes.make_lift_ids(squared)]
    elif channels > LANES * (LEAST_SLICES - 1):
        kernels = [lanes_wide.make_list_weights(write, squared) for write in (False, True)]
        kernels += [lanes_wide.sum_tiles, *(lanes.make_lift_dense(1, squared) for _ in pass_widths(channels)[1:])]
    else:
        kernels = [lanes.make_lift_dense(width, squared) for width in pass_widths(channels)]
    kernels += [projection_lanes.project_groups, ordering_lanes.sort_depths, binning_lanes.count_tiles]
    return [*kernels, shared.sum_rows]
