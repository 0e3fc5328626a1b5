"""The rasterizer's backward pass, stage by stage: images -> splats -> Gaussians, colours, pose."""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from sgwarp.kernels.compositing import block_backward as compositing_block_backward
from sgwarp.kernels.compositing import lanes_sums
from sgwarp.kernels.compositing.lanes_backward import MOMENTS, row_columns
from sgwarp.kernels.harmonics import backward as harmonics_backward
from sgwarp.kernels.harmonics import lanes as harmonics_lanes
from sgwarp.kernels.native import GROUP
from sgwarp.kernels.projection import backward as kernels
from sgwarp.kernels.projection import lanes_backward as projection_lanes_backward
from sgwarp.kernels.transmittance import Lanes
from sgwarp.ops.arguments import view
from sgwarp.ops.launcher import launch, launch_blocks
from sgwarp.ops.memory import fresh, scratch
from sgwarp.ops.splatting import tiles
from sgwarp.ops.splatting.backward_lanes import ReplayedRows, replay
from sgwarp.ops.splatting.forward import LANE, in_slices, runs_in_blocks
from sgwarp.ops.splatting.gradients import GaussianGradients, ImageGradients, SplatGradients
from sgwarp.ops.splatting.lifting import LiftSums, add_weighted
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.scene import Camera, FeatureMap, Gaussians

GROUPS = 1024  # partial sums of the pose's gradient


def composite_backward(
    lists: tiles.TileLists,
    camera: Camera,
    settings: RasterSettings,
    features: Tensor | None,
    channels: int,
    recorded: tuple[Tensor, Tensor, Tensor],
    gradients: ImageGradients,
    count: int,
    *,
    absolute: bool = False,
    schedule: str | None = None,
    deterministic: bool | None = None,
) -> SplatGradients:
    """Differentiate `composite_recorded`.

    Args:
        lists: Kept tile lists of the view, with places.
        features: What was composited if it did not travel with the splats, [N, C].
        channels: Of the image.
        recorded: Transmittance, `last` and `hit` as compositing returned them.
        gradients: Of the loss.
        count: N.
        absolute: Also sum magnitudes.
        schedule: "lanes" or "block", by default the device's own.
        deterministic: Add up in a fixed order. The CPU always does; on CUDA the default is atomic additions.
    """
    device = lists.order.device
    block = runs_in_blocks(device, schedule)
    ordered = not block or (device.type == "cpu" if deterministic is None else deterministic)
    wide = channels > 3
    depth = gradients.depth_sum is not None or gradients.surface is not None
    at_depth, at_absolute, _ = row_columns(wide, depth, absolute)
    totals = None
    if block:
        sums = _replay_blocks(
            lists, camera, settings, features, channels, recorded, gradients, count, absolute=absolute, ordered=ordered
        )
    else:
        replayed = replay(lists, camera, settings, features, channels, recorded, gradients, absolute=absolute)
        sums, totals = _sum_rows_of_lanes(replayed, count, device)
    if gradients.surface is not None and count:
        _add_at_surface(sums[:, at_depth], recorded[2].flatten(), gradients.surface.flatten(), ordered)
    if not wide:
        v_features = sums[:, MOMENTS : MOMENTS + channels]
    elif totals is not None:
        v_features = totals.flatten(1)[:, :channels]
    else:
        v_image, *_ = gradients.images(recorded[0], channels)
        v_features = _lift_gradient(lists, camera, v_image, settings, count, block, ordered)
    # The kernel leaves out the factor of d(2^x) = ln 2 2^x dx, and that of the square.
    magnitudes = 2.0 * kernels.LN_2 * sums[:, at_absolute : at_absolute + 2] if absolute else None
    return SplatGradients(sums, at_depth if depth else -1, v_features, magnitudes)


