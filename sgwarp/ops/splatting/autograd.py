"""Rendering with gradients: the rasterizer on plain tensors, for fitting scenes, features and camera poses."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.ops.planar.harmonics import harmonic_colors
from sgwarp.ops.splatting import backward, backward_lanes, forward, tiles
from sgwarp.ops.splatting.forward import (
    Rendering,
    composite_recorded,
    packed_colors,
    require_finite_features,
    runs_in_blocks,
)
from sgwarp.ops.splatting.gradients import ImageGradients, gradient_of_alpha
from sgwarp.ops.splatting.loading import load_rendering
from sgwarp.ops.splatting.plan import RenderPlan, plan_render
from sgwarp.ops.splatting.room import ListRoom
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.runs.isolation import uncompiled
from sgwarp.scene import SH_COUNTS, Camera, Gaussians
from sgwarp.scene.checks import dense, require_finite


@uncompiled
def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    *,
    sh: Tensor | None = None,
    features: Tensor | None = None,
    background: Tensor | None = None,
    means2d: Tensor | None = None,
    absgrad: bool = False,
    expected_depth: bool = False,
    depth: bool = False,
    near: float = 0.01,
    far: float = 1e10,
    settings: RasterSettings = RasterSettings(),  # noqa: B008 - frozen
    schedule: str | None = None,
    deterministic: bool | None = None,
    room: ListRoom | None = None,
) -> Rendering:
    """Render a view (paper eq. 1) with gradients to every tensor but K.

    The same image as `sg.render`. Gaussians that are left out, among them all that are not finite, get gradients of
    exactly zero. On the CPU gradients have the same bits for any number of threads.

    Args:
        means: Centres [m], float [N, 3].
        quats: Rotations (w, x, y, z) of any length, float [N, 4].
        scales: Standard deviations [m], float [N, 3].
        opacities: In [0, 1], float [N].
        viewmat: World to camera (gsplat's name), OpenCV axes, rigid, float [4, 4]. Its gradient is that of the 12 free
            entries of p = R m + t; project it onto rigid motions by parametrising them.
        K: Intrinsics [pixels], [3, 3].
        width: Image width [pixels].
        height: Image height [pixels].
        sh: Spherical-harmonic coefficients, float [N, K, 3]; colours are composited.
        features: Any other values to composite, float [N, C]. With `sh` as well, the three colors come before them,
            in one pass.
        background: Seen through what is left transparent, float [C]; None is zero.
        means2d: float [N, 2], added to the projected centres as far as gradients go: its values are not read, and its
            gradient is that of the projected centres [1 / pixels], which densification looks at.
        absgrad: Also add the sum over pixels of the magnitude of each one's gradient to `means2d.absgrad` (AbsGS).
        expected_depth: Render the expected depth, as in `sg.render`; it has gradients.
        depth: Render the surface depth, as in `sg.render`; it has gradients.
        near: Least depth that is rendered [m].
        far: Largest depth that is rendered [m].
        settings: The approximations.
        schedule: "lanes" or "block", by default the device's own; either runs on the CPU.
        deterministic: Add gradients up in a fixed order. The CPU always does; on CUDA the default is atomic additions.
        room: For the tile lists: with it nobody waits for their length on CUDA, and a CUDA graph can hold the call.

    Raises:
        InputError: Shapes do not fit, or the camera is not valid; on the CPU also: a scale is negative or an opacity
            outside [0, 1].
    """
    means, quats, scales, opacities, viewmat = (
        dense(name, value)
        for name, value in zip(
            ("means", "quats", "scales", "opacities", "viewmat"),
            (means, quats, scales, opacities, viewmat),
            strict=True,
        )
    )
    K = dense("K", K)
    if means.ndim != 2:
        raise InputError(f"means: expected floating point [N, 3], got {means.dtype} {list(means.shape)}")
    sh, features, background, means2d = (
        None if value is None else dense(name, value)
        for name, value in (("sh", sh), ("features", features), ("background", background), ("means2d", means2d))
    )
    if sh is None and features is None:
        raise InputError("give sh [N, K, 3], features [N, C], or both")
    if means2d is not None and tuple(means2d.shape) != (len(means), 2):
        raise InputError(f"means2d: expected shape [{len(means)}, 2], got {list(means2d.shape)}")
    if absgrad and means2d is None:
        raise InputError("absgrad: give means2d, whose attribute absgrad receives it")
    values = sh if features is None else features
    assert values is not None
    n = len(means)
    if schedule not in (None, "lanes", "block"):
        raise InputError(f"schedule: expected 'lanes', 'block' or None, got '{schedule}'")
    if schedule == "lanes" and means.is_cuda:
        raise InputError("schedule 'lanes': is for tensors of the CPU; leave it out on CUDA")
    if features is not None:
        if not (features.ndim == 2 and len(features) == n and features.shape[1] > 0 and features.is_floating_point()):
            raise InputError(f"features: expected floating point [{n}, C], got {features.dtype} {list(features.shape)}")
        require_finite_features(features)
    _check_fields(means, quats, scales, opacities)
    for name, value in (("sh", sh), ("features", features)):
        if value is not None and value.device != means.device:
            raise InputError(f"{name}: on {value.device}, means on {means.device}; move them to one device")
    if sh is not None and not (sh.ndim == 3 and len(sh) == n and sh.shape[1] in SH_COUNTS and sh.shape[2] == 3):
        raise InputError(f"sh: expected shape [{n}, 1, 4, 9 or 16, 3], got {list(sh.shape)}")
    camera = Camera(K, viewmat, width, height, near, far)
    if sh is not None and features is not None:
        if not means.is_cuda:
            Gaussians(means, quats, scales, opacities, sh)  # its checks; some opacities are set to zero next
        colors, shown = _colors(means, sh, viewmat)
        features, sh = torch.cat([colors, features.to(means)], dim=1), None
        opacities = torch.where(shown, opacities, 0.0)
        values = features
    channels = 3 if features is None else features.shape[1]
    if background is not None and tuple(background.shape) != (channels,):
        raise InputError(f"background: expected shape [{channels}], got {list(background.shape)}")
    if background is not None:
        require_finite("background", background)

    inputs = (means, quats, scales, opacities, values, viewmat, means2d, background)
    if not (torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in inputs)):
        colors = means.new_zeros(n, 1, 3) if sh is None else sh
        return forward.rasterize(
            _as_gaussians(means, quats, scales, opacities, colors),
            camera,
            features,
            background=background,
            expected_depth=expected_depth,
            depth=depth,
            settings=settings,
            look=not means.is_cuda,
            room=room,
        )
    receives_absgrad = means2d if absgrad else None
    plan = plan_render(
        Gaussians.unchecked(means, quats, scales, opacities, means.new_zeros(n, 1, 3) if sh is None else sh),
        "colors" if features is None else "features",
        channels=channels,
        depth=expected_depth or depth,
        record=True,
        settings=settings,
        look=False,
    )
    request = _Request(camera, settings, plan, receives_absgrad, schedule, deterministic, room)
    means, quats, scales, opacities, values = (
        t.to(torch.float32).contiguous() for t in (means, quats, scales, opacities, values)
    )
    image, transmittance, alpha, depth_sum, surface = _Rasterize.apply(
        means, quats, scales, opacities, values, viewmat, means2d, request
    )
    if background is not None:
        image = image + transmittance[..., None] * background.to(image)
    mean_depth = None
    if expected_depth:
        mean_depth = torch.where(alpha > 0, depth_sum / alpha.clamp(min=1e-12), 0.0)
    return Rendering(image, alpha, mean_depth, surface if depth else None, request.status_counts)


def _colors(means: Tensor, sh: Tensor, world_to_camera: Tensor) -> tuple[Tensor, Tensor]:
    """Colors of the harmonics seen from the camera, [N, 3], and which Gaussians have one, bool [N]."""
    pose = world_to_camera.to(means)
    directions = means + pose[:3, 3] @ pose[:3, :3]  # the camera lies at -R^T t
    return harmonic_colors(directions, sh.to(means), SH_COUNTS.index(sh.shape[1]))


def _as_gaussians(*fields: Tensor) -> Gaussians:
    """The tensors as a scene; on CUDA unchecked, since to look at their values is to wait for the device."""
    if not fields[0].is_cuda:
        return Gaussians(*fields)
    return Gaussians.unchecked(*(field.to(torch.float32).contiguous() for field in fields))


def _check_fields(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor) -> None:
    """Refuse shapes, types and devices that do not fit; `_check_values` looks at values."""
    n = len(means)
    fields = {"means": (means, (n, 3)), "quats": (quats, (n, 4)), "scales": (scales, (n, 3))}
    for name, (tensor, shape) in (fields | {"opacities": (opacities, (n,))}).items():
        if tuple(tensor.shape) != shape or not tensor.is_floating_point():
            got = f"{tensor.dtype} {list(tensor.shape)}"
            raise InputError(f"{name}: expected floating point {list(shape)}, got {got}")
    devices = {str(tensor.device) for tensor, _ in fields.values()} | {str(opacities.device)}
    if len(devices) > 1:
        raise InputError(f"means, quats, scales, opacities: on {', '.join(sorted(devices))}; move them to one device")


def _check_values(gaussians: Gaussians, projected: tiles.Projected) -> None:
    """Refuse negative scales and opacities outside [0, 1], on the CPU: on CUDA to look is to wait for the device.

    The projection has looked at them already.
    """
    if projected.invalid is not None and projected.invalid[0]:
        Gaussians(*(getattr(gaussians, name) for name in ("means", "quats", "scales", "opacities", "sh")))


@dataclass(eq=False)
class _Request:
    """Arguments of a call that are not tensors, and results that are not images."""

    camera: Camera
    settings: RasterSettings
    plan: RenderPlan
    receives_absgrad: Tensor | None
    schedule: str | None
    deterministic: bool | None
    room: ListRoom | None
    status_counts: Tensor = field(default_factory=lambda: torch.empty(0, dtype=torch.int64, device="cpu"))

    @property
    def harmonics(self) -> bool:
        """Whether the values are coefficients."""
        return self.plan.values == "colors"


class _Rasterize(torch.autograd.Function):
    """Project, bin and composite; the backward pass replays the tile lists, which are kept until then."""

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        values: Tensor,
        world_to_camera: Tensor,
        means2d: Tensor | None,
        request: _Request,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        camera, settings = request.camera, request.settings
        gaussians = _gaussians(means, quats, scales, opacities, values, request)
        features = None if request.harmonics else values
        if request.schedule != "block" and (features is None or features.shape[1] <= 3):
            load_rendering(
                means.device,
                harmonics=request.harmonics,
                depth=request.plan.depth,
                backward=True,
                absolute=request.receives_absgrad is not None,
            )
        projected = tiles.project(gaussians, camera, settings, degree=request.plan.colored, look=False)
        tiles.leave_out_non_finite(projected, features)
        order = tiles.depth_order(projected, keep=True)
        _check_values(gaussians, projected)
        colors = packed_colors(gaussians, camera, features, order, request.plan)
        block = runs_in_blocks(means.device, request.schedule)
        lists = tiles.bin_splats(
            projected,
            order,
            colors,
            camera,
            places=block or values.shape[1] > 3,
            rows=not block,
            keep=True,
            room=request.room,
        )
        image, transmittance, alpha, depth_sum, surface, last, hit = composite_recorded(
            lists, camera, settings, features, request.plan.depth, request.schedule
        )
        request.status_counts = projected.counts()
        recorded = (transmittance, last, hit)
        ctx.save_for_backward(
            means, quats, scales, opacities, values, world_to_camera, *recorded, *vars(lists).values()
        )
        ctx.request = request
        ctx.channels = image.shape[2]
        ctx.set_materialize_grads(False)
        return image, transmittance, alpha, depth_sum, surface

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(
        ctx: Any,
        v_image: Tensor | None,
        v_transmittance: Tensor | None,
        v_alpha: Tensor | None,
        v_depth_sum: Tensor | None,
        v_surface: Tensor | None,
    ) -> tuple[Tensor | None, ...]:
        request: _Request = ctx.request
        camera, settings = request.camera, request.settings
        means, quats, scales, opacities, values, world_to_camera, *kept = ctx.saved_tensors
        gaussians = _gaussians(means, quats, scales, opacities, values, request)
        recorded, lists = (kept[0], kept[1], kept[2]), tiles.TileLists(*kept[3:])
        gradients = ImageGradients(v_image, gradient_of_alpha(v_alpha, v_transmittance), v_depth_sum, v_surface)
        pose, absolute, degree = ctx.needs_input_grad[5], request.receives_absgrad is not None, request.plan.sh_degree
        features = None if request.harmonics else values
        compositing = (lists, camera, settings, features, ctx.channels, recorded, gradients)
        if request.harmonics and len(lists.row_ranges) and v_surface is None and not absolute:
            replayed = backward_lanes.replay(*compositing)
            result, v_values, v_offsets = backward_lanes.differentiate(
                gaussians, camera, settings, replayed, degree, pose=pose, centres=ctx.needs_input_grad[6]
            )
        else:
            splats = backward.composite_backward(
                *compositing,
                len(means),
                absolute=absolute,
                schedule=request.schedule,
                deterministic=request.deterministic,
            )
            result = backward.project_backward(gaussians, camera, settings, splats, pose=pose)
            v_values, v_offsets = splats.features, None
            if request.harmonics:
                v_values, v_offsets = backward.shade_backward(
                    gaussians, camera, splats, result.means, degree, pose=pose
                )
            if request.receives_absgrad is not None:
                _accumulate(request.receives_absgrad, splats.absolute)
        v_world_to_camera = (
            backward.pose_gradient(camera, result.poses, v_offsets).to(world_to_camera) if pose else None
        )
        return (
            result.means,
            result.quats,
            result.scales,
            result.opacities,
            v_values,
            v_world_to_camera,
            result.means2d if ctx.needs_input_grad[6] else None,
            None,
        )


def _gaussians(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, values: Tensor, request: _Request
) -> Gaussians:
    sh = values if request.harmonics else means.new_zeros(len(means), 1, 3)
    return Gaussians.unchecked(*(t.detach() for t in (means, quats, scales, opacities, sh)))


def _accumulate(tensor: Tensor, absolute: Tensor | None) -> None:
    """Add to `tensor.absgrad`, as autograd adds to `tensor.grad`."""
    before = getattr(tensor, "absgrad", None)
    tensor.absgrad = absolute if before is None or absolute is None else before + absolute  # type: ignore[attr-defined]
