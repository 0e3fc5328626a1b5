"""Quality of semantics: segmentation and localization on the held-out views of the room."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sgwarp.demo.data import FURNITURE, Room
from sgwarp.encoders.base import TextEncoder
from sgwarp.metrics.localization import hits_mask
from sgwarp.metrics.segmentation import ConfusionMatrix
from sgwarp.querying.scoring import TextScores, best_texts, score_texts
from sgwarp.querying.segmentation import BOX, localize
from sgwarp.scene import Semantics, View

BACKGROUND = FURNITURE  # class of floor, wall and ceiling, for which nobody asks
SMALLEST = 50  # an object with fewer pixels in a view is not looked for there


@dataclass(frozen=True, eq=False)
class Finding:
    """Location of a query in a view.

    Attributes:
        name: The query.
        stem: The view.
        pixel: (x, y) of the best pixel.
        hit: Whether it lies on the object.
        scores: Where 0 is the scene's median and 1 its best thousandth, float32 [H, W].
    """

    name: str
    stem: str
    pixel: tuple[int, int]
    hit: bool
    scores: Tensor


@dataclass(frozen=True, eq=False)
class Measurement:
    """Accuracy of semantics.

    Attributes:
        confusion: Of the furniture and the background, over the held-out views.
        classes: Class at each pixel of each held-out view, int64 [H, W].
        findings: Of every object in every held-out view that shows it; of one object, the largest sight comes first.
        coverage: Share of the Gaussians that some view saw.
    """

    confusion: ConfusionMatrix
    classes: dict[str, Tensor]
    findings: list[Finding]
    coverage: float

    @property
    def miou(self) -> float:
        """Mean IoU over the furniture."""
        return float(self.confusion.iou[:FURNITURE].mean())

    @property
    def best_sights(self) -> list[Finding]:
        """One finding per object, in the held-out view that shows most of it."""
        first: dict[str, Finding] = {}
        for finding in self.findings:
            first.setdefault(finding.name, finding)
        return list(first.values())

    @property
    def localised(self) -> int:
        """Number of objects found in the held-out view that shows most of them."""
        return sum(finding.hit for finding in self.best_sights)


def measure(room: Room, semantics: Semantics, encoder: TextEncoder | None = None) -> Measurement:
    """Segment the held-out views and look for every piece of furniture in them.

    Scores are those of `score_texts`, pixels those of `best_texts`; what shows none of the names is background.

    Args:
        room: The scene, views and truth.
        semantics: Lifted into it.
        encoder: Text encoder of the semantics' space; None for lifted labels.
    """
    names = room.names if encoder is None else room.furniture
    scores = score_texts(semantics, names, encoder)
    confusion = ConfusionMatrix.empty(FURNITURE + 1)
    classes = {}
    for view in room.held_out:
        best = best_texts(room.gaussians, view.camera, scores)
        classes[view.stem] = torch.where(best >= 0, best.clamp(max=BACKGROUND), BACKGROUND).cpu()
        confusion.add(classes[view.stem], room.truth[view.stem].clamp(max=BACKGROUND))
    findings = []
    for channel in range(FURNITURE):
        sizes = {view.stem: int((room.truth[view.stem] == channel).sum()) for view in room.held_out}
        shown = sorted(room.held_out, key=lambda view: -sizes[view.stem])
        sights = [view for view in shown if sizes[view.stem] >= SMALLEST]
        findings += [_find(room, scores, channel, view) for view in sights]
    return Measurement(confusion, classes, findings, semantics.coverage)


def _find(room: Room, scores: TextScores, channel: int, view: View) -> Finding:
    column = scores.values[:, channel]
    pixel, score_map = localize(column, room.gaussians, view.camera, seen=scores.seen, box=BOX)
    hit = hits_mask(pixel, room.truth[view.stem] == channel)
    return Finding(room.names[channel], view.stem, pixel, hit, score_map.cpu())
