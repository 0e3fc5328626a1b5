"""The residual: difference between a 2D feature map and the lifted features rendered into its view."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.rendering.renderer import render
from sgwarp.runs.isolation import isolated
from sgwarp.scene import Camera, FeatureMap, Gaussians

PIXELS = 20_000  # compared at most: a mean over so many is known to a fraction of a percent
IMAGE_BYTES = 2**28  # of the channels rendered at once

Grid = tuple[slice, slice, slice]  # of [L, h, w]


@isolated
def residual(
    gaussians: Gaussians,
    camera: Camera,
    feature_map: FeatureMap,
    features: Tensor,
    weight: Tensor,
    settings: RasterSettings | None = None,
) -> float:
    """Mean over the pixels that carry semantics of 1 - cosine, or for labels the share of them with another label.

    Rendered at the size of the map and compared on a grid of at most PIXELS pixels; one where nothing was lifted counts
    as missed.

    Args:
        gaussians: The scene.
        camera: Camera of the map's view.
        feature_map: What should be seen, [h, w] pixels.
        features: Sums of lifted features, float32 [N, C].
        weight: What they are to be divided by, float32 [N]; 0 where nothing was lifted.
        settings: Thresholds of the rasterizer.

    Returns:
        0 (perfect) to 2 for features, to 1 for labels; NaN if no pixel of the grid carries semantics.
    """
    height, width = feature_map.size
    camera = camera.resized(height, width)
    step = math.ceil(math.sqrt(height * width / PIXELS))
    grid = (slice(None), slice(step // 2, None, step), slice(step // 2, None, step))
    divisor = torch.where(weight > 0, weight, 1.0)[:, None]
    one_hot = feature_map.labels is not None and feature_map.ids is not None  # dense shares of labels are features
    target = _LabelTarget if one_hot else _FeatureTarget
    compared = target(feature_map, grid, features.device)
    together = max(16, IMAGE_BYTES // (4 * height * width) // 16 * 16)
    for start in range(0, feature_map.channels, together):
        channels = slice(start, start + together)
        image = render(gaussians, camera, "features", features[:, channels] / divisor, settings=settings)
        compared.add(image[grid[1:]], channels)
    return float(compared.error()[compared.valid].mean())


def _valid(feature_map: FeatureMap) -> Tensor:
    """Pixels that carry semantics, bool [L, h, w]; a dense map has one level."""
    if feature_map.ids is not None:
        return feature_map.ids >= 0
    if feature_map.valid is not None:
        return feature_map.valid[None]
    return torch.ones(1, *feature_map.size, dtype=torch.bool)


class _LabelTarget:
    """Labels on the grid against the arg-max over the channels so far.

    A channel has to beat zero, since nothing lifted is no label.
    """

    def __init__(self, feature_map: FeatureMap, grid: Grid, device: torch.device) -> None:
        assert feature_map.ids is not None
        self.valid = _valid(feature_map)[grid].to(device)
        self.ids = feature_map.ids[grid].to(device)
        self.best = torch.zeros(self.ids.shape[1:], device=device)
        self.label = torch.full_like(self.best, -1, dtype=torch.int64)

    def add(self, rendered: Tensor, channels: slice) -> None:
        value, index = rendered.max(dim=2)
        self.label = torch.where(value > self.best, index + channels.start, self.label)
        self.best = torch.maximum(self.best, value)

    def error(self) -> Tensor:
        """1 where the label is another one, [L, h, w]."""
        return (self.label != self.ids).to(torch.float32)


class _FeatureTarget:
    """Features on the grid against rendered ones, whose scalar products add up over the channels."""

    def __init__(self, feature_map: FeatureMap, grid: Grid, device: torch.device) -> None:
        self.valid = _valid(feature_map)[grid].to(device)
        if feature_map.dense is not None:
            self.rows = feature_map.dense[grid[1:]].to(device, torch.float32).flatten(0, 1)
            self.ids = torch.arange(len(self.rows), device=device).view(self.valid.shape)
        else:
            assert feature_map.ids is not None
            assert feature_map.vectors is not None
            self.rows = feature_map.vectors.to(device)
            self.ids = feature_map.ids[grid].clamp(min=0).long().to(device)
        self.product = torch.zeros(self.valid.shape, device=device)
        self.rendered = torch.zeros(self.valid.shape[1:], device=device)

    def add(self, rendered: Tensor, channels: slice) -> None:
        self.product += torch.einsum("lhwc,hwc->lhw", self.rows[:, channels][self.ids], rendered)
        self.rendered += rendered.square().sum(dim=2)

    def error(self) -> Tensor:
        """1 - cosine, [L, h, w]; 1 where nothing was lifted."""
        norms = self.rendered.sqrt() * self.rows.norm(dim=1)[self.ids]
        return 1.0 - torch.where(norms > 0, self.product / norms, 0.0)
