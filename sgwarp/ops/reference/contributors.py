"""The float64 oracle of the strongest contributors of a pixel: every weight is computed, then all are sorted."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sgwarp.ops.reference.rasterizer import ReferenceSettings, blend_blocks, project_scene
from sgwarp.scene import Camera, Gaussians


@dataclass(frozen=True, eq=False)
class Ranking:
    """The k largest weights of each pixel.

    Attributes:
        ids: Gaussians by descending weight, then front to back; -1 where there are no more, int64 [H, W, k].
        weights: Their alpha T, 0 where there are no more, float64 [H, W, k].
        contributors: How many Gaussians have a weight, int64 [H, W].
        margin, order_margin: As in `reference.Raster`, [H, W].
        gap: Smallest relative distance of two neighbours among the k + 1 largest weights, [H, W].
    """

    ids: Tensor
    weights: Tensor
    contributors: Tensor
    margin: Tensor
    order_margin: Tensor
    gap: Tensor


def top_contributors(
    gaussians: Gaussians, camera: Camera, k: int, settings: ReferenceSettings | None = None
) -> Ranking:
    """Rank the entries alpha T of each row of A (paper eq. 1)."""
    settings = settings or ReferenceSettings()
    projection = project_scene(gaussians, camera, settings)
    ids = torch.full((camera.height * camera.width, k), -1)
    weights = torch.zeros(len(ids), k, dtype=torch.float64)
    contributors = torch.zeros(len(ids), dtype=torch.int64)
    margin, order_margin, gap = (torch.full((len(ids),), torch.inf, dtype=torch.float64) for _ in range(3))
    for blend in blend_blocks(projection, camera.width, camera.height, settings):
        at, kept = blend.pixels, min(k, len(blend.rows))
        sorted_weights, columns = blend.weights.sort(dim=1, descending=True, stable=True)  # columns are front to back
        best = sorted_weights[:, :kept]
        owners = projection.index[blend.rows][columns[:, :kept]]
        weights[at, :kept] = best
        ids[at, :kept] = torch.where(best > 0, owners, -1)
        contributors[at] = (blend.weights > 0).sum(dim=1)
        margin[at], order_margin[at] = blend.margin, blend.order_margin
        first, second = sorted_weights[:, : k + 1][:, :-1], sorted_weights[:, 1 : k + 1]
        distance = torch.where(first > 0, (first - second) / first, torch.inf)
        gap[at] = torch.cat([distance, distance.new_full((len(at), 1), torch.inf)], dim=1).amin(dim=1)
    images = (t.unflatten(0, camera.size) for t in (ids, weights, contributors, margin, order_margin, gap))
    return Ranking(*images)
