"""Average precision of instances without classes, as on ScanNet: masks of points or pixels, matched by IoU."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sgwarp.errors import InputError

THRESHOLDS = tuple(round(0.5 + 0.05 * step, 2) for step in range(9))  # 0.5 to 0.9, ScanNet's own


@dataclass(frozen=True)
class Precision:
    """Average precision over all scenes or images.

    Attributes:
        ap: Mean over THRESHOLDS.
        ap50, ap25: At an IoU of 0.5 and 0.25.
    """

    ap: float
    ap50: float
    ap25: float


class Detections:
    """Predicted and true instances, added up over images or scenes; an id means something in one of them alone."""

    def __init__(self) -> None:
        self._scores: list[Tensor] = []
        self._ious: list[Tensor] = []  # [P, T] of each image
        self._outside: list[Tensor] = []  # share of each prediction that lies where nothing is scored, [P]

    def add(
        self, predicted: Tensor, truth: Tensor, scores: Tensor | None = None, ignored: Tensor | None = None
    ) -> None:
        """Add one image or scene.

        Args:
            predicted: Masks, bool [P, ...]; they may overlap.
            truth: Masks, bool [T, ...]; empty ones are left out.
            scores: How sure each prediction is, [P]; its size if None.
            ignored: Where nothing is scored, bool [...]. A prediction that matches nothing and has a larger share there
                than the threshold of IoU does not count, as in ScanNet's script.

        Raises:
            InputError: The masks differ in size, or there is not one score per prediction.
        """
        if predicted.shape[1:] != truth.shape[1:]:
            raise InputError(f"instances: masks of {list(predicted.shape[1:])} and {list(truth.shape[1:])} differ")
        mine, theirs = predicted.flatten(1).bool(), truth.flatten(1).bool()
        theirs = theirs[theirs.any(dim=1)]
        sizes, wanted = mine.sum(dim=1).double(), theirs.sum(dim=1).double()
        scores = sizes if scores is None else scores.double()
        if scores.shape != sizes.shape:
            raise InputError(f"instances: {len(mine)} predictions, but scores of shape {list(scores.shape)}")
        shared = mine.float().double() @ theirs.float().double().T
        self._ious.append((shared / (sizes[:, None] + wanted[None] - shared).clamp(min=1.0)).cpu())
        self._scores.append(scores.cpu())
        outside = torch.zeros_like(sizes) if ignored is None else (mine & ignored.flatten().bool()).sum(dim=1) / sizes
        self._outside.append(outside.cpu())

    def average_precision(self, threshold: float) -> float:
        """Area under precision over recall at one IoU; NaN without true instances, 0 without predictions.

        Predictions are taken from the surest on, over all images; each takes the free true instance that it overlaps
        most, if by more than the threshold, else it is wrong.
        """
        total = sum(ious.shape[1] for ious in self._ious)
        if not total:
            return float("nan")
        order = sorted(
            ((-float(score), image, row) for image, s in enumerate(self._scores) for row, score in enumerate(s)),
        )
        free = [torch.ones(ious.shape[1], dtype=torch.bool) for ious in self._ious]
        right = []
        for _, image, row in order:
            overlap = torch.where(free[image], self._ious[image][row], -1.0)
            best = int(overlap.argmax()) if len(overlap) else -1
            matched = best >= 0 and float(overlap[best]) > threshold
            if matched:
                free[image][best] = False
            if matched or float(self._outside[image][row]) <= threshold:
                right.append(matched)
        if not right:
            return 0.0
        correct = torch.tensor(right, dtype=torch.float64).cumsum(0)
        precision = correct / torch.arange(1, len(right) + 1)
        envelope = precision.flip(0).cummax(0).values.flip(0)  # precision at this recall or more
        recall = correct / total
        steps = torch.diff(recall, prepend=recall.new_zeros(1))
        return float((steps * envelope).sum())

    def precision(self) -> Precision:
        """AP, AP50 and AP25."""
        each = [self.average_precision(threshold) for threshold in THRESHOLDS]
        return Precision(sum(each) / len(each), self.average_precision(0.5), self.average_precision(0.25))


def masks_of(ids: Tensor, nothing: int = 0) -> Tensor:
    """One mask per id, ascending, bool [K, ...]."""
    names = [name for name in ids.unique().tolist() if name != nothing]
    return torch.stack([ids == name for name in names]) if names else torch.zeros(0, *ids.shape, dtype=torch.bool)
