"""The rasterizer's backward pass, stage by stage: images -> splats -> Gaussians, colours, pose."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import warp as wp
from torch import Tensor
from torch.nn.functional import pad

from sgwarp.kernels.binning_lanes import PATCH
from sgwarp.kernels.compositing import block_backward as compositing_block_backward
from sgwarp.kernels.compositing import lanes_backward as compositing_lanes_backward
from sgwarp.kernels.compositing import lanes_sums
from sgwarp.kernels.compositing.lanes_backward import MOMENTS, row_columns
from sgwarp.kernels.harmonics import backward as harmonics_backward
from sgwarp.kernels.harmonics import lanes as harmonics_lanes
from sgwarp.kernels.native import GROUP
from sgwarp.kernels.projection import backward as kernels
from sgwarp.kernels.projection import lanes_backward as projection_lanes_backward
from sgwarp.kernels.transmittance import Lanes
from sgwarp.ops.launcher import fresh, get_threads, launch, launch_blocks, scratch, view
from sgwarp.ops.splatting import tiles
from sgwarp.ops.splatting.forward import LANE, TILE_ROWS, in_slices, lane_scratch, runs_in_blocks
from sgwarp.ops.splatting.lifting import LiftSums, add_weighted
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.scene import Camera, FeatureMap, Gaussians

TOGETHER = 4  # slices of 16 channels up to which the features' gradient comes with the geometry's
CHUNKS = 32  # of patches for a thread: few patches hold many splats, and the last to come is waited for
GROUPS = 1024  # partial sums of the pose's gradient


@dataclass(frozen=True, eq=False)
class ImageGradients:
    """Gradient of the loss with respect to what compositing returns; None is zero.

    Attributes:
        features: float32 [H, W, C].
        transmittance: float32 [H, W].
        depth_sum: Of sum alpha T z, float32 [H, W].
        surface: Of the surface depth, float32 [H, W].
    """

    features: Tensor | None = None
    transmittance: Tensor | None = None
    depth_sum: Tensor | None = None
    surface: Tensor | None = None

    def images(self, transmittance: Tensor, channels: int) -> tuple[Tensor, Tensor, Tensor]:
        """Gradients of features, transmittance and depth sum; zeros of their shape where there are none."""
        zeros = torch.zeros((), device=transmittance.device)
        v_image = zeros.expand(*transmittance.shape, channels) if self.features is None else self.features
        others = (self.transmittance, self.depth_sum)
        v_transmittance, v_depth = (zeros.expand_as(transmittance) if t is None else t for t in others)
        return v_image, v_transmittance, v_depth


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

    def arrays(self) -> list[wp.array]:
        """Inputs of the kernels that read a Gaussian's rows: ranges, used."""
        return [view(self.lists.row_ranges, wp.int32), view(self.used, wp.uint8)]


@dataclass(frozen=True, eq=False)
class SplatGradients:
    """Gradients of the splats from compositing; zero for Gaussians that reached no tile.

    Attributes:
        sums: Moments of g under 1, u, v, u^2, u v, v^2 (see kernels/projection_backward.py), then others, [N, 16].
        at_depth: Column of `sums` with the gradient of the depth, -1 if there is none.
        features: Gradient of the composited features, [N, C].
        absolute: Sum over the pixels of the magnitude of each one's gradient of the projected centre, [N, 2]; or None.
    """

    sums: Tensor
    at_depth: int
    features: Tensor
    absolute: Tensor | None


