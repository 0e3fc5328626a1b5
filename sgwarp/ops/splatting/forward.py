"""Rendering a view: colours or any number of feature channels, alpha and depth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.kernels.compositing import block as compositing_block
from sgwarp.kernels.compositing import lanes as compositing_lanes
from sgwarp.kernels.compositing import lanes_features as compositing_lanes_features
from sgwarp.kernels.native import BATCH, Seen
from sgwarp.kernels.transmittance import Lanes
from sgwarp.ops.arguments import view, view_structs
from sgwarp.ops.launcher import get_threads, launch, launch_blocks
from sgwarp.ops.memory import fresh, scratch
from sgwarp.ops.splatting import tiles
from sgwarp.ops.splatting.loading import WIDE_PASS, load_rendering, load_wide_rendering
from sgwarp.ops.splatting.plan import RenderPlan, Values, plan_render
from sgwarp.ops.splatting.room import ListRoom
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.scene import Camera, Gaussians
from sgwarp.scene.checks import require_finite

LANE = 16


@dataclass(frozen=True, eq=False)
class Rendering:
    """Images of one rendering.

    Attributes:
        features: sum of alpha T x plus the background, float32 [H, W, C].
        alpha: Accumulated opacity 1 - T, float32 [H, W].
        expected_depth: Mean z weighted by alpha T [m], 0 where nothing is, float32 [H, W]; None if not asked for.
        depth: z of the Gaussian at which accumulated opacity passes `surface_opacity` [m], 0 = no hit, float32 [H, W];
            None if not asked for.
        status_counts: How many Gaussians had each status of kernels/projection.py, int64.
    """

    features: Tensor
    alpha: Tensor
    expected_depth: Tensor | None
    depth: Tensor | None
    status_counts: Tensor

    @property
    def culled(self) -> dict[str, int]:
        """Gaussians left out, by reason; reading it waits for the device."""
        return tiles.culled(self.status_counts)


def rasterize(
    gaussians: Gaussians,
    camera: Camera,
    features: Tensor | None = None,
    *,
    background: Tensor | None = None,
    expected_depth: bool = False,
    depth: bool = False,
    settings: RasterSettings = RasterSettings(),  # noqa: B008 - frozen
    plan: RenderPlan | None = None,
    look: bool = True,
    room: ListRoom | None = None,
) -> Rendering:
    """Render a view (paper eq. 1): project, order by (depth, index), list per tile, composite front to back.

    Args:
        gaussians: The scene; Gaussians that are not finite, transparent, out of range or off screen are left out.
        camera: Where to look from.
        features: float32 [N, C], composited in place of the spherical-harmonic colours.
        background: float32 [C], seen through what is left transparent; None is zero.
        expected_depth, depth: Which depths to render; without them nothing is computed for them.
        settings: The approximations.
        plan: What to compute, and what not; derived from the scene and the request if None.
        look: Look which harmonics the scene uses, where the plan is derived; on CUDA that waits, once per scene.
        room: For the tile lists: with it nobody waits for their length on CUDA.

    Raises:
        InputError: `features` or `background` do not fit.
    """
    n = len(gaussians)
    if features is not None:
        ok = features.ndim == 2 and len(features) == n and features.shape[1] > 0 and features.is_floating_point()
        if not ok:
            raise InputError(f"features: expected floating point [{n}, C], got {features.dtype} {list(features.shape)}")
        require_finite_features(features)
    channels = 3 if features is None else features.shape[1]
    if background is not None and tuple(background.shape) != (channels,):
        raise InputError(f"background: expected shape [{channels}], got {list(background.shape)}")
    if background is not None:
        require_finite("background", background)

    if plan is None:
        values: Values = "colors" if features is None else "features"
        wants_depth = expected_depth or depth
        plan = plan_render(gaussians, values, channels=channels, depth=wants_depth, settings=settings, look=look)
    if channels <= 3:
        load_rendering(gaussians.device, harmonics=plan.values == "colors", depth=plan.depth)
    else:
        load_wide_rendering(gaussians.device, channels, depth=plan.depth)
    projected = tiles.project(gaussians, camera, settings, degree=plan.colored)
    tiles.leave_out_non_finite(projected, features)
    order = tiles.depth_order(projected)
    colors = packed_colors(gaussians, camera, features, order, plan)
    lists = tiles.bin_splats(projected, order, colors, camera, room=room)
    image, transmittance, alpha, depth_sum, surface = composite(lists, camera, settings, features, plan.depth)
    if background is not None:
        image = image + transmittance[..., None] * background.to(image)
    mean_depth = None
    if expected_depth:
        mean_depth = torch.where(alpha > 0, depth_sum / alpha.clamp(min=1e-12), 0.0)
    return Rendering(image, alpha, mean_depth, surface if depth else None, projected.counts())


def require_finite_features(features: Tensor) -> None:
    """Refuse NaN and infinity, on the CPU. On CUDA to look at the values is to wait for the device: there their
    Gaussians are left out (`tiles.leave_out_non_finite`).

    Raises:
        InputError: Some feature is not finite; it would reach pixels far from its Gaussian, as zero times infinity.
    """
    if not features.is_cuda and not bool(torch.isfinite(features.detach().sum(dtype=torch.float64))):
        rows = (~torch.isfinite(features.detach())).any(dim=1).nonzero().flatten()
        raise InputError(
            f"features: NaN or infinity in {len(rows)} rows, the first is {int(rows[0])}; mend or drop them"
        )


def packed_colors(
    gaussians: Gaussians, camera: Camera, features: Tensor | None, order: Tensor, plan: RenderPlan
) -> Tensor | None:
    """Colours by depth order, unless the projection gave them to the splats, as it does with harmonics on the CPU.

    Three channels travel with the splats; more are gathered while compositing.
    """
    if plan.values == "nothing":
        return None
    if features is None:
        return tiles.shade(gaussians, camera, order, plan.sh_degree) if order.is_cuda else None
    if features.shape[1] > 3:
        return None
    padded = torch.zeros(len(order), 3, dtype=torch.float32, device=gaussians.device)
    padded[:, : features.shape[1]] = features[order.to(torch.int64)]
    return padded


def composite(
    lists: tiles.TileLists,
    camera: Camera,
    settings: RasterSettings,
    features: Tensor | None,
    wants_depth: bool,
    schedule: str | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Composite tile lists: image [H, W, C], transmittance, alpha, depth sum and surface depth [H, W].

    `schedule` is "lanes" or "block", by default the device's own; either runs on the CPU.
    """
    nothing = torch.empty(0, 0, dtype=torch.int32, device=lists.order.device)
    return _composite(lists, camera, settings, features, wants_depth, schedule, nothing, nothing)


