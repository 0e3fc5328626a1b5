"""The float64 oracle of lifting: from a feature image to one feature per Gaussian, in plain torch."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sgwarp.ops.reference.rasterizer import Projection, ReferenceSettings, blend_blocks, composite, project_scene
from sgwarp.scene import Camera, Gaussians


@dataclass(frozen=True, eq=False)
class Lifted:
    """Sums over the pixels of one view, float64.

    Attributes:
        features: Sum of weight times feature, [N, C].
        weight: Sum of the weights, [N].
        margin: How near the decision on a Gaussian is to turning by rounding, [N]. Centre mode only, else None:
            the smallest of the distance of the centre to the edge of its pixel [pixels], the relative distance of the
            depth test to its bound, and the margins of the pixel it reads.
    """

    features: Tensor
    weight: Tensor
    margin: Tensor | None = None


def transpose_composite(
    projection: Projection,
    count: int,
    image: Tensor,
    valid: Tensor | None = None,
    settings: ReferenceSettings | None = None,
) -> Lifted:
    """The exact transpose of `composite` over a black background.

    Args:
        count: Number N of Gaussians in the scene.
        image: Features of the pixels, [H, W, C].
        valid: Pixels that carry a feature, bool [H, W]; all by default.
    """
    settings = settings or ReferenceSettings()
    height, width, channels = image.shape
    valid = torch.ones(height, width, dtype=torch.bool) if valid is None else valid
    flat, valid = image.reshape(-1, channels), valid.reshape(-1)
    features = torch.zeros(count, channels, dtype=torch.float64)
    weight = torch.zeros(count, dtype=torch.float64)
    for blend in blend_blocks(projection, width, height, settings):
        weights = blend.weights * valid[blend.pixels, None]
        rows = projection.index[blend.rows]
        features = features.index_add(0, rows, weights.T @ flat[blend.pixels])
        weight = weight.index_add(0, rows, weights.sum(dim=0))
    return Lifted(features, weight)


def lift_weighted(
    gaussians: Gaussians,
    camera: Camera,
    image: Tensor,
    valid: Tensor | None = None,
    settings: ReferenceSettings | None = None,
) -> Lifted:
    """Add up alpha T f(pixel) and alpha T over the pixels of `image` [H, W, C], for every Gaussian."""
    projection = project_scene(gaussians, camera, settings)
    return transpose_composite(projection, len(gaussians), image.double(), valid, settings)


def lift_center(
    gaussians: Gaussians,
    camera: Camera,
    image: Tensor,
    valid: Tensor | None = None,
    tau: float = 0.05,
    border: int = 10,
    settings: ReferenceSettings | None = None,
) -> Lifted:
    """Give each visible Gaussian the feature of the pixel that holds its projected centre, with weight 1.

    Args:
        image: Features of the pixels, [H, W, C].
        valid: Pixels that carry a feature, bool [H, W]; all by default.
        tau: A Gaussian at depth z is visible if |d - z| <= tau d, with d the depth of the surface at its pixel.
        border: Gaussians whose pixel is nearer than this to the edge of the image are left out [pixels].
    """
    projection = project_scene(gaussians, camera, settings)
    height, width = camera.size
    nothing = torch.zeros(len(gaussians), 0, dtype=torch.float64)
    raster = composite(projection, nothing, width, height, settings=settings)

    column, row = projection.mean2d.floor().long().unbind(1)
    inside = (column >= border) & (column < width - border) & (row >= border) & (row < height - border)
    pixel = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
    surface = raster.depth.flatten()[pixel]
    difference = (surface - projection.depth).abs()
    visible = inside & (surface > 0) & (difference <= tau * surface)
    if valid is not None:
        visible &= valid.flatten()[pixel]

    features = torch.zeros(len(gaussians), image.shape[2], dtype=torch.float64)
    weight = torch.zeros(len(gaussians), dtype=torch.float64)
    index = projection.index[visible]
    features[index] = image.double().flatten(0, 1)[pixel[visible]]
    weight[index] = 1.0

    fraction = projection.mean2d - projection.mean2d.floor()
    to_edge = torch.minimum(fraction, 1 - fraction).amin(dim=1)
    to_bound = torch.where(surface > 0, (difference / (tau * surface) - 1).abs(), torch.inf)
    at_pixel = torch.stack([raster.margin, raster.order_margin, raster.surface_margin]).amin(dim=0).flatten()[pixel]
    margin = torch.full((len(gaussians),), torch.inf, dtype=torch.float64)
    margin[projection.index] = torch.stack([to_edge, to_bound, at_pixel]).amin(dim=0)
    return Lifted(features, weight, margin)
