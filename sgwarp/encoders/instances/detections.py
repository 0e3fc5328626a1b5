"""Filter of a detector's boxes: score, image bounds, non-maximum suppression."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sgwarp.encoders.base import Instances
from sgwarp.encoders.masks.sam import best_boxes


@dataclass(frozen=True)
class DetectorSettings:
    """Settings of a detector's boxes.

    Attributes:
        least_score: Least score of a box.
        overlap: Of two boxes of one name that overlap by this IoU or more, the worse is dropped.
    """

    least_score: float = 0.25
    overlap: float = 0.7


def keep_detections(
    boxes: Tensor,
    names: Sequence[str],
    scores: Tensor,
    settings: DetectorSettings,
    size: Sequence[int],
    square: int | None = None,
) -> Instances:
    """Detections that count, the best first.

    Args:
        boxes: Centre and size, x, y, w, h, in shares of the image or of the square around it, [K, 4].
        names: K names.
        scores: In [0, 1], [K].
        settings: See there.
        size: (height, width) of the image [pixels].
        square: Side of the square around the image, whose corner is the image's [pixels]; None if there is none.
    """
    height, width = size
    unit = torch.tensor([square or width, square or height] * 2, dtype=torch.float32)
    middle, half = boxes[:, :2] * unit[:2], boxes[:, 2:] * unit[:2] / 2
    limit = torch.tensor([width, height] * 2, dtype=torch.float32)
    corners = torch.minimum(torch.cat([middle - half, middle + half], dim=1).clamp(min=0), limit)
    there = (corners[:, 2:] - corners[:, :2] > 0).all(dim=1) & (scores >= settings.least_score)
    order = torch.argsort(scores, descending=True, stable=True)
    order = order[there[order]]
    groups = torch.tensor([names.index(names[k]) for k in order.tolist()], dtype=torch.int64)
    kept = order[best_boxes(corners[order], settings.overlap, groups)]
    return Instances(corners[kept], tuple(names[k] for k in kept.tolist()), scores[kept])
