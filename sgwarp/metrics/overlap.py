"""Masks against masks: IoU, boundary IoU, accuracy at a threshold, and means over scenes or over queries."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import torch
from torch import Tensor

from sgwarp.errors import InputError

DILATION = 0.02  # width of a boundary [diagonal of the image] (Cheng et al., Boundary IoU, 2021)


def mask_iou(predicted: Tensor, truth: Tensor) -> float:
    """Intersection over union of two masks, bool [H, W]; NaN where both are empty.

    Raises:
        InputError: The masks differ in size.
    """
    predicted, truth = _pair(predicted, truth)
    union = int((predicted | truth).sum())
    return int((predicted & truth).sum()) / union if union else math.nan


def boundary_iou(predicted: Tensor, truth: Tensor, dilation: float = DILATION) -> float:
    """Intersection over union of the boundaries of two masks, bool [H, W]; NaN where both are empty.

    Args:
        predicted, truth: The masks.
        dilation: Width of a boundary [diagonal of the image].

    Raises:
        InputError: The masks differ in size.
    """
    predicted, truth = _pair(predicted, truth)
    return mask_iou(boundary(predicted, dilation), boundary(truth, dilation))


def boundary(mask: Tensor, dilation: float = DILATION) -> Tensor:
    """Pixels of a mask within `dilation` [diagonal, at least one pixel] of what is not the mask, bool [H, W].

    Distance is along the larger axis (squares), and what lies outside the image is not the mask.
    """
    height, width = mask.shape
    steps = max(1, round(dilation * math.hypot(height, width)))
    outside = torch.nn.functional.pad((~mask.bool()).float()[None, None], (steps,) * 4, value=1.0)
    for kernel in ((1, 2 * steps + 1), (2 * steps + 1, 1)):
        outside = torch.nn.functional.max_pool2d(outside, kernel, stride=1)
    return mask.bool() & (outside[0, 0] > 0)


def accuracy_at(ious: Sequence[float], threshold: float) -> float:
    """Share of the queries whose IoU exceeds the threshold (Acc@k); a NaN does not; NaN if there are none."""
    return sum(iou > threshold for iou in ious) / len(ious) if ious else math.nan


def mean(values: Iterable[float]) -> float:
    """Mean of the numbers that are not NaN; NaN if there are none."""
    known = [value for value in values if not math.isnan(value)]
    return sum(known) / len(known) if known else math.nan


def macro(groups: Mapping[str, Sequence[float]]) -> float:
    """Mean over groups of the mean in each: every scene, or every class, counts the same."""
    return mean(mean(values) for values in groups.values())


def micro(groups: Mapping[str, Sequence[float]]) -> float:
    """Mean over all values of all groups: every query counts the same."""
    return mean(value for values in groups.values() for value in values)


def _pair(predicted: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    if predicted.shape != truth.shape or truth.ndim != 2:
        shapes = f"{list(predicted.shape)} and {list(truth.shape)}"
        raise InputError(f"masks: expected two of one size [H, W], got {shapes}; resize one to the other, nearest")
    return predicted.bool().cpu(), truth.bool().cpu()
