"""The geometric median over the views: a view that is wrong about a Gaussian does not pull its feature along.

With m_v the weighted mean of what view v shows of a Gaussian and w_v the weight behind it, the median is the x that
minimizes sum_v w_v |x - m_v|. Weiszfeld's iteration (1937) takes x to the mean of the m_v with weights
w_v / max(|x - m_v|, smoothing). Views pass one by one, so memory does not depend on their number.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from sgwarp.lifting.map_reader import MapReader
from sgwarp.lifting.settings import LiftSettings
from sgwarp.ops.splatting.lifting import LiftSums, lift_view
from sgwarp.scene import View

ROWS = 65_536  # Gaussians whose distances are held at once


def geometric_median(
    reader: MapReader,
    views: Sequence[View],
    start: Tensor,
    worth: Mapping[str, float],
    settings: LiftSettings,
    deterministic: bool | None = None,
    done: Callable[[str], None] = lambda stem: None,
) -> Tensor:
    """Features after `settings.passes` iterations from `start`, float32 [N, C]; holds three arrays of this size.

    Args:
        reader: Of the maps.
        views: To be lifted.
        start: Weighted means, float32 [N, C]; overwritten.
        worth: Factor of each view's weights by stem; 1 if missing.
        settings: Passes and smoothing.
        deterministic: As of `lift_view`.
        done: Called with its stem after each view of each pass.
    """
    count, channels = start.shape
    one = LiftSums.zeros(count, channels, start.device)
    median = start
    for _ in range(settings.passes):
        total, divisor = torch.zeros_like(median), torch.zeros(count, device=start.device)
        for view in views:
            found = reader.read(view)
            if found is None:
                continue
            with reader.log.stage("lift"):
                one.slices.zero_(), one.weight.zero_(), one.weight_squared.zero_()
                lift_view(
                    reader.gaussians, view.camera, found, one, settings=reader.settings, deterministic=deterministic
                )
                _add(one, median, worth.get(view.stem, 1.0), settings.smoothing, total, divisor)
            del found  # before the next map is made
            done(view.stem)
        median = torch.where(divisor[:, None] > 0, total.div_(divisor.clamp(min=1e-30)[:, None]), median)
    return median


def _add(one: LiftSums, median: Tensor, worth: float, smoothing: float, total: Tensor, divisor: Tensor) -> None:
    """Add one view's means with their weights over the distance from the median."""
    for rows in (one.weight > 0).nonzero().flatten().split(ROWS):
        weight = one.weight[rows]
        mean = one.features[rows] / weight[:, None]
        distance = (mean - median[rows]).norm(dim=1).clamp(min=smoothing)
        factor = worth * weight / distance
        total.index_add_(0, rows, factor[:, None] * mean)
        divisor.index_add_(0, rows, factor)
