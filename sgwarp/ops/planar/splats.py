"""Compositing of splats that are already in the image plane: differentiable, however they got there.

The rasterizer goes from Gaussians to pixels in one piece. Here is its second half alone, on plain tensors: for other
camera models, for covariances, for callers that hold projected splats or even tile lists of their own.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import torch
import warp as wp
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.kernels import binning
from sgwarp.kernels.binning_lanes import PATCH
from sgwarp.kernels.gaussian import LEVEL_SLACK
from sgwarp.kernels.projection.forward import TRANSPARENT
from sgwarp.ops.arguments import view
from sgwarp.ops.launcher import launch
from sgwarp.ops.planar.projection import FACTOR_UNIT
from sgwarp.ops.splatting import backward, tiles
from sgwarp.ops.splatting.forward import composite, composite_recorded
from sgwarp.ops.splatting.gradients import ImageGradients, gradient_of_alpha
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.scene import Camera

TILE = binning.TILE
DEPTH_WORD = 6  # of the floats of a `Splat`
HIDDEN_LEVEL = -1.0e4  # log2 of an opacity that reaches no pixel


@dataclass(frozen=True, eq=False)
class ListedSplats:
    """Tile lists of splats given from outside: the splats of each 16 x 16 tile, front to back.

    Attributes:
        listed: Row of the splat, tile by tile, int32 [n].
        offsets: First entry of each tile and the end, int32 [tiles + 1].
    """

    listed: Tensor
    offsets: Tensor


@dataclass(eq=False)
class SplatJob:
    """Options of a compositing call, and the statistics it returns.

    Attributes:
        width, height: Of the image [pixels].
        settings: The rasterizer's approximations; `dilation` and `antialiased` were the projection's affair.
        given: Tile lists to follow; None makes exact ones, in the order (depth, row).
        wants_depth: Also composite the splats' depths.
        receive_absolute: Called by the backward pass with the sum over pixels of the magnitude of each one's gradient
            of the centre, float32 [V, 2] (AbsGS); None leaves it out.
        lists: The tile lists that were made, once composited; scratch unless a gradient was asked for.
    """

    width: int
    height: int
    settings: RasterSettings = field(default_factory=RasterSettings)
    given: ListedSplats | None = None
    wants_depth: bool = False
    receive_absolute: Callable[[Tensor], None] | None = None
    lists: tiles.TileLists | None = None


def factors_from_conics(conics: Tensor) -> Tensor:
    """(a, b, c) with 2^-(u^2 + v^2) = exp(-power), u = a dx + b dy, v = c dy, of conics (A, B, C); float64 [V, 3].

    Zero, which hides the splat, where the conic is not positive definite.
    """
    conics = conics.to(torch.float64)
    A, B, C = conics.detach().unbind(-1)
    proper = ((A > 0) & (A * C - B * B > 0) & torch.isfinite(A + C))[:, None]
    A, B, C = torch.where(proper, conics, conics.new_tensor([1.0, 0.0, 1.0])).unbind(-1)
    root = A.sqrt()
    factors = FACTOR_UNIT * torch.stack([root, B / root, (C - B * B / A).sqrt()], dim=-1)
    return torch.where(proper, factors, 0.0)


def listed_rows(lists: tiles.TileLists) -> Tensor:
    """Row of the splat at every place of the lists, tile by tile, front to back, int32 [n]."""
    return lists.order[lists.listed]


def composite_splats(
    means2d: Tensor,
    factors: Tensor,
    opacities: Tensor,
    features: Tensor,
    depths: Tensor,
    job: SplatJob,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Composite splats front to back (paper eq. 1), with gradients to every tensor.

    Splats that are not finite or fainter than `alpha_min` are left out and get gradients of zero.

    Args:
        means2d: Centres [pixels], [V, 2].
        factors: (a, b, c) of the footprint 2^-(u^2 + v^2), u = a dx + b dy, v = c dy, [V, 3].
        opacities: [V].
        features: [V, C].
        depths: Along the viewing direction [m], [V]; they order the splats, unless lists are given.
        job: The rest.

    Returns:
        sum of alpha T features, float32 [H, W, C]; remaining transmittance and accumulated opacity,
        float32 [H, W]; and sum of alpha T depth, float32 [H, W], or empty unless asked for.
    """
    return _CompositeSplats.apply(means2d, factors, opacities, features, depths, job)


