"""Pinhole projection of Gaussians given by quaternions and scales, and their colours, by kernels (CUDA).

The same tables as `projection.project_splats` makes in torch, in four launches and two more for the gradients.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
import warp as wp
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.kernels.harmonics import forward as harmonics
from sgwarp.kernels.projection import table as kernels
from sgwarp.ops.arguments import view
from sgwarp.ops.launcher import launch, launch_plain
from sgwarp.ops.splatting import backward, tiles
from sgwarp.ops.splatting.forward import LANE
from sgwarp.ops.splatting.gradients import SplatGradients
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.scene import Camera, Gaussians
from sgwarp.scene.checks import require_cameras

if TYPE_CHECKING:
    from sgwarp.ops.planar.projection import ProjectionSettings


@dataclass(frozen=True, eq=False)
class TableRequest:
    """What a projection needs beside its tensors.

    Attributes:
        camera: Read from the device.
        settings: Of the projection.
        opacities: float32 [N], or empty: all Gaussians are opaque.
        sparse: Gradients of means, quaternions and scales as sparse tensors (COO).
    """

    camera: Camera
    settings: ProjectionSettings
    opacities: Tensor
    sparse: bool

    @property
    def raster_settings(self) -> RasterSettings:
        s = self.settings
        return RasterSettings(alpha_min=s.alpha_min, dilation=s.dilation, antialiased=s.compensated)


def read_camera(world_to_camera: Tensor, K: Tensor, width: int, height: int, near: float, far: float) -> Camera | None:
    """The camera on the host, for which it waits once; None if it is none that the kernels know.

    Raises:
        InputError: It sees nothing at all.
    """
    pose, intrinsics = (t.detach().to(torch.float64).flatten() for t in (world_to_camera, K))
    if pose.device == intrinsics.device:
        pose, intrinsics = torch.cat([pose, intrinsics]).cpu().split([16, 9])
    pose, intrinsics = pose.cpu().view(4, 4), intrinsics.cpu().view(3, 3)
    require_cameras(pose, intrinsics)
    try:
        return Camera(intrinsics, pose, width, height, near, far)
    except InputError:
        return None


class ProjectTable(torch.autograd.Function):
    """(means, quats, scales, world_to_camera, request) -> index, means2d, depths, conics, factors, compensations,
    covariances, radii of the Gaussians that are kept; see `projection.ProjectedSplats`."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, quats: Tensor, scales: Tensor, world_to_camera: Tensor, request: TableRequest
    ) -> tuple[Tensor, ...]:
        count, device = len(means), means.device
        kept = torch.empty(count, dtype=torch.uint8, device=device)
        table = torch.empty(count, kernels.TABLE_COLUMNS, device=device)
        radii = torch.empty(count, 2, dtype=torch.int32, device=device)
        inputs = [view(means, wp.vec3), view(quats, wp.vec4), view(scales, wp.vec3)]
        inputs += [view(request.opacities, wp.float32), tiles.pinhole(request.camera)]
        inputs += [tiles.knobs(request.raster_settings), request.settings.radius_clip, request.settings.min_area_ratio]
        outputs = [view(kept, wp.uint8), view(table, wp.float32), view(radii, wp.int32)]
        launch(kernels.tabulate_splats, count, inputs, outputs, device=device)
        index = kept.nonzero()[:, 0]
        rows = table.index_select(0, index)
        radii = radii.index_select(0, index)
        ctx.save_for_backward(means, quats, scales, world_to_camera, index, rows)
        ctx.request = request
        ctx.set_materialize_grads(False)
        means2d, depths, conics, factors, compensations, covariances = rows.split([2, 1, 3, 3, 1, 3], dim=1)
        covariances = covariances.contiguous()
        ctx.mark_non_differentiable(index, covariances, radii)
        columns = means2d.contiguous(), depths[:, 0].contiguous(), conics.contiguous(), factors.to(torch.float64)
        return index, *columns, compensations[:, 0].contiguous(), covariances, radii

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, _index: None, *given: Tensor | None) -> tuple[Tensor | None, ...]:
        means, quats, scales, world_to_camera, index, rows = ctx.saved_tensors
        request: TableRequest = ctx.request
        sums = torch.zeros(len(means), LANE, device=means.device)
        inputs = [view(index, wp.int64), view(rows, wp.float32)]
        for gradient, dims in zip(given[:5], (2, 1, 2, 2, 1), strict=True):
            double = len(inputs) == 5  # the factors'
            dtype = torch.float64 if double else torch.float32
            empty = torch.empty((0,) * dims, dtype=dtype, device=means.device)
            values = empty if gradient is None else gradient.to(dtype).contiguous()
            inputs.append(view(values, wp.float64 if double else wp.float32))
        inputs.append(request.settings.min_area_ratio)
        launch_plain(kernels.gather_moments, len(index), inputs, [view(sums, wp.float32)], device=means.device)
        opacities = request.opacities if len(request.opacities) else means.new_ones(len(means))
        gaussians = Gaussians.unchecked(means, quats, scales, opacities, means.new_zeros(len(means), 1, 3))
        splats = SplatGradients(sums, kernels.AT_DEPTH, sums[:, :0], None)
        pose = ctx.needs_input_grad[3]
        result = backward.project_backward(gaussians, request.camera, request.raster_settings, splats, pose=pose)
        v_world_to_camera = (
            backward.pose_gradient(request.camera, result.poses, None).to(world_to_camera) if pose else None
        )
        gradients: tuple[Tensor, ...] = (result.means, result.quats, result.scales)
        if request.sparse:
            gradients = tuple(
                torch.sparse_coo_tensor(
                    index[None], g.index_select(0, index), g.shape, is_coalesced=True, check_invariants=False
                )
                for g in gradients
            )
        return *gradients, v_world_to_camera, None