def _replay_blocks(
    lists: tiles.TileLists,
    camera: Camera,
    settings: RasterSettings,
    features: Tensor | None,
    channels: int,
    recorded: tuple[Tensor, Tensor, Tensor],
    gradients: ImageGradients,
    count: int,
    *,
    absolute: bool,
    ordered: bool,
) -> Tensor:
    """`SplatGradients.sums` by the block schedule."""
    device, wide = lists.order.device, channels > 3
    transmittance, last, _ = recorded
    v_image, v_alpha, v_depth = gradients.images(transmittance, channels)
    depth = gradients.depth_sum is not None or gradients.surface is not None
    slices = in_slices(features if wide and features is not None else v_depth[:1, :1])
    pixels = in_slices(v_image if wide else v_depth[:0, :0, None])
    sums = torch.zeros(count, LANE, device=device)
    rows = scratch("backward rows", lists.intersections * LANE if ordered else 0, torch.float32, device).view(-1, LANE)
    images = [view(t.contiguous(), wp.float32) for t in (transmittance, v_alpha, v_image)]
    by_four = (view(t.flatten(-2).unflatten(-1, (-1, 4)), wp.vec4) for t in (slices, pixels))
    features_by_four, v_features = by_four
    inputs = [*lists.arrays(), features_by_four, *images, v_features, view(v_depth.contiguous(), wp.float32)]
    inputs += [view(last, wp.int32), tiles.knobs(settings), camera.width, camera.height]
    kernel = compositing_block_backward.make_composite_backward_block(wide, depth, absolute, ordered)
    launch_blocks(kernel, [lists.tile_count], inputs, [view(rows if ordered else sums, wp.float32)], device=device)
    if ordered:
        inputs = [*lists.sums(), view(rows, Lanes)]
        launch(kernels.sum_intersections, len(lists.order), inputs, [view(sums, Lanes)], device=device)
    return sums


def _sum_rows_of_lanes(replayed: ReplayedRows, count: int, device: torch.device) -> tuple[Tensor, Tensor | None]:
    """`SplatGradients.sums`, and the features' gradient [N, S, 16] if it was replayed with them."""
    sums = torch.empty(count, LANE, device=device)
    inputs = [*replayed.arrays(), view(replayed.rows, Lanes)]
    launch(lanes_sums.sum_used_rows, count, inputs, [view(sums, Lanes)], device=device)
    if not len(replayed.features):
        return sums, None
    totals = torch.empty(count, *replayed.features.shape[1:], device=device)
    inputs = [*replayed.arrays(), view(replayed.features, Lanes)]
    launch(lanes_sums.sum_used_features, count, inputs, [view(totals, Lanes)], device=device)
    return sums, totals


def _add_at_surface(column: Tensor, hit: Tensor, gradient: Tensor, ordered: bool) -> None:
    """Add each pixel's gradient of the surface depth to the Gaussian that gave it.

    Pixels without a surface add zero, to some Gaussian: to leave them out would be to wait for the device.
    """
    gradient = torch.where(hit >= 0, gradient, 0.0)
    if not hit.is_cuda:
        column.index_add_(0, hit.clamp(min=0).to(torch.int64), gradient)
        return
    anywhere = torch.arange(len(hit), device=hit.device) % len(column)  # one for all would be added to in turn
    rows = torch.where(hit >= 0, hit, anywhere).to(torch.int64)
    if ordered:  # index_add_ is atomic on CUDA, this sorts
        column.index_put_((rows,), gradient, accumulate=True)
    else:
        column.index_add_(0, rows, gradient)


def _lift_gradient(
    lists: tiles.TileLists,
    camera: Camera,
    v_image: Tensor,
    settings: RasterSettings,
    count: int,
    block: bool,
    ordered: bool,
) -> Tensor:
    """Gradient of the features: the image is A x, so it is A^T v, the image's gradient lifted onto the Gaussians."""
    sums = LiftSums.zeros(count, v_image.shape[2], v_image.device)
    feature_map = FeatureMap(space="gradient", dense=v_image.contiguous())
    add_weighted(lists, camera, feature_map, sums, settings, block=block, ordered=ordered)
    return sums.features


