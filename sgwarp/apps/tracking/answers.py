"""What a frame shows: ids per pixel, and where each object is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sgwarp.apps.tracking.tracker import TrackedFrame
from sgwarp.encoders.base import TextEncoder
from sgwarp.encoders.calibration import Scoring
from sgwarp.errors import InputError
from sgwarp.querying.scores import class_votes, query
from sgwarp.querying.segmentation import UNKNOWN, segment_votes
from sgwarp.scene import Gaussians, Semantics, View

BEST_SHARE = 0.01  # of the seen Gaussians, over which the score of a query is averaged
INNER = (0.02, 0.98)  # quantiles between which an object extends: stray Gaussians do not count


@dataclass(frozen=True)
class Questions:
    """What is asked of every frame.

    Attributes:
        classes: Names; None for lifted label images, whose ids are then the answer.
        texts: Phrases whose score is followed over time.
        encoder: Text encoder of the space of the features, where one is needed.
        scoring, temperature: As of `class_votes`.
        unknown_below: As of `segment`.
    """

    classes: tuple[str, ...] | None = None
    texts: tuple[str, ...] = ()
    encoder: TextEncoder | None = None
    scoring: Scoring | None = None
    temperature: float | None = None
    unknown_below: float = 0.0


@dataclass(frozen=True, eq=False)
class Answer:
    """What one frame shows.

    Attributes:
        images: Values of the pixels by stem as `sgwarp segment` writes them, uint8 or uint16 [H, W].
        channels: Index into `names` of every Gaussian, -1 where nothing is known, int64 [N].
        names: Of the objects: the classes, or the ids of label images.
        values: Value that each of them has in the images.
        objects: A row for each, see `object_rows`.
        scores: Of each text.
    """

    images: dict[str, Any]
    channels: Tensor
    names: tuple[str, ...]
    values: tuple[int, ...]
    objects: list[dict[str, Any]]
    scores: dict[str, float]


def answer(tracked: TrackedFrame, questions: Questions, views: Sequence[View]) -> Answer:
    """Ask a frame.

    Raises:
        InputError: See `class_votes`; texts of label images; or an id that no image can hold.
    """
    names, values = _names(tracked, questions)
    nothing = 0 if questions.classes is None else UNKNOWN
    gaussians, count = tracked.gaussians, len(tracked.gaussians)
    if not count or not tracked.space:
        images = {view.stem: np.full(view.camera.size, nothing, np.uint8) for view in views}
        channels = torch.full((count,), -1)
        objects = object_rows(gaussians, channels, names, values, images)
        return Answer(images, channels, names, values, objects, dict.fromkeys(questions.texts, 0.0))
    semantics = tracked.semantics
    votes = _votes(semantics, questions)
    best, channels = votes.max(dim=1)
    channels = torch.where((best > 0) & semantics.seen, channels, -1)
    table = torch.tensor([*values, nothing])
    kind = np.uint8 if int(table.max()) <= 255 else np.uint16
    images = {}
    for view in views:
        found, _ = segment_votes(gaussians, view.camera, votes, semantics.seen, unknown_below=questions.unknown_below)
        images[view.stem] = table[found.cpu()].numpy().astype(kind)
    objects = object_rows(gaussians, channels, names, values, images)
    return Answer(images, channels, names, values, objects, query_scores(tracked, questions))


def _votes(semantics: Semantics, questions: Questions) -> Tensor:
    """As `class_votes`; an id that no label image has shown so far has none, since a later frame may show it."""
    classes = questions.classes
    asked = (questions.encoder, questions.temperature, questions.scoring)
    if classes is None or semantics.labels is None:
        return class_votes(semantics, classes, *asked)
    shown = [place for place, name in enumerate(classes) if name in semantics.labels or not name.isdecimal()]
    votes = torch.zeros(len(semantics.seen), len(classes), device=semantics.features.device)
    if shown:
        votes[:, shown] = class_votes(semantics, [classes[place] for place in shown], *asked)
    return votes


def _names(tracked: TrackedFrame, questions: Questions) -> tuple[tuple[str, ...], tuple[int, ...]]:
    if questions.classes is not None:
        return questions.classes, tuple(range(len(questions.classes)))
    labels = tracked.labels or ()
    if not tracked.space:
        return (), ()
    if tracked.labels is None:
        raise InputError(f"classes: features in space '{tracked.space}' need the names of the classes to look for")
    if not all(name.isdecimal() and int(name) <= 65535 for name in labels):
        wrong = next(name for name in labels if not (name.isdecimal() and int(name) <= 65535))
        raise InputError(f"label '{wrong}' is no id that a 16-bit image can hold; name classes instead")
    return labels, tuple(int(name) for name in labels)


def object_rows(
    gaussians: Gaussians, channels: Tensor, names: Sequence[str], values: Sequence[int], images: dict[str, Any]
) -> list[dict[str, Any]]:
    """Where each object is: one row per name.

    A row holds `name`; `gaussians`, how many are its own; `centroid` [m] and `extent` [m] of those between the 2nd and
    98th percentile of every axis, None without any; `pixels` by view; and `visible`, whether there are any.
    """
    means, finite = gaussians.means.cpu(), gaussians.finite.cpu()
    rows = []
    for number, (name, value) in enumerate(zip(names, values, strict=True)):
        mine = means[(channels.cpu() == number) & finite]
        centroid, extent = _inner_box(mine)
        pixels = {stem: int((image == value).sum()) for stem, image in images.items()}
        row = {"name": name, "gaussians": len(mine), "centroid": centroid, "extent": extent}
        rows.append({**row, "visible": any(pixels.values()), "pixels": pixels})
    return rows


def _inner_box(points: Tensor) -> tuple[list[float] | None, list[float] | None]:
    """Centre and edges of the points without strays."""
    if not len(points):
        return None, None
    low, high = np.quantile(points.double().numpy(), INNER, axis=0, method="nearest")
    inside = ((points.double().numpy() >= low) & (points.double().numpy() <= high)).all(axis=1)
    chosen = points.double().numpy()[inside] if inside.any() else points.double().numpy()
    return chosen.mean(axis=0).round(6).tolist(), (high - low).round(6).tolist()


def query_scores(tracked: TrackedFrame, questions: Questions) -> dict[str, float]:
    """Score of each text at this frame: mean cosine over the best hundredth of the seen Gaussians.

    Raises:
        InputError: The features are label shares, or there is no text encoder.
    """
    if not questions.texts:
        return {}
    if tracked.labels is not None or questions.encoder is None:
        raise InputError("texts: need features in a text space and its encoder; label images know ids only")
    semantics = tracked.semantics
    scores = query(semantics, questions.texts, questions.encoder)[semantics.seen]
    if not len(scores):
        return dict.fromkeys(questions.texts, 0.0)
    best = scores.topk(max(1, round(BEST_SHARE * len(scores))), dim=0).values.mean(dim=0)
    return dict(zip(questions.texts, best.tolist(), strict=True))