class ShadeTable(torch.autograd.Function):
    """(means, sh, center, index, camera, degree) -> colours of the rows [V, 3], from harmonics of degree 0 to 3.

    The values are those of the camera; the gradient of its centre goes to `center`, float64 [3]. A row is NaN, which
    compositing leaves out, where a coefficient up to the degree is not finite.
    """

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, sh: Tensor, center: Tensor, index: Tensor, camera: Camera, degree: int
    ) -> Tensor:
        colors = torch.empty(len(index), 3, device=means.device)
        order = index.to(torch.int32)
        inputs = [view(order, wp.int32), view(means, wp.vec3), view(sh, wp.vec3), degree, tiles.pinhole(camera)]
        launch(harmonics.evaluate_harmonics, len(index), inputs, [view(colors, wp.vec3)], device=means.device)
        status = torch.zeros(len(means), dtype=torch.uint8, device=means.device)
        tiles.mark_non_finite_colors(sh[:, : (degree + 1) ** 2].contiguous(), status)
        colors.masked_fill_(status.index_select(0, index)[:, None] != 0, torch.nan)
        ctx.save_for_backward(means, sh, index)
        ctx.camera, ctx.degree = camera, degree
        return colors

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        means, sh, index = ctx.saved_tensors
        count, device = len(means), means.device
        sums = torch.zeros(count, LANE, device=device)
        inputs = [view(index, wp.int64), view(gradient.to(torch.float32).contiguous(), wp.float32)]
        launch_plain(kernels.scatter_colors, len(index), inputs, [view(sums, wp.float32)], device=device)
        v_means, pose = torch.zeros_like(means), ctx.needs_input_grad[2]
        opaque = means.new_ones(count)
        gaussians = Gaussians.unchecked(means, means.new_zeros(count, 4), means, opaque, sh)
        v_sh, v_offsets = backward.shade_backward(
            gaussians, ctx.camera, SplatGradients(sums, -1, sums[:, :0], None), v_means, ctx.degree, pose=pose, at=0
        )
        return v_means, v_sh, -backward.sum_rows(v_offsets) if pose else None, None, None, None
