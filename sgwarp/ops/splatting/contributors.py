"""The strongest contributors of each pixel with their blending weights, without lists of all pairs."""

from __future__ import annotations

from numbers import Integral

import torch
import warp as wp
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.kernels.contributors import block as contributors_block
from sgwarp.kernels.contributors import lanes as contributors_lanes
from sgwarp.kernels.transmittance import LaneIds
from sgwarp.ops.arguments import view
from sgwarp.ops.launcher import get_threads, launch, launch_blocks
from sgwarp.ops.memory import scratch
from sgwarp.ops.splatting import tiles
from sgwarp.ops.splatting.forward import LANE, TILE_ROWS, batch_scratch, lane_scratch, runs_in_blocks
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.scene import Camera, Gaussians


def top_contributors(
    gaussians: Gaussians,
    camera: Camera,
    k: int = 8,
    settings: RasterSettings = RasterSettings(),  # noqa: B008 - frozen
) -> tuple[Tensor, Tensor]:
    """The k Gaussians that contribute most to each pixel: the largest entries alpha T of a row of A (paper eq. 1).

    With k at least the number of contributors, the weights of a pixel add up to its accumulated opacity.

    Args:
        gaussians: The scene; Gaussians that are not finite, transparent, out of range or off screen contribute nowhere.
        camera: Where it is seen from.
        k: How many to keep per pixel, 1 or more; memory is 8 k bytes per pixel.
        settings: The rasterizer's approximations.

    Returns:
        Indices of the Gaussians, int32 [H, W, k], -1 where there are no more, and their weights alpha T, float32
        [H, W, k], descending, 0 where there are no more. Equal weights stand front to back. Without gradient.

    Raises:
        InputError: `camera` is no Camera, or `k` no positive integer.
    """
    if not isinstance(camera, Camera):
        raise InputError(f"camera: expected a Camera, got {type(camera).__name__}; a view has one: view.camera")
    if isinstance(k, bool) or not isinstance(k, Integral) or k < 1:
        raise InputError(f"k: expected a positive integer, got {k!r}")
    projected = tiles.project(gaussians, camera, settings)
    order = tiles.depth_order(projected)
    lists = tiles.bin_splats(projected, order, None, camera)
    return rank(lists, camera, settings, k)


def rank(
    lists: tiles.TileLists, camera: Camera, settings: RasterSettings, k: int, schedule: str | None = None
) -> tuple[Tensor, Tensor]:
    """`top_contributors` of tile lists.

    `schedule` is "lanes" or "block", by default the device's own; either runs on the CPU.
    """
    device = lists.order.device
    ids = torch.empty(*camera.size, k, dtype=torch.int32, device=device)
    weights = torch.empty(*camera.size, k, device=device)
    inputs = [*lists.arrays(), tiles.knobs(settings), camera.width, camera.height]
    outputs = [view(ids, wp.int32), view(weights, wp.float32)]
    if runs_in_blocks(device, schedule):
        kernel = contributors_block.rank_contributors_block
        launch_blocks(kernel, [lists.tile_count], inputs, outputs, device=device)
        return ids, weights
    threads = get_threads()
    owners = scratch("contributors", threads * TILE_ROWS * k * LANE, torch.int32, device)
    used = scratch("contributors used", threads * TILE_ROWS, torch.int32, device)
    inputs += [
        lane_scratch("state", TILE_ROWS, 1, device),
        lane_scratch("weights", TILE_ROWS, k, device),
        view(owners.view(threads, TILE_ROWS, k, LANE), LaneIds),
        view(used.view(threads, TILE_ROWS), wp.int32),
        *batch_scratch(device),
    ]
    launch(contributors_lanes.rank_contributors, lists.tile_count, inputs, outputs, device=device, slots=True)
    return ids, weights
