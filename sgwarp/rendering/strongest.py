"""Features rendered from the strongest contributors of each pixel alone."""

from __future__ import annotations

import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.ops.splatting.contributors import top_contributors
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.runs.isolation import isolated
from sgwarp.scene import Camera, Gaussians


@isolated
def render_strongest(
    gaussians: Gaussians,
    camera: Camera,
    features: Tensor,
    k: int = 16,
    *,
    settings: RasterSettings | None = None,
) -> Tensor:
    """Sum of alpha T x over the k largest alpha T of each pixel, float32 [H, W, C], with gradients to `features`.

    The idea of Quantile Rendering (arXiv 2512.20927): which Gaussians a pixel shows is found once, and C channels then
    cost k products a pixel. What is left out is the weight of the others, so the error is at most that times the
    largest feature; with k at least the number of contributors it is the full rendering.

    Args:
        gaussians: The scene.
        camera: Where it is seen from.
        features: One row per Gaussian, float32 [N, C].
        k: Contributors of a pixel, 1 or more.
        settings: Thresholds of the rasterizer.

    Raises:
        InputError: `features` do not fit the scene, or `k` is no positive integer.
    """
    if features.ndim != 2 or len(features) != len(gaussians) or not features.is_floating_point():
        raise InputError(f"features: expected floating point [{len(gaussians)}, C], got {list(features.shape)}")
    ids, weights = top_contributors(gaussians, camera, k, settings or RasterSettings())
    rows = ids.flatten(0, 1).clamp(min=0).to(torch.int64)  # empty places have weight 0
    rendered = torch.nn.functional.embedding_bag(
        rows, features, mode="sum", per_sample_weights=weights.flatten(0, 1).to(features.dtype)
    )
    return rendered.view(*camera.size, features.shape[1])
