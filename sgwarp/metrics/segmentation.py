"""Segmentation scores: one confusion matrix over all images, mIoU and mAcc over the classes that are present."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from sgwarp.errors import InputError


@dataclass(eq=False)
class ConfusionMatrix:
    """Pixel counts, added up over images.

    Attributes:
        classes: Number of classes Q.
        counts: Row = true class, column = predicted class; the last column counts pixels that were left unknown,
            int64 [Q, Q + 1].
    """

    classes: int
    counts: Tensor

    @classmethod
    def empty(cls, classes: int) -> ConfusionMatrix:
        """No pixel yet.

        Raises:
            InputError: Fewer than one class.
        """
        if classes < 1:
            raise InputError(f"classes: expected at least one, got {classes}")
        return cls(classes, torch.zeros(classes, classes + 1, dtype=torch.int64))

    def add(self, predicted: Tensor, truth: Tensor) -> None:
        """Count one image.

        Args:
            predicted: Class per pixel; anything outside 0 to Q - 1 is unknown, which is always wrong, integers [H, W].
            truth: Class per pixel; pixels outside 0 to Q - 1 are not scored, integers [H, W].

        Raises:
            InputError: The two have different shapes, or hold no integers.
        """
        if predicted.shape != truth.shape:
            raise InputError(f"predicted {list(predicted.shape)} and truth {list(truth.shape)} differ in size")
        if predicted.is_floating_point() or truth.is_floating_point():
            raise InputError(f"expected integer labels, got {predicted.dtype} and {truth.dtype}")
        predicted, truth = predicted.flatten().long().cpu(), truth.flatten().long().cpu()
        scored = (truth >= 0) & (truth < self.classes)
        predicted, truth = predicted[scored], truth[scored]
        predicted = torch.where((predicted >= 0) & (predicted < self.classes), predicted, self.classes)
        flat = torch.bincount(truth * (self.classes + 1) + predicted, minlength=self.counts.numel())
        self.counts += flat.reshape(self.counts.shape)

    def merge(self, other: ConfusionMatrix) -> None:
        """Add the pixels of another matrix of the same classes.

        Raises:
            InputError: It has another number of classes.
        """
        if other.classes != self.classes:
            raise InputError(f"confusion matrices: {self.classes} and {other.classes} classes cannot be added up")
        self.counts += other.counts

    @classmethod
    def of_counts(cls, counts: Any) -> ConfusionMatrix:
        """A matrix from its counts, [Q, Q + 1], as a list or tensor."""
        table = torch.as_tensor(counts, dtype=torch.int64)
        if table.ndim != 2 or table.shape[1] != table.shape[0] + 1:
            raise InputError(f"counts: expected shape [Q, Q + 1], got {list(table.shape)}")
        return cls(len(table), table.clone())

    @property
    def present(self) -> Tensor:
        """Classes that the truth holds, bool [Q]."""
        return self.counts.sum(dim=1) > 0

    @property
    def iou(self) -> Tensor:
        """Intersection over union per class, float64 [Q]; NaN for a class that is neither present nor predicted."""
        correct = self.counts.diagonal().double()
        union = self.counts.sum(dim=1) + self.counts[:, : self.classes].sum(dim=0) - self.counts.diagonal()
        return correct / union

    @property
    def accuracy(self) -> Tensor:
        """Share of a class's pixels that were found, float64 [Q]; NaN for a class that is not present."""
        return self.counts.diagonal().double() / self.counts.sum(dim=1)

    @property
    def miou(self) -> float:
        """Mean IoU over the classes that are present; NaN if no pixel was scored."""
        return float(self.iou[self.present].mean())

    @property
    def macc(self) -> float:
        """Mean accuracy over the classes that are present; NaN if no pixel was scored."""
        return float(self.accuracy[self.present].mean())

    @property
    def pixel_accuracy(self) -> float:
        """Share of the scored pixels that are right; NaN if there are none."""
        return float(self.counts.diagonal().sum().double() / self.counts.sum())

    @property
    def precision(self) -> Tensor:
        """Share of the scored pixels called a class that are of it, float64 [Q]; NaN for a class never called."""
        return self.counts.diagonal().double() / self.counts[:, : self.classes].sum(dim=0)

    @property
    def frequency_weighted_iou(self) -> float:
        """Mean IoU over the classes that are present, by their pixels; NaN if no pixel was scored."""
        share = self.counts.sum(dim=1)[self.present].double()
        return float((self.iou[self.present] * share).sum() / share.sum())

    @property
    def unknown(self) -> float:
        """Share of the scored pixels that were left unknown; NaN if there are none."""
        return float(self.counts[:, -1].sum().double() / self.counts.sum())
