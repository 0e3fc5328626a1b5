"""Evidence of earlier frames, carried along by Gaussians that keep their identity.

Sums of features and weights are forgotten geometrically, as in recursive least squares with a forgetting factor: what a
frame said counts `forgetting` times as much after each later frame that sees the Gaussian. A Gaussian whose frame
contradicts its past keeps the past, until the contradiction has lasted `patience` frames: then the past is dropped. So
single wrong frames change nothing, and a new state replaces the old one instead of blending with it.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.ops.splatting.lifting import LiftSums

LABEL_CHANGE = 0.5  # distance of label shares that counts as a contradiction
LEAST_CHANGE = 0.05  # smallest such distance in a text space
TIMES_MEDIAN = 4.0  # how many times the scene's median distance, in a text space


@dataclass(frozen=True)
class FusionSettings:
    """How the past counts.

    Attributes:
        forgetting: Weight of the past after one more frame, 0 (every frame alone, as in the paper) to 1 (for ever).
        patience: Frames in a row that must contradict the past before it is dropped.
        change: Cosine distance between a frame's feature and the past's that is a contradiction. None: 0.5 for labels,
            in a text space 4 times the median over the scene, but at least 0.05 and at most 0.5.

    Raises:
        InputError: A number is out of range.
    """

    forgetting: float = 0.9
    patience: int = 3
    change: float | None = None

    def __post_init__(self) -> None:
        if not 0.0 <= self.forgetting <= 1.0:
            raise InputError(f"forgetting: expected 0 to 1, got {self.forgetting}")
        if self.patience < 1:
            raise InputError(f"patience: expected 1 frame or more, got {self.patience}")
        if self.change is not None and not 0.0 < self.change <= 2.0:
            raise InputError(f"change: expected a cosine distance in (0, 2], got {self.change}")


@dataclass(eq=False)
class Evidence:
    """Sums behind the features, over views and frames.

    Attributes:
        features: Sum of weighted features, float32 [N, C].
        weight: Sum of weights, float32 [N].
        weight_squared: Sum of the squared weight of each view and frame, float32 [N].
        against: Frames in a row that contradicted, float32 [N].
        ids: Identity of each row, int64 [N], or None: the row itself.
    """

    features: Tensor
    weight: Tensor
    weight_squared: Tensor
    against: Tensor
    ids: Tensor | None = None

    @classmethod
    def of(cls, sums: LiftSums, ids: Tensor | None) -> Evidence:
        """Of one frame; a copy."""
        against = torch.zeros_like(sums.weight)
        return cls(sums.features.clone(), sums.weight.clone(), sums.weight_squared.clone(), against, ids)


class Fusion:
    """What is known after the frames so far."""

    def __init__(self, settings: FusionSettings, labels: bool) -> None:
        self.settings = settings
        self.labels = labels
        self.evidence: Evidence | None = None

    def update(self, sums: LiftSums, ids: Tensor | None, frame: int = 0) -> Evidence:
        """Take a frame in; the evidence belongs to this object and changes with the next frame.

        Raises:
            InputError: The Gaussians are not those of the frame before, and nothing says which are which.
        """
        if self.settings.forgetting == 0.0 or self.evidence is None or not len(self.evidence.weight):
            self.evidence = Evidence.of(sums, ids)
            return self.evidence
        if not len(sums.weight):  # a frame without Gaussians says nothing, and changes nothing
            return Evidence.of(sums, ids)
        past = self._carried(len(sums.weight), ids, frame)
        _widen(past, sums.channels)
        seen = sums.weight > 0
        known = past.weight > 0
        against = self._contradicts(past, sums) & seen & known
        count = torch.where(against, past.against + 1.0, torch.where(seen, 0.0, past.against))
        dropped = against & (count >= self.settings.patience)
        held = against & ~dropped
        past.against = torch.where(dropped, 0.0, count)
        decay = torch.where(dropped, 0.0, torch.where(seen & ~held, self.settings.forgetting, 1.0))
        gain = (~held).to(decay.dtype)
        past.features.mul_(decay[:, None]).addcmul_(sums.features, gain[:, None])
        past.weight.mul_(decay).addcmul_(sums.weight, gain)
        past.weight_squared.mul_(decay.square()).addcmul_(sums.weight_squared, gain)
        return past

    def join(self, kept: int, gone: int) -> None:
        """Give what is known of one label to another: they turned out to be the same object."""
        if self.evidence is not None and gone < self.evidence.features.shape[1]:
            features = self.evidence.features
            features[:, kept] += features[:, gone]
            features[:, gone] = 0.0

    def _carried(self, count: int, ids: Tensor | None, frame: int) -> Evidence:
        """The past, in the order of this frame's rows."""
        past = self.evidence
        assert past is not None
        if ids is None or past.ids is None:
            if (ids is None) != (past.ids is None) or len(past.weight) != count:
                raise InputError(
                    f"frame {frame}: has {count} Gaussians, the frame before {len(past.weight)}, and no ids say which "
                    "are which; write a column 'id' into the PLY files, or use a forgetting factor of 0"
                )
            return past
        if torch.equal(ids, past.ids):
            return past
        order = past.ids.argsort()
        place = torch.searchsorted(past.ids[order], ids).clamp(max=max(0, len(order) - 1))
        row = order[place] if len(order) else torch.zeros_like(ids)
        kept = past.ids[row] == ids if len(order) else torch.zeros_like(ids, dtype=torch.bool)

        def moved(values: Tensor) -> Tensor:
            found = values.new_zeros(count, *values.shape[1:])
            found[kept] = values[row[kept]]
            return found

        self.evidence = Evidence(
            moved(past.features), moved(past.weight), moved(past.weight_squared), moved(past.against), ids
        )
        return self.evidence

    def _contradicts(self, past: Evidence, sums: LiftSums) -> Tensor:
        """Where the feature of the frame is far from that of the past, bool [N]."""
        distance = 1.0 - torch.nn.functional.cosine_similarity(sums.features, past.features, dim=1)
        limit = self.settings.change
        if limit is None and self.labels:
            limit = LABEL_CHANGE
        elif limit is None:
            both = (sums.weight > 0) & (past.weight > 0)
            typical = float(distance[both].median()) if bool(both.any()) else 0.0
            limit = min(LABEL_CHANGE, max(LEAST_CHANGE, TIMES_MEDIAN * typical))
        return distance > limit


def _widen(past: Evidence, channels: int) -> None:
    """Room for labels that appeared in this frame."""
    if past.features.shape[1] < channels:
        past.features = torch.nn.functional.pad(past.features, (0, channels - past.features.shape[1]))
