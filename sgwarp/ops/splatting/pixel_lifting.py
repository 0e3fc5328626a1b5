"""Lifting that reads a map pixel by pixel: at the centres of the Gaussians, or for the strongest contributor alone."""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from sgwarp.kernels.lifting import shared as lifting
from sgwarp.ops.arguments import view
from sgwarp.ops.launcher import launch
from sgwarp.ops.memory import scratch
from sgwarp.ops.splatting import tiles
from sgwarp.ops.splatting.contributors import top_contributors
from sgwarp.ops.splatting.forward import composite
from sgwarp.ops.splatting.lift_sums import LiftSums
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.scene import Camera, FeatureMap, Gaussians

PIXELS = 16_384  # whose features are held at once


def add_centers(
    projected: tiles.Projected,
    lists: tiles.TileLists,
    camera: Camera,
    feature_map: FeatureMap,
    sums: LiftSums,
    tau: float,
    border: int,
    settings: RasterSettings,
) -> None:
    """Add the feature at the pixel of each centre, where the rendered depth agrees (paper, Sec. III-B)."""
    device = sums.weight.device
    surface = composite(lists, camera, settings, None, True)[4]
    n = len(sums.weight)
    pixels = scratch("center pixels", n, torch.int32, device)
    inputs = [projected.splats, view(projected.status, wp.uint8), view(surface, wp.float32), tau, border]
    launch(lifting.find_center_pixels, n, inputs, [view(pixels, wp.int32)], device=device)
    seen = (pixels >= 0).nonzero().flatten()
    at = pixels[seen].to(torch.int64)
    y, x = at // camera.width, at % camera.width
    features, given = read_at(feature_map, camera, y, x)
    seen = seen[given]
    flat = sums.slices.flatten(1)
    flat[seen, : sums.channels] += features[given]
    sums.weight[seen] += 1.0
    sums.weight_squared[seen] += 1.0


def read_at(feature_map: FeatureMap, camera: Camera, y: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    """Features at image pixels [K, C], read at the nearest map position, and whether there are any, bool [K]."""
    row, column = _map_positions(feature_map, camera, y, x)
    if feature_map.dense is not None:
        device = y.device
        features = feature_map.dense.to(device)[row, column].to(torch.float32)
        given = torch.ones_like(y, dtype=torch.bool)
        if feature_map.valid is not None:
            given = feature_map.valid.to(device)[row, column]
        return features, given
    assert feature_map.ids is not None
    ids = feature_map.ids.to(y.device)[:, row, column].to(torch.int64)
    held = ids >= 0
    if feature_map.vectors is None:
        vectors = torch.eye(feature_map.channels, device=y.device)
    else:
        vectors = feature_map.vectors.to(y.device)
    # Several levels count once: the mean over the levels that carry an id here.
    features = torch.where(held[..., None], vectors[ids.clamp(min=0)], 0.0).sum(0)
    return features / held.sum(0).clamp(min=1)[:, None], held.any(dim=0)


def _map_positions(feature_map: FeatureMap, camera: Camera, y: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    """Row and column of a map that image pixels lie in, int64 [K] each."""
    h, w = feature_map.size
    return ((2 * y + 1) * h) // (2 * camera.height), ((2 * x + 1) * w) // (2 * camera.width)


def add_strongest(
    gaussians: Gaussians, camera: Camera, feature_map: FeatureMap, sums: LiftSums, settings: RasterSettings
) -> None:
    """Add alpha T f of every pixel to the Gaussian that contributes most to it (OpenGaussian, Dr. Splat and others)."""
    device = sums.weight.device
    owners, weights = (part[..., 0] for part in top_contributors(gaussians, camera, 1, settings))
    y, x = (owners >= 0).nonzero(as_tuple=True)
    owners, weights = owners[y, x].to(torch.int64), weights[y, x]
    view_weight = torch.zeros_like(sums.weight)
    if feature_map.ids is None:
        for first in range(0, len(owners), PIXELS):
            part = slice(first, first + PIXELS)
            features, given = read_at(feature_map, camera, y[part], x[part])
            own, w = owners[part][given], weights[part][given]
            sums.features.index_add_(0, own, w[:, None] * features[given])
            view_weight.index_add_(0, own, w)
    else:
        row, column = _map_positions(feature_map, camera, y, x)
        for level in feature_map.ids.to(device):
            ids = level[row, column].to(torch.int64)
            held = ids >= 0
            _add_pairs(owners[held], ids[held], weights[held], feature_map, sums)
            view_weight.index_add_(0, owners[held], weights[held])
    sums.weight += view_weight
    sums.weight_squared += view_weight.square()


def _add_pairs(owners: Tensor, ids: Tensor, weights: Tensor, feature_map: FeatureMap, sums: LiftSums) -> None:
    """Add weights by Gaussian and id, then the vectors of the ids times those."""
    if feature_map.vectors is None:
        sums.features.index_put_((owners, ids), weights, accumulate=True)
        return
    vectors = feature_map.vectors.to(sums.weight.device)
    pairs, place = (owners * len(vectors) + ids).unique(return_inverse=True)
    totals = torch.zeros(len(pairs), device=weights.device).index_add_(0, place, weights)
    for first in range(0, len(pairs), PIXELS):
        own, of = pairs[first : first + PIXELS] // len(vectors), pairs[first : first + PIXELS] % len(vectors)
        sums.features.index_add_(0, own, totals[first : first + PIXELS, None] * vectors[of])
