"""Profiles `scannet12-2d` (the paper's Table I) and `scannet-3d` (OpenGaussian's classes on points of the mesh)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from sgwarp.datasets.base import LabelledPoints, resize_nearest
from sgwarp.datasets.scannet_classes import SETS, set_names, set_table
from sgwarp.errors import InputError
from sgwarp.evaluation.answers import Answers
from sgwarp.evaluation.cases import Case, split_by_every, split_without_views
from sgwarp.evaluation.profiles.base import Profile, add_confusion, total_means, total_pooled
from sgwarp.evaluation.results import SceneResult
from sgwarp.evaluation.sheets import draw_labels, photograph_of
from sgwarp.metrics.segmentation import ConfusionMatrix
from sgwarp.querying.scores import class_votes

FAINT = 0.1  # opacity below which OpenGaussian ignores a Gaussian
SCENES_12 = (
    *("scene0050_02", "scene0144_01", "scene0221_01", "scene0300_01", "scene0354_00", "scene0389_00"),
    *("scene0423_02", "scene0427_00", "scene0494_00", "scene0616_00", "scene0645_02", "scene0693_00"),
)
SCENES_10 = (
    *("scene0000_00", "scene0062_00", "scene0070_00", "scene0097_00", "scene0140_00"),
    *("scene0200_00", "scene0347_00", "scene0400_00", "scene0590_00", "scene0645_00"),
)


def score_frames(case: Case, result: SceneResult, sheets: Path) -> None:
    """One confusion matrix over the scored frames; `other` is not scored, nor is it asked."""
    classes, answers = case.scene.classes, Answers(case)
    matrix = ConfusionMatrix.empty(len(classes))
    for index, view in enumerate(case.scored):
        truth = resize_nearest(case.scene.need("labels")(view.stem), view.camera.size)
        ours = answers.labels(view, classes)
        matrix.add(ours, truth)
        if index < case.settings.sheets:
            with case.log.stage("draw"):
                draw_labels(sheets / f"{view.stem}.png", photograph_of(case.gaussians, view), truth, ours, classes)
                result.sheets.append(f"{view.stem}.png")
    add_confusion(result, matrix, classes)
    for name in ("coverage", "residual"):
        if name in case.log.error:
            result.figures[name] = case.log.error[name]


def score_points(case: Case, result: SceneResult, sheets: Path) -> None:
    """mIoU and mAcc of the mesh's vertices, for 19, 15 and 10 classes; each asked for by itself."""
    if not case.semantics:
        raise InputError("method '2d' knows no points; profile scannet-3d needs one that lifts")
    points: LabelledPoints = case.scene.need("points")()
    with case.log.stage("match"):
        nearest = nearest_gaussians(case, points.positions)
    for count in SETS:
        with case.log.stage("query"):
            options = {"predicted": case.predicted, "ensemble": case.settings.ensemble}
            names, scoring = set_names(count), case.settings.scoring
            votes = class_votes(case.semantics[0], names, case.text, scoring=scoring, **options).cpu()  # type: ignore[arg-type]
        best, label = votes.max(dim=1)
        ours = torch.where(best > 0, label, -1)[nearest]
        matrix = ConfusionMatrix.empty(count)
        matrix.add(ours[None], set_table(count)[points.labels][None])
        result.figures |= {f"miou_{count}": matrix.miou, f"macc_{count}": matrix.macc}
        if count == max(SETS):
            result.classes, result.confusion = list(names), matrix.counts.tolist()
    result.figures["coverage"] = case.semantics[0].coverage


def nearest_gaussians(case: Case, positions: Tensor) -> Tensor:
    """For each point the nearest Gaussian that is not faint, int64 [P].

    Raises:
        InputError: All are faint, or scipy is not installed.
    """
    try:
        from scipy.spatial import cKDTree
    except ImportError:
        raise InputError("profile scannet-3d needs scipy; run: pip install 'sgwarp[apps]'") from None
    kept = (case.gaussians.opacities.cpu() >= FAINT).nonzero().flatten()
    if not len(kept):
        raise InputError(f"{case.scene.folder}: all Gaussians have an opacity below {FAINT}")
    means = case.gaussians.means.cpu()[kept].numpy()
    _, index = cKDTree(means).query(positions.numpy().astype(np.float64))
    return kept[torch.from_numpy(np.asarray(index, dtype=np.int64))]


def total_scenes(results: Sequence[SceneResult]) -> dict[str, float]:
    """Means of the scenes' own means, as OpenGaussian reports them."""
    return total_means(results)


FRAMES = Profile(
    name="scannet12-2d",
    about="ScanNet, 20 classes of COCO in the frames of 12 scenes (the paper's Table I)",
    reader="scannet",
    score=score_frames,
    total=total_pooled,
    headline=("miou", "macc", "scene_miou", "coverage"),
    scenes=SCENES_12,
    split=split_by_every,
    defaults={"encoder": "lseg:PATH", "every": 5, "views": "released"},
    differences=(
        "all exported frames are scored, every 5th is lifted, as in the paper; --views strict scores only the others",
        "`other` is neither scored nor asked; the paper's release asks for it in a way that favors its own method",
        "one confusion matrix over all scenes; scene_miou is the mean of the scenes' own",
        "labels are resized to the photographs, nearest",
        "closed-set systems were trained for these classes; per-scene ones see the evaluated scene in training",
    ),
)
POINTS = Profile(
    name="scannet-3d",
    about="ScanNet, 19, 15 and 10 classes of nyu40 on the vertices of 10 scenes (OpenGaussian's protocol)",
    reader="scannet",
    score=score_points,
    total=total_scenes,
    headline=("miou_19", "macc_19", "miou_15", "macc_15", "miou_10", "macc_10"),
    scenes=SCENES_10,
    split=split_without_views,
    defaults={"encoder": "lseg:PATH", "every": 5},
    differences=(
        "OpenGaussian keeps one Gaussian per vertex; here a vertex takes its nearest Gaussian of opacity 0.1 or more",
        "means over the classes present in a scene, then over scenes",
        "rows of Quantile Rendering, PanoGS and OnlinePG follow other protocols or learn across scenes",
    ),
)