class _CompositeSplats(torch.autograd.Function):
    """Bin and composite; the backward pass replays the tile lists, which are kept until then."""

    @staticmethod
    def forward(
        ctx: Any,
        means2d: Tensor,
        factors: Tensor,
        opacities: Tensor,
        features: Tensor,
        depths: Tensor,
        job: SplatJob,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        keep = any(ctx.needs_input_grad)
        camera, settings = _frame(job.width, job.height), job.settings
        values, finite = _finite_rows(features)
        projected = _as_splats(means2d, factors, opacities, depths, finite, settings)
        if job.given is not None:
            lists = _follow(job.given, projected, values, camera)
        else:
            order = tiles.depth_order(projected, keep=keep)
            colors = _padded(values[order.to(torch.int64)]) if values.shape[1] <= 3 else None
            lists = tiles.bin_splats(projected, order, colors, camera, places=keep, rows=keep, keep=keep)
        job.lists = lists
        if not keep:
            image, transmittance, alpha, depth_sum, _ = composite(lists, camera, settings, values, job.wants_depth)
            return image, transmittance, alpha, depth_sum
        image, transmittance, alpha, depth_sum, _, last, hit = composite_recorded(
            lists, camera, settings, values, job.wants_depth
        )
        recorded = (transmittance, last, hit)
        ctx.save_for_backward(means2d, factors, opacities, features, depths, *recorded, *vars(lists).values())
        ctx.job = job
        ctx.set_materialize_grads(False)
        return image, transmittance, alpha, depth_sum

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(
        ctx: Any,
        v_image: Tensor | None,
        v_transmittance: Tensor | None,
        v_alpha: Tensor | None,
        v_depth_sum: Tensor | None,
    ) -> tuple[Tensor | None, ...]:
        job: SplatJob = ctx.job
        means2d, factors, opacities, features, depths, *kept = ctx.saved_tensors
        splats = backward.composite_backward(
            tiles.TileLists(*kept[3:]),
            _frame(job.width, job.height),
            job.settings,
            _finite_rows(features)[0],
            features.shape[1],
            (kept[0], kept[1], kept[2]),
            ImageGradients(
                v_image, gradient_of_alpha(v_alpha, v_transmittance), v_depth_sum if job.wants_depth else None
            ),
            len(means2d),
            absolute=job.receive_absolute is not None,
        )
        if job.receive_absolute is not None and splats.absolute is not None:
            job.receive_absolute(splats.absolute)
        v_depths = splats.sums[:, splats.at_depth].to(depths) if splats.at_depth >= 0 else None
        v_means2d, v_factors, v_opacities = _splat_gradients(splats.sums, factors, opacities)
        features_grad = splats.features.to(features) if ctx.needs_input_grad[3] else None
        return v_means2d.to(means2d), v_factors.to(factors), v_opacities.to(opacities), features_grad, v_depths, None


def _splat_gradients(sums: Tensor, factors: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of centres, factors and opacities from the moments of g = dL/d ln(alpha), in float64.

    The moments are those under 1, u, v, u^2, u v, v^2. Large terms of a needle's factors cancel further down the chain,
    which float32 would not survive.
    """
    seen = (sums[:, :6] != 0).any(dim=1)
    g, gu, gv, guu, guv, gvv = sums[:, :6].to(torch.float64).unbind(1)
    a, b, c = torch.where(seen[:, None], factors, 1.0).to(torch.float64).unbind(1)
    twice = 2.0 * math.log(2.0)
    v_means2d = twice * torch.stack([a * gu, b * gu + c * gv], dim=1)
    v_factors = -twice * torch.stack([(guu - b / c * guv) / a, guv / c, gvv / c], dim=1)
    return v_means2d, v_factors, g / torch.where(seen, opacities, 1.0).to(torch.float64)


@lru_cache(maxsize=32)
def _frame(width: int, height: int) -> Camera:
    """An image's size in the form that binning and compositing read it."""
    return Camera(torch.eye(3, device="cpu"), torch.eye(4, device="cpu"), width, height)


def _padded(values: Tensor) -> Tensor:
    """Up to three channels as the three that travel with the splats."""
    return torch.nn.functional.pad(values, (0, 3 - values.shape[1])).contiguous()


def _finite_rows(features: Tensor) -> tuple[Tensor, Tensor | None]:
    """Features as the kernels read them, float32 [V, C], and the rows without NaN or infinity, bool [V] or None for
    all; the others are zero, for they would reach pixels far from their splat, as zero times infinity."""
    values = features.detach().to(torch.float32).contiguous()
    # On CUDA it is cheaper to look at all rows than to wait for the answer.
    if not values.is_cuda and bool(torch.isfinite(values.sum(dtype=torch.float64))):
        return values, None
    finite = torch.isfinite(values.sum(dim=1, dtype=torch.float64))
    return torch.where(finite[:, None], values, 0.0), finite


def _as_splats(
    means2d: Tensor,
    factors: Tensor,
    opacities: Tensor,
    depths: Tensor,
    finite: Tensor | None,
    settings: RasterSettings,
) -> tiles.Projected:
    """The tensors in the layout of the kernels' `Splat`, with the footprint's extent and whether it can be seen."""
    device = means2d.device
    with torch.no_grad():
        level = opacities.to(torch.float32).log2()
        reach = level - math.log2(settings.alpha_min) + LEVEL_SLACK
        a, b, c = factors.unbind(1)
        radius, steepness = reach.clamp(min=0.0).sqrt(), (b * b + c * c).sqrt()
        half_width, half_height = radius * steepness / (a * c), radius / c
        footprint = [half_width, half_height, reach, -b * radius / steepness / c, 1.0 / steepness]
        columns = [*means2d.unbind(1), a, b, c, level, depths, *footprint]
        values = torch.stack([t.to(torch.float32) for t in columns], dim=1)
        seen = torch.isfinite(values.sum(1)) & (reach >= LEVEL_SLACK) & (a > 0) & (c > 0)
        seen = seen if finite is None else seen & finite
        hidden = values.new_tensor([0.0, 0.0, 1.0, 0.0, 1.0, HIDDEN_LEVEL, 0.0, 0.0, 0.0, HIDDEN_LEVEL, 0.0, 1.0])
        memory = tiles.splat_memory(len(values), device, "composited splats")
        rows = memory.view(torch.float32).view(-1, tiles.SPLAT_WORDS)
        rows[:, : values.shape[1]] = torch.where(seen[:, None], values, hidden)
    status = torch.where(seen, 0, int(TRANSPARENT)).to(torch.uint8)
    return tiles.Projected(tiles.view_splats(memory), status, rows[:, DEPTH_WORD].contiguous())


def _follow(given: ListedSplats, projected: tiles.Projected, values: Tensor, camera: Camera) -> tiles.TileLists:
    """Tile lists that somebody else made; the splats keep the order they were given in."""
    device, count, n = values.device, len(projected.status), len(given.listed)
    grid = -(-camera.width // TILE) * -(-camera.height // TILE)
    if len(given.offsets) != grid + 1:
        size = f"{camera.width} x {camera.height}"
        got = len(given.offsets) - 1
        raise InputError(f"tile lists: expected {grid} tiles of 16 x 16 for an image of {size}, got {got}")
    order = torch.arange(count, dtype=torch.int32, device=device)
    colors = _padded(values) if values.shape[1] <= 3 else torch.empty(0, 3, device=device)
    memory = tiles.splat_memory(count, device, None)
    ordered = tiles.view_splats(memory)
    inputs = [view(order, wp.int32), projected.splats, view(colors, wp.vec3)]
    launch(binning.order_splats, count, inputs, [ordered], device=device)
    listed = given.listed.to(torch.int32).contiguous()
    places = listed.argsort(stable=True)
    entries = torch.zeros(count + 1, dtype=torch.int32, device=device)
    entries[1:] = torch.bincount(listed, minlength=count).cumsum(0)
    owners = torch.repeat_interleave(
        torch.arange(grid, dtype=torch.int32, device=device), given.offsets.diff(), output_size=n
    )
    offsets = given.offsets.to(torch.int32).contiguous()
    row_places, ranges = _rows_of_sums(listed, owners, count, -(-camera.width // TILE))
    return tiles.TileLists(
        order, memory, offsets, listed, entries, places.to(torch.int32), owners[places], row_places, ranges
    )


def _rows_of_sums(listed: Tensor, owners: Tensor, count: int, columns: int) -> tuple[Tensor, Tensor]:
    """`row_places` and `row_ranges` of lists: a row for each patch of the rectangle that a splat's tiles span.

    Args:
        listed: Splat of each place, int32 [I].
        owners: Tile of each place, int32 [I].
        count: How many splats there are.
        columns: Of tiles in the image.
    """
    splats = listed.to(torch.int64)
    spans = []
    for patch in (owners // columns // PATCH, owners % columns // PATCH):
        first = torch.full((count,), columns + 2**20, dtype=torch.int32, device=listed.device)
        last = torch.full_like(first, -1)
        first.scatter_reduce_(0, splats, patch, "amin")
        last.scatter_reduce_(0, splats, patch, "amax")
        spans.append((first.where(last >= 0, 0), (last - first + 1).where(last >= 0, 0)))
    (above, down), (left, across) = spans
    rows = down * across
    ends = rows.cumsum(0, dtype=torch.int32)
    starts = torch.nn.functional.pad(ends, (1, 0))
    places = torch.stack([starts[:-1] - above * across - left, across], dim=1)
    return places, torch.stack([starts, torch.nn.functional.pad(rows, (0, 1))], dim=1)