def composite_recorded(
    lists: tiles.TileLists,
    camera: Camera,
    settings: RasterSettings,
    features: Tensor | None,
    wants_depth: bool,
    schedule: str | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """`composite` and what its backward pass starts from, int32 [H, W] each.

    `last` is the last contributor, counted from the first of its tile; `hit` is the Gaussian that gave the
    surface depth, empty without `wants_depth`. Both are -1 where there is none.
    """
    device = lists.order.device
    last = torch.empty(camera.size, dtype=torch.int32, device=device)
    hit = torch.empty(camera.size if wants_depth else (0, 0), dtype=torch.int32, device=device)
    return (*_composite(lists, camera, settings, features, wants_depth, schedule, last, hit), last, hit)


def runs_in_blocks(device: torch.device, schedule: str | None) -> bool:
    """Whether the block schedule runs: the one asked for, by default the device's own."""
    return (schedule or ("block" if device.type == "cuda" else "lanes")) == "block"


def _composite(
    lists: tiles.TileLists,
    camera: Camera,
    settings: RasterSettings,
    features: Tensor | None,
    wants_depth: bool,
    schedule: str | None,
    last: Tensor,
    hit: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    device = lists.order.device
    block = runs_in_blocks(device, schedule)
    height, width = camera.size
    transmittance, alpha = torch.empty(height, width, device=device), torch.empty(height, width, device=device)
    wide = features is not None and features.shape[1] > 3
    depth_shape = (height, width) if wants_depth else (0, 0)
    depth_sum, surface = torch.empty(depth_shape, device=device), torch.empty(depth_shape, device=device)
    image = None
    if wide:
        assert features is not None
        image = _composite_wide(lists, camera, settings, features, transmittance, alpha, last, block)
    if not wide or wants_depth:
        colors = torch.empty(height, width, 3, device=device)
        inputs = [*lists.arrays(), tiles.knobs(settings), width, height]
        outputs = [view(colors, wp.vec3), *(view(t, wp.float32) for t in (transmittance, alpha, depth_sum, surface))]
        outputs += [view(last, wp.int32), view(hit, wp.int32)]
        record = len(last) > 0
        if block:
            kernel = compositing_block.make_composite_colors_block(wants_depth, record)
            launch_blocks(kernel, [lists.tile_count], inputs, outputs, device=device)
        else:
            state = lane_scratch("state", TILE_ROWS, compositing_lanes.color_planes(wants_depth, record), device)
            kernel = compositing_lanes.make_composite_colors(wants_depth, record)
            launch(
                kernel, lists.tile_count, [*inputs, state, *batch_scratch(device)], outputs, device=device, slots=True
            )
        if image is None:
            image = colors if features is None else colors[..., : features.shape[1]]
    assert image is not None
    return image, transmittance, alpha, depth_sum, surface


TILE_ROWS = 16


def lane_scratch(name: str, rows: int, planes: int, device: torch.device) -> Any:
    """Scratch vectors [threads, rows, planes] of the lane schedule."""
    shape = (get_threads(), rows, planes, LANE)
    memory = scratch(f"lanes {name}", get_threads() * rows * planes * LANE, torch.float32, device)
    return view(memory.view(shape), Lanes)


def batch_scratch(device: torch.device) -> list[Any]:
    """Scratch of the lane schedule for a batch of fragments and the rows they reach."""
    threads, batch = get_threads(), int(BATCH)
    size = wp.types.type_size_in_bytes(Seen)
    memory = scratch("lanes batch", threads * batch * size // 4, torch.int32, device)
    reached = scratch("lanes reached", threads * TILE_ROWS, torch.int32, device).view(threads, TILE_ROWS)
    return [view_structs(memory, Seen, threads, batch), view(reached, wp.int32)]


def in_slices(features: Tensor) -> Tensor:
    """Channels padded with zeros to a multiple of 16, float32 [..., S, 16]; no copy if there is nothing to do."""
    channels = features.shape[-1]
    padded = -(-channels // LANE) * LANE
    features = features.detach().to(torch.float32)
    if padded != channels:
        features = torch.nn.functional.pad(features, (0, padded - channels))
    return features.contiguous().unflatten(-1, (padded // LANE, LANE))


def _composite_wide(
    lists: tiles.TileLists,
    camera: Camera,
    settings: RasterSettings,
    features: Tensor,
    transmittance: Tensor,
    alpha: Tensor,
    last: Tensor,
    block: bool,
) -> Tensor:
    device = lists.order.device
    height, width = camera.size
    image = fresh(height, width, features.shape[1], device=device)
    slices = in_slices(features)
    count = slices.shape[1]
    tail = [tiles.knobs(settings), width, height]
    outputs = [view(t, wp.float32) for t in (image, transmittance, alpha)] + [view(last, wp.int32)]
    record = len(last) > 0
    if block:
        kernel = compositing_block.make_composite_features_block(record)
        inputs = [*lists.arrays(), view(slices, Lanes), *tail]
        launch_blocks(kernel, [lists.tile_count, count], inputs, outputs, device=device)
        return image
    first = 0
    while first < count:
        width_of_pass = WIDE_PASS if count - first >= WIDE_PASS else 1
        kernel = compositing_lanes_features.make_composite_features(width_of_pass, record)
        state = lane_scratch("state", TILE_ROWS, 1 + LANE * width_of_pass + record, device)
        scratches = [state, *batch_scratch(device)]
        inputs = [*lists.arrays(), view(slices.unsqueeze(2), Lanes), first, *tail, *scratches]
        launch(kernel, lists.tile_count, inputs, outputs, device=device, slots=True)
        first += width_of_pass
    return image