def project_backward(
    gaussians: Gaussians,
    camera: Camera,
    settings: RasterSettings,
    splats: SplatGradients,
    *,
    pose: bool = False,
) -> GaussianGradients:
    """Differentiate `tiles.project`; `pose` asks for each Gaussian's share of the pose's gradient."""
    n, device = len(gaussians), gaussians.device
    means, quats, scales, opacities, means2d, poses = (
        torch.empty(*shape, device=device)
        for shape in ((n, 3), (n, 4), (n, 3), (n,), (n, 2), (n if pose else 0, kernels.POSE_COLUMNS))
    )
    result = GaussianGradients(means, quats, scales, opacities, means2d, poses)
    inputs = [
        view(gaussians.means, wp.vec3),
        view(gaussians.quats, wp.vec4),
        view(gaussians.scales, wp.vec3),
        view(gaussians.opacities, wp.float32),
        tiles.pinhole(camera),
        tiles.knobs(settings),
        view(splats.sums, wp.float32),
        splats.at_depth,
    ]
    outputs = [
        view(result.means, wp.vec3),
        view(result.quats, wp.vec4),
        view(result.scales, wp.vec3),
        view(result.opacities, wp.float32),
        view(result.means2d, wp.vec2),
        view(result.poses, wp.float32),
    ]
    if device.type == "cuda":
        launch(kernels.project_backward, n, inputs, outputs, device=device)
    else:
        groups = -(-n // GROUP)
        launch(projection_lanes_backward.project_groups_backward, groups, inputs, outputs, device=device)
    return result


def shade_backward(
    gaussians: Gaussians,
    camera: Camera,
    splats: SplatGradients,
    v_means: Tensor,
    degree: int,
    *,
    pose: bool = False,
    at: int = MOMENTS,
) -> tuple[Tensor, Tensor]:
    """Differentiate `tiles.shade`; `v_means` is added to. The gradient of the colours stands in the sums from `at` on.

    Returns:
        Gradient of the coefficients, [N, K, 3], and of each centre seen from the camera's, [N, 3] or, unless `pose`,
        empty.
    """
    n, device = len(gaussians), gaussians.device
    v_sh = fresh(*gaussians.sh.shape, device=device)
    v_offsets = torch.empty(n if pose else 0, 3, device=device)
    inputs = [
        view(gaussians.means, wp.vec3),
        view(gaussians.sh, wp.vec3),
        degree,
        tiles.pinhole(camera),
        view(splats.sums, wp.float32),
        at,
    ]
    outputs = [view(v_sh, wp.vec3), view(v_means, wp.vec3), view(v_offsets, wp.float32)]
    if device.type == "cuda":
        launch(harmonics_backward.harmonics_backward, n, inputs, outputs, device=device)
    else:
        groups = -(-n // GROUP)
        launch(harmonics_lanes.shade_groups_backward, groups, inputs, outputs, device=device)
    return v_sh, v_offsets


def pose_gradient(camera: Camera, poses: Tensor, v_offsets: Tensor | None) -> Tensor:
    """Gradient of the world-to-camera matrix, float64 [4, 4], from every Gaussian's share.

    Args:
        poses: Of the rotation about the camera's centre and of the translation, [N, 12].
        v_offsets: Of each centre seen from the camera's, [N, 3], where colours depend on the direction.
    """
    total = sum_rows(poses)
    v_translation = total[9:]
    pose, center = camera.world_to_camera.to(poses.device), camera.position.to(poses.device)
    gradient = torch.zeros(4, 4, dtype=torch.float64, device=poses.device)
    # p = R m + t, and m = (m - center) + center.
    gradient[:3, :3] = total[:9].view(3, 3) + torch.outer(v_translation, center)
    gradient[:3, 3] = v_translation
    if v_offsets is not None:
        v_center = -sum_rows(v_offsets)
        gradient[:3, :3] -= torch.outer(pose[:3, 3], v_center)
        gradient[:3, 3] -= pose[:3, :3] @ v_center
    return gradient


def sum_rows(rows: Tensor) -> Tensor:
    """Column sums in double precision, the same bits for any number of threads, float64 [Q]."""
    per_group = max(1, -(-len(rows) // GROUPS))
    partial = torch.zeros(GROUPS, rows.shape[1], dtype=torch.float64, device=rows.device)
    inputs = [view(rows, wp.float32), per_group]
    launch(kernels.sum_groups, GROUPS, inputs, [view(partial, wp.float64)], device=rows.device)
    return partial.sum(dim=0)
