"""Figures of tracking: points along trajectories, identities over time, and queries over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sgwarp.errors import InputError

THRESHOLDS = (1.0, 2.0, 4.0, 8.0, 16.0)  # of delta: pixels of a 256 x 256 image, or centimetres
LOST_BEYOND = 50.0  # of survival: pixels, or centimetres
MATCH_ABOVE = 0.5  # least IoU of an object and what is taken for it


@dataclass(frozen=True)
class PointTracking:
    """Figures of point tracking, as Dynamic3DGaussians reports them.

    Attributes:
        median_error: Median over the trajectories of their mean distance from the truth (MTE, PointOdyssey).
        delta: Mean over THRESHOLDS of the share of visible points that lie within (TAP-Vid), 0 to 1.
        survival: Mean over the trajectories of the share of frames before the first error beyond LOST_BEYOND, 0 to 1.
    """

    median_error: float
    delta: float
    survival: float


def point_tracking(
    predicted: Tensor, truth: Tensor, visible: Tensor | None = None, thresholds: Sequence[float] = THRESHOLDS
) -> PointTracking:
    """Compare trajectories.

    Args:
        predicted: [T, K, D] in the unit of the thresholds; NaN is infinitely far away.
        truth: [T, K, D].
        visible: Where the truth is known, bool [T, K]; everywhere if None. A trajectory without any is left out.
        thresholds: Of delta.

    Raises:
        InputError: The shapes differ, or nothing is visible.
    """
    if predicted.shape != truth.shape or truth.ndim != 3 or (visible is not None and visible.shape != truth.shape[:2]):
        raise InputError(
            f"trajectories: expected two of shape [T, K, D], got {list(predicted.shape)}, {list(truth.shape)}"
        )
    error = (predicted.double() - truth.double()).norm(dim=2).nan_to_num(nan=torch.inf)
    seen = torch.ones_like(error, dtype=torch.bool) if visible is None else visible
    known = seen.any(dim=0)
    if not bool(known.any()):
        raise InputError("trajectories: nothing is visible anywhere")
    error, seen = error[:, known], seen[:, known]
    count = seen.sum(dim=0)
    means = torch.where(seen, error, 0.0).sum(dim=0) / count
    within = [float((error[seen] < threshold).double().mean()) for threshold in thresholds]
    lost = seen & (error > LOST_BEYOND)
    alive = seen & (lost.cumsum(dim=0) == 0)
    return PointTracking(
        median_error=_median(means),
        delta=sum(within) / len(within),
        survival=float((alive.sum(dim=0) / count).double().mean()),
    )


def _median(values: Tensor) -> float:
    """The mean of the two values in the middle, which may be infinite."""
    ordered = values.sort().values
    return float((ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2)


def normalized_pixels(points: Tensor, width: int, height: int) -> Tensor:
    """Pixels [..., 2] of an image as pixels of one of 256 x 256, in which 2D thresholds are given."""
    return points * (256.0 / torch.tensor([width, height], dtype=points.dtype))


def matches(predicted: Tensor, truth: Tensor, least: float = MATCH_ABOVE) -> dict[int, int]:
    """Which predicted id stands for each true one: the one of largest IoU, if that is `least` or more.

    Args:
        predicted, truth: Ids of the pixels of one frame, all its views together, integers of one shape; 0 is nothing.

    Raises:
        InputError: The shapes differ.
    """
    if predicted.shape != truth.shape:
        raise InputError(f"ids: predicted {list(predicted.shape)} and truth {list(truth.shape)} differ in size")
    predicted, truth = predicted.flatten().long(), truth.flatten().long()
    found = {}
    for name in truth.unique().tolist():
        if name == 0:
            continue
        mine = truth == name
        ids, counts = predicted[mine].unique(return_counts=True)
        best = max(
            ((int(c) / int((mine | (predicted == i)).sum()), -int(i)) for i, c in zip(ids, counts, strict=True) if i),
            default=(0.0, 0),
        )
        if best[0] >= least:
            found[int(name)] = -best[1]
    return found


def identity_switches(frames: Sequence[dict[int, int]]) -> int:
    """How often a true object is taken for another one than the last time it was matched (as IDSW of MOTA).

    Args:
        frames: Of each frame the predicted id of every true one that was matched, see `matches`.
    """
    last: dict[int, int] = {}
    switches = 0
    for frame in frames:
        for name, found in frame.items():
            switches += name in last and last[name] != found
            last[name] = found
    return switches


def query_accuracy(scores: Tensor, truth: Tensor, threshold: float | None = None) -> float:
    """Share of the frames in which a query is rightly called on or off (Acc of 4D LangSplat).

    Args:
        scores: Similarity of the query in every frame, [T].
        truth: Whether it holds, bool [T].
        threshold: A frame is called on above it; the mean of the scores over time if None.

    Raises:
        InputError: The two differ in length or are empty.
    """
    called = called_frames(scores, threshold)
    if called.shape != truth.shape:
        raise InputError(f"scores {list(scores.shape)} and truth {list(truth.shape)} differ in length")
    return float((called == truth.bool()).double().mean())


def called_frames(scores: Tensor, threshold: float | None = None) -> Tensor:
    """Frames in which a query is called on: its score is above the threshold, by default its mean over time, bool [T].

    Raises:
        InputError: There are no scores.
    """
    if scores.ndim != 1 or not len(scores):
        raise InputError(f"scores: expected shape [frames], got {list(scores.shape)}")
    scores = scores.double()
    return scores > (scores.mean() if threshold is None else threshold)


def video_iou(predicted: Sequence[Tensor], truth: Sequence[Tensor]) -> float:
    """Mean over the frames in which prediction or truth has something of the spatial IoU (vIoU of 4D LangSplat).

    A frame in which only one of them has something counts 0.

    Args:
        predicted, truth: Mask of every frame, bool, empty where the query is called off.

    Raises:
        InputError: The two differ in length or size.
    """
    if len(predicted) != len(truth) or any(p.shape != t.shape for p, t in zip(predicted, truth, strict=True)):
        raise InputError("masks: predicted and truth differ in length or size")
    each = []
    for mine, theirs in zip(predicted, truth, strict=True):
        mine, theirs = mine.bool(), theirs.bool()
        union = int((mine | theirs).sum())
        if union:
            each.append(int((mine & theirs).sum()) / union)
    return sum(each) / len(each) if each else float("nan")
