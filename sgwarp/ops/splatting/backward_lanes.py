"""The rasterizer's backward pass on the CPU: tiles are replayed, then one kernel makes every gradient of a Gaussian."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.nn.functional import pad

from sgwarp.kernels.binning_lanes import PATCH, order_patches
from sgwarp.kernels.compositing import lanes_backward as compositing_lanes_backward
from sgwarp.kernels.compositing.lanes_backward import MOMENTS, row_columns
from sgwarp.kernels.native import GROUP
from sgwarp.kernels.projection import backward as kernels
from sgwarp.kernels.projection import lanes_backward as projection_lanes_backward
from sgwarp.kernels.transmittance import Lanes
from sgwarp.ops.arguments import view
from sgwarp.ops.launcher import get_threads, launch
from sgwarp.ops.memory import fresh, scratch
from sgwarp.ops.splatting import tiles
from sgwarp.ops.splatting.forward import LANE, TILE_ROWS, in_slices, lane_scratch
from sgwarp.ops.splatting.gradients import GaussianGradients, ImageGradients
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.scene import Camera, Gaussians

TOGETHER = 4  # slices of 16 channels up to which the features' gradient comes with the geometry's
CHUNKS = 32  # of patches for a thread: few patches hold many splats


@dataclass(frozen=True, eq=False)
class ReplayedRows:
    """What replaying the tiles adds up of each splat in each patch (CPU); scratch, valid until the next backward pass.

    Attributes:
        lists: Kept tile lists, with rows.
        rows: Columns as in `SplatGradients.sums`, float32 [R, 16]; valid where used.
        used: Whether some pixel of the patch saw the splat, uint8 [R].
        features: Gradient of the composited features, [R, S, 16], or empty.
        at_depth: As in `SplatGradients`.
    """

    lists: tiles.TileLists
    rows: Tensor
    used: Tensor
    features: Tensor
    at_depth: int

    def arrays(self) -> list[Any]:
        """Inputs of the kernels that read a Gaussian's rows: ranges, used."""
        return [view(self.lists.row_ranges, wp.int32), view(self.used, wp.uint8)]


def replay(
    lists: tiles.TileLists,
    camera: Camera,
    settings: RasterSettings,
    features: Tensor | None,
    channels: int,
    recorded: tuple[Tensor, Tensor, Tensor],
    gradients: ImageGradients,
    *,
    absolute: bool = False,
) -> ReplayedRows:
    """Replay the tiles from their last fragments to their first (CPU); arguments as in `composite_backward`."""
    device, wide = lists.order.device, channels > 3
    transmittance, last, _ = recorded
    v_image, v_alpha, v_depth = gradients.images(transmittance, channels)
    depth = gradients.depth_sum is not None or gradients.surface is not None
    slices = in_slices(features if wide and features is not None else v_depth[:1, :1])
    pixels = in_slices(v_image if wide else v_depth[:0, :0, None])
    row_count = int(lists.row_ranges[-1, 0])
    shape = (row_count, slices.shape[1], LANE) if wide and slices.shape[1] <= TOGETHER else (0, 0, LANE)
    rows = scratch("backward rows", row_count * LANE, torch.float32, device).view(-1, LANE)
    used = scratch("rows in use", row_count, torch.uint8, device)
    patches = _patch_count(camera)
    order = view(scratch("patches", patches, torch.int32, device), wp.int32)
    launch(
        order_patches,
        1,
        [view(lists.offsets, wp.int32), camera.width, camera.height],
        [order, view(used, wp.uint8)],
        device=device,
    )
    feature_rows = scratch("feature rows", math.prod(shape), torch.float32, device).view(shape)
    narrow = v_depth[:0, :0, None] if wide else v_image
    if channels < 3:
        narrow = pad(narrow, (0, 3 - channels))
    maps = [view(t.contiguous(), wp.float32) for t in (transmittance, v_alpha)]
    maps += [view(last, wp.int32), view(narrow.contiguous(), wp.float32), view(pixels, Lanes)]
    maps += [view((v_depth if depth else v_depth[:0]).contiguous(), wp.float32)]
    gradient = lane_scratch("backward gradient", TILE_ROWS, slices.shape[1] * LANE if wide else 0, device)
    offsets, listed, splats = lists.arrays()
    inputs = [order, offsets, listed, view(lists.row_places, wp.int32), splats, view(slices.unsqueeze(2), Lanes), *maps]
    inputs += [tiles.knobs(settings), camera.width, camera.height, gradient]
    kernel = compositing_lanes_backward.make_composite_backward(wide, depth, absolute)
    outputs = [view(rows, Lanes), view(used, wp.uint8), view(feature_rows, Lanes)]
    chunk = max(1, patches // (CHUNKS * get_threads()))
    launch(kernel, patches, inputs, outputs, device=device, slots=True, chunk=chunk)
    at_depth, *_ = row_columns(wide, depth, absolute)
    return ReplayedRows(lists, rows, used, feature_rows, at_depth if depth else -1)


def _patch_count(camera: Camera) -> int:
    side = tiles.TILE * PATCH
    return -(-camera.width // side) * -(-camera.height // side)


def differentiate(
    gaussians: Gaussians,
    camera: Camera,
    settings: RasterSettings,
    replayed: ReplayedRows,
    degree: int,
    *,
    pose: bool = False,
    centres: bool = False,
) -> tuple[GaussianGradients, Tensor, Tensor]:
    """Sums per Gaussian, `project_backward` and `shade_backward` in one go (CPU).

    Args:
        replayed: Of three colours.
        pose, centres: Whether the gradients of the pose and of the projected centres are asked for.

    Returns:
        The gradients of the geometry, and what `shade_backward` returns.
    """
    n, device = len(gaussians), gaussians.device
    shapes = ((n, 3), (n, 4), (n, 3), (n,), (n if centres else 0, 2), (n if pose else 0, kernels.POSE_COLUMNS))
    means, quats, scales, opacities, means2d, poses = (torch.empty(*shape, device=device) for shape in shapes)
    v_sh, v_offsets = fresh(*gaussians.sh.shape, device=device), torch.empty(n if pose else 0, 3, device=device)
    inputs = [
        view(gaussians.means, wp.vec3),
        view(gaussians.quats, wp.vec4),
        view(gaussians.scales, wp.vec3),
        view(gaussians.opacities, wp.float32),
        view(gaussians.sh, wp.vec3),
        degree,
        tiles.pinhole(camera),
        tiles.knobs(settings),
        *replayed.arrays(),
        view(replayed.rows, Lanes),
        MOMENTS,
        replayed.at_depth,
    ]
    outputs = [
        view(means, wp.vec3),
        view(quats, wp.vec4),
        view(scales, wp.vec3),
        view(opacities, wp.float32),
        view(v_sh, wp.vec3),
        view(means2d, wp.vec2),
        view(poses, wp.float32),
        view(v_offsets, wp.float32),
    ]
    groups = -(-n // GROUP)
    launch(projection_lanes_backward.differentiate_groups, groups, inputs, outputs, device=device)
    return GaussianGradients(means, quats, scales, opacities, means2d, poses), v_sh, v_offsets
