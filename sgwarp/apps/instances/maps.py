"""Instances as seen from a camera: id maps, and pictures with one color an instance."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.querying.segmentation import splat_scores
from sgwarp.scene import Camera, Gaussians, InstanceMap
from sgwarp.visualization.pictures import Picture, class_colours, overlay, with_legend

CHANNELS = 48  # instances splatted at a time
LINES = 20  # of a legend


def render_ids(
    gaussians: Gaussians,
    found: InstanceMap,
    camera: Camera,
    level: str | None = None,
    settings: RasterSettings | None = None,
) -> tuple[Tensor, Tensor]:
    """Which instance every pixel of a view shows.

    The shares of the candidates are splatted, undecided Gaussians included: at a boundary what is behind them counts.

    Args:
        gaussians: The scene.
        found: Its instances.
        camera: The view.
        level: Name of the level; the coarsest if None.
        settings: Thresholds of the rasterizer.

    Returns:
        ids: Id of the instance with the largest share, 0 where that share is smaller than what belongs to none or is
            unknown, int64 [H, W].
        confidence: That share, float32 [H, W].

    Raises:
        InputError: The instances belong to another scene, or there is no such level.
    """
    found.require_scene(gaussians)
    place = found.level_index(level)
    name = found.levels[place]
    ids = [row.id for row in found.table if row.level == name]
    candidates, shares = found.candidates[place], found.shares[place]
    seen = found.observations > 0
    best = torch.zeros(camera.size, device=gaussians.device)
    total = torch.zeros_like(best)
    winner = torch.zeros(camera.size, dtype=torch.int64, device=gaussians.device)
    known = torch.zeros_like(winner, dtype=torch.bool)
    first, last = (ids[0], ids[-1]) if ids else (1, 0)
    for start in range(first, last + 1, CHANNELS):
        count = min(CHANNELS, last + 1 - start)
        columns = candidates.long() - start
        inside = (columns >= 0) & (columns < count)
        spread = torch.zeros(len(found), count + 1)
        spread.scatter_add_(1, torch.where(inside, columns, count), torch.where(inside, shares, 0.0))
        mean, known = splat_scores(gaussians, camera, spread[:, :count].to(gaussians.device), seen, settings)
        total += mean.sum(dim=2)
        share, channel = mean.max(dim=2)
        better = share > best
        best, winner = torch.where(better, share, best), torch.where(better, channel + start, winner)
    wins = known & (best > 0) & (best >= 1.0 - total)
    return torch.where(wins, winner, 0), torch.where(wins, best, 0.0)


def draw_ids(image: Any, ids: Tensor, found: InstanceMap) -> Picture:
    """One color an instance over a photograph [H, W, 3], with a legend of the largest ones in the picture."""
    colors = class_colours(len(found.table))
    picture = overlay(image, ids.cpu().numpy() - 1, colors)
    shown = torch.bincount(ids.flatten().cpu(), minlength=1)[1:]
    largest = [k for k in shown.argsort(descending=True, stable=True).tolist() if shown[k] > 0][:LINES]
    names = [f"{found.table[k].id} {found.table[k].label}".strip() for k in largest]
    return with_legend(picture, names, colors[largest])