@dataclass(frozen=True, eq=False)
class GaussianGradients:
    """Gradients with respect to what projection reads, float32 [N, ...]; `poses` [N, 12] is empty unless asked for."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    means2d: Tensor
    poses: Tensor


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
    transmittance, last, hit = recorded
    wide = channels > 3
    v_image, v_transmittance, v_depth = gradients.images(transmittance, channels)
    depth = gradients.depth_sum is not None or gradients.surface is not None
    at_depth, at_absolute, _ = row_columns(wide, depth, absolute)
    totals = None
    if block:
        slices = in_slices(features if wide and features is not None else v_depth[:1, :1])
        pixels = in_slices(v_image if wide else v_depth[:0, :0, None])
        sums = torch.zeros(count, LANE, device=device)
        places = lists.intersections * LANE if ordered else 0
        rows = scratch("backward rows", places, torch.float32, device).view(-1, LANE)
        images = [view(t.contiguous(), wp.float32) for t in (transmittance, v_transmittance, v_image)]
        by_four = (view(t.flatten(-2).unflatten(-1, (-1, 4)), wp.vec4) for t in (slices, pixels))
        features_by_four, v_features = by_four
        inputs = [*lists.arrays(), features_by_four, *images, v_features, view(v_depth.contiguous(), wp.float32)]
        inputs += [view(last, wp.int32), tiles.knobs(settings), camera.width, camera.height]
        kernel = compositing_block_backward.make_composite_backward_block(wide, depth, absolute, ordered)
        outputs = [view(rows if ordered else sums, wp.float32)]
        launch_blocks(kernel, [lists.tile_count], inputs, outputs, device=device)
    else:
        replayed = replay(lists, camera, settings, features, channels, recorded, gradients, absolute=absolute)
        sums = torch.empty(count, LANE, device=device)
        inputs = [*replayed.arrays(), view(replayed.rows, Lanes)]
        launch(lanes_sums.sum_used_rows, count, inputs, [view(sums, Lanes)], device=device)
        if len(replayed.features):
            totals = torch.empty(count, *replayed.features.shape[1:], device=device)
            inputs = [*replayed.arrays(), view(replayed.features, Lanes)]
            launch(lanes_sums.sum_used_features, count, inputs, [view(totals, Lanes)], device=device)
    if block and ordered:
        inputs = [*lists.sums(), view(rows, Lanes)]
        launch(kernels.sum_intersections, len(lists.order), inputs, [view(sums, Lanes)], device=device)
    if gradients.surface is not None and count:
        _add_at_surface(sums[:, at_depth], hit.flatten(), gradients.surface.flatten(), ordered)
    if not wide:
        v_features = sums[:, MOMENTS : MOMENTS + channels]
    elif totals is not None:
        v_features = totals.flatten(1)[:, :channels]
    else:
        v_features = _lift_gradient(lists, camera, v_image, settings, count, block, ordered)
    # The kernel leaves out the factor of d(2^x) = ln 2 2^x dx, and that of the square.
    magnitudes = 2.0 * kernels.LN_2 * sums[:, at_absolute : at_absolute + 2] if absolute else None
    return SplatGradients(sums, at_depth if depth else -1, v_features, magnitudes)


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
    v_image, v_transmittance, v_depth = gradients.images(transmittance, channels)
    depth = gradients.depth_sum is not None or gradients.surface is not None
    slices = in_slices(features if wide and features is not None else v_depth[:1, :1])
    pixels = in_slices(v_image if wide else v_depth[:0, :0, None])
    row_count = int(lists.row_ranges[-1, 0])
    shape = (row_count, slices.shape[1], LANE) if wide and slices.shape[1] <= TOGETHER else (0, 0, LANE)
    rows = scratch("backward rows", row_count * LANE, torch.float32, device).view(-1, LANE)
    used = scratch("rows in use", row_count, torch.uint8, device).zero_()
    feature_rows = scratch("feature rows", math.prod(shape), torch.float32, device).view(shape)
    narrow = v_depth[:0, :0, None] if wide else v_image
    if channels < 3:
        narrow = pad(narrow, (0, 3 - channels))
    maps = [view(t.contiguous(), wp.float32) for t in (transmittance, v_transmittance)]
    maps += [view(last, wp.int32), view(narrow.contiguous(), wp.float32), view(pixels, Lanes)]
    maps += [view((v_depth if depth else v_depth[:0]).contiguous(), wp.float32)]
    gradient = lane_scratch("backward gradient", TILE_ROWS, slices.shape[1] * LANE if wide else 0, device)
    offsets, listed, splats = lists.arrays()
    inputs = [offsets, listed, view(lists.row_places, wp.int32), splats, view(slices.unsqueeze(2), Lanes), *maps]
    inputs += [tiles.knobs(settings), camera.width, camera.height, gradient]
    kernel = compositing_lanes_backward.make_composite_backward(wide, depth, absolute)
    outputs = [view(rows, Lanes), view(used, wp.uint8), view(feature_rows, Lanes)]
    patches = _patch_count(camera)
    chunk = max(1, patches // (CHUNKS * get_threads()))
    launch(kernel, patches, inputs, outputs, device=device, slots=True, chunk=chunk)
    at_depth, *_ = row_columns(wide, depth, absolute)
    return ReplayedRows(lists, rows, used, feature_rows, at_depth if depth else -1)


def _patch_count(camera: Camera) -> int:
    side = tiles.TILE * PATCH
    return -(-camera.width // side) * -(-camera.height // side)


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
