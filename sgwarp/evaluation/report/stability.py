"""The renderer at the extremes, against the float64 oracle: images and gradients, in either schedule."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from sgwarp.evaluation.report.extremes import Extreme
from sgwarp.evaluation.report.oracle import decidable
from sgwarp.ops.reference import rasterizer as reference
from sgwarp.ops.splatting import tiles
from sgwarp.ops.splatting.autograd import rasterize
from sgwarp.ops.splatting.forward import composite, packed_colors
from sgwarp.ops.splatting.plan import plan_render
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.scene import Camera, Gaussians

Schedule = Literal["lanes", "block"]

FIELDS = ("means", "quats", "scales", "opacities", "sh")
POSE = ("rotation", "translation")


@dataclass(frozen=True)
class ImageResult:
    """One extreme scene rendered.

    Attributes:
        finite: Whether every pixel of colour, opacity and both depths is finite.
        error: Largest error of colour and opacity outside the undecidable pixels; NaN if there are no others.
        depth_error: The same of the expected depth, relative to it where that is more than 1 m.
        undecidable: Share of the pixels that float32 cannot decide, see `sgwarp.evaluation.report.oracle.decidable`.
        culled: Gaussians left out, by reason.
        seconds: Of rendering, compilation not included.
    """

    finite: bool
    error: float
    depth_error: float
    undecidable: float
    culled: dict[str, int]
    seconds: float


@dataclass(frozen=True)
class GradientResult:
    """Gradients of one extreme scene.

    Attributes:
        finite: Whether every entry is finite.
        errors: Largest error of each field's gradient, and of the pose's two parts, relative to the largest entry of
            the oracle's. The rotation is that about the camera's centre: about the world's origin, 100 km away, it
            would be little but the translation once more.
    """

    finite: bool
    errors: dict[str, float]

    @property
    def error(self) -> float:
        """The largest of them."""
        return float(torch.tensor(list(self.errors.values())).max())  # NaN, if there is one


def check(extreme: Extreme, schedule: Schedule = "lanes", device: torch.device | str = "cpu") -> ImageResult:
    """Render an extreme scene on a device and compare it with the oracle."""
    gaussians, camera = extreme.build()
    there = gaussians.to(device)
    _render(there, camera, schedule)  # compiles
    start = time.perf_counter()
    image, alpha, mean_depth, surface, culled = _render(there, camera, schedule)
    seconds = time.perf_counter() - start
    expected = reference.rasterize(gaussians, camera)
    decided = decidable(expected)
    color_error = (image - expected.features).abs().amax(dim=2)
    error = torch.maximum(color_error, (alpha - expected.alpha).abs())
    depth_error = (mean_depth - expected.expected_depth).abs() / expected.expected_depth.clamp(min=1.0)
    return ImageResult(
        finite=all(bool(torch.isfinite(t).all()) for t in (image, alpha, mean_depth, surface)),
        error=_largest(error[decided]),
        depth_error=_largest(depth_error[decided]),
        undecidable=1.0 - float(decided.double().mean()),
        culled=culled,
        seconds=seconds,
    )


def check_gradients(
    extreme: Extreme, schedule: Schedule = "lanes", device: torch.device | str = "cpu"
) -> GradientResult:
    """Backpropagate random weights on the decidable pixels, and compare with float64 autograd of the oracle."""
    gaussians, camera = extreme.build()
    kept = gaussians.finite
    theirs = {name: getattr(gaussians, name)[kept].double().requires_grad_() for name in FIELDS}
    their_pose, my_pose = (camera.world_to_camera.clone().requires_grad_() for _ in range(2))
    expected = _reference(theirs, their_pose, camera)
    rng = torch.Generator().manual_seed(0)
    weights = torch.randn(*camera.size, 4, generator=rng) * decidable(expected)[..., None]
    (torch.cat([expected.features, expected.alpha[..., None]], dim=2) * weights).sum().backward()
    mine = {name: getattr(gaussians, name).to(device).clone().requires_grad_() for name in FIELDS}
    got = rasterize(
        mine["means"],
        mine["quats"],
        mine["scales"],
        mine["opacities"],
        my_pose,
        camera.K,
        camera.width,
        camera.height,
        sh=mine["sh"],
        near=camera.near,
        far=camera.far,
        schedule=schedule,
    )
    (torch.cat([got.features, got.alpha[..., None]], dim=2) * weights.to(device)).sum().backward()
    got_pose, wanted_pose = _pose_parts(my_pose, camera), _pose_parts(their_pose, camera)
    errors = {part: _relative(got_pose[part] - wanted_pose[part], wanted_pose[part]) for part in POSE}
    finite = all(bool(torch.isfinite(part).all()) for part in got_pose.values())
    for name in FIELDS:
        grad, wanted = mine[name].grad, theirs[name].grad
        assert grad is not None
        grad = grad.cpu()
        assert wanted is not None
        finite &= bool(torch.isfinite(grad).all())
        error = torch.cat([(grad[kept] - wanted).flatten(), grad[~kept].double().flatten()])
        errors[name] = _relative(error, wanted)
    return GradientResult(finite, errors)


def _render(
    gaussians: Gaussians, camera: Camera, schedule: Schedule
) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, int]]:
    """Colour, opacity, expected and surface depth on the CPU, and what was culled; `rasterize` in a given schedule."""
    settings = RasterSettings()
    plan = plan_render(gaussians, look=False)
    projected = tiles.project(gaussians, camera, settings, degree=plan.colored)
    order = tiles.depth_order(projected)
    lists = tiles.bin_splats(projected, order, packed_colors(gaussians, camera, None, order, plan), camera)
    image, _, alpha, depth_sum, surface = composite(lists, camera, settings, None, True, schedule)
    image, alpha, depth_sum, surface = (t.cpu() for t in (image, alpha, depth_sum, surface))
    return image, alpha, depth_sum / alpha.clamp(min=1e-12), surface, tiles.culled(projected.counts())


def _reference(fields: dict[str, Tensor], pose: Tensor, camera: Camera) -> reference.Raster:
    """The oracle on tensors that want gradients."""
    width, height = camera.width, camera.height
    means, quats, scales, opacities = (fields[name] for name in FIELDS[:4])
    projection = reference.project(
        means, quats, scales, opacities, pose, camera.K, width, height, camera.near, camera.far
    )
    colors = reference.spherical_harmonics(fields["means"], fields["sh"], pose)
    return reference.composite(projection, colors, width, height)


def _pose_parts(pose: Tensor, camera: Camera) -> dict[str, Tensor]:
    """Gradient of the rotation about the camera's centre, [3, 3], and of the translation, [3]."""
    assert pose.grad is not None
    translation = pose.grad[:3, 3]
    # p = R m + t = R (m - center) + (R center + t), and m - center is what a turn about the camera acts on.
    return {"rotation": pose.grad[:3, :3] - torch.outer(translation, camera.position), "translation": translation}


def _relative(error: Tensor, wanted: Tensor) -> float:
    """Largest error over the largest of what was wanted."""
    return _largest(error.abs()) / max(_largest(wanted.abs()), 1e-30)


def _largest(values: Tensor) -> float:
    return float(values.max()) if values.numel() else float("nan")
