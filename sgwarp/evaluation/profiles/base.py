"""What a protocol is: which data, which views, how a scene is scored, and how scenes become one figure."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sgwarp.datasets.base import SceneData
from sgwarp.evaluation.cases import Case, Split, prepare, split_by_number
from sgwarp.evaluation.results import SceneResult
from sgwarp.evaluation.settings import Settings
from sgwarp.metrics.overlap import macro, mean, micro
from sgwarp.metrics.segmentation import ConfusionMatrix
from sgwarp.runs.log import RunLog

Score = Callable[[Any, SceneResult, Path], None]  # fills in the figures and draws sheets into a folder
Total = Callable[[Sequence[SceneResult]], dict[str, float]]


def prepared(scene: SceneData, settings: Settings, split: Split, log: RunLog) -> Case:
    """A scene made ready the usual way."""
    return prepare(scene, settings, split, log)


@dataclass(frozen=True)
class Profile:
    """One protocol.

    Attributes:
        name: As on the command line.
        about: One line.
        reader: Of the data set.
        score: Scores a scene that was made ready.
        total: Figures over all scenes.
        headline: The figures of the tables, in order, names of `total`.
        scenes: Of the published list; all that there are if empty.
        split: Views to lift from, and to score.
        defaults: Settings that differ from the usual ones.
        differences: What differs from the published protocol, or between the published systems.
        make: Makes a scene ready.
    """

    name: str
    about: str
    reader: str
    score: Score
    total: Total
    headline: tuple[str, ...]
    scenes: tuple[str, ...] = ()
    split: Split = split_by_number
    defaults: Mapping[str, Any] = field(default_factory=dict)
    differences: tuple[str, ...] = ()
    make: Callable[[SceneData, Settings, Split, RunLog], Any] = prepared


def add_confusion(result: SceneResult, matrix: ConfusionMatrix, classes: Sequence[str]) -> None:
    """Put a confusion matrix and its figures into a record."""
    result.classes, result.confusion = list(classes), matrix.counts.tolist()
    result.figures |= figures_of(matrix)
    result.per_class |= per_class(matrix, classes)


def figures_of(matrix: ConfusionMatrix) -> dict[str, float]:
    """mIoU, mAcc and the like of a confusion matrix."""
    return {
        "miou": matrix.miou,
        "macc": matrix.macc,
        "accuracy": matrix.pixel_accuracy,
        "fw_iou": matrix.frequency_weighted_iou,
        "unknown": matrix.unknown,
    }


def per_class(matrix: ConfusionMatrix, classes: Sequence[str]) -> dict[str, dict[str, float]]:
    """IoU, accuracy and precision of every class that is present."""
    rows = zip(classes, matrix.iou, matrix.accuracy, matrix.precision, matrix.present, strict=True)
    return {
        name: {"iou": float(iou), "accuracy": float(accuracy), "precision": float(precision)}
        for name, iou, accuracy, precision, present in rows
        if bool(present)
    }


def pooled(results: Sequence[SceneResult]) -> ConfusionMatrix | None:
    """One confusion matrix of all scenes, if they have the same classes."""
    matrices = [ConfusionMatrix.of_counts(one.confusion) for one in results if one.confusion is not None]
    if not matrices or len({tuple(one.classes) for one in results}) > 1:
        return None
    whole = ConfusionMatrix.empty(matrices[0].classes)
    for matrix in matrices:
        whole.merge(matrix)
    return whole


def total_pooled(results: Sequence[SceneResult]) -> dict[str, float]:
    """Figures of one confusion matrix over all scenes, and the means of the scenes' own figures ("scene_...")."""
    whole = pooled(results)
    own = {f"scene_{name}": value for name, value in total_means(results).items()}
    return (figures_of(whole) | own) if whole is not None else total_means(results)


def total_means(results: Sequence[SceneResult]) -> dict[str, float]:
    """Mean over the scenes of each figure."""
    names = dict.fromkeys(name for one in results for name in one.figures)
    return {name: mean(one.figures[name] for one in results if name in one.figures) for name in names}


def total_of_values(results: Sequence[SceneResult]) -> dict[str, float]:
    """Means of the scenes' figures (macro, the headline), and means over all queries ("micro_...")."""
    names = dict.fromkeys(name for one in results for name in one.values)
    over_all = {f"micro_{name}": micro({one.scene: one.values.get(name, []) for one in results}) for name in names}
    own = {name: macro({one.scene: one.values.get(name, []) for one in results}) for name in names}
    return {**total_means(results), **own, **over_all}
