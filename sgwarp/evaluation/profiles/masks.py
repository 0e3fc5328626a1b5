"""Profiles `lerf-mask`, `nvos` and `spin-nerf`: masks of phrases, and of objects that somebody drew on in one view."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from sgwarp.datasets.base import Scribbles, resize_nearest
from sgwarp.errors import InputError
from sgwarp.evaluation.answers import Answers
from sgwarp.evaluation.cases import Case, split_by_label
from sgwarp.evaluation.profiles.base import Profile, total_means, total_of_values
from sgwarp.evaluation.profiles.lerf_ovs import add_sheet, all_texts, put_queries, queries_by_view
from sgwarp.evaluation.results import SceneResult
from sgwarp.lifting.lifter import lift
from sgwarp.metrics.overlap import boundary_iou, macro, mask_iou, mean
from sgwarp.querying.scoring import score_texts
from sgwarp.querying.segmentation import splat_scores
from sgwarp.scene import FeatureMap, View

RELEVANT = 0.5  # relevancy of a pixel that fits a phrase better than any canonical one


def score_phrases(case: Case, result: SceneResult, sheets: Path) -> None:
    """IoU and boundary IoU of every phrase: the mean over its views first, then over the phrases."""
    texts = all_texts(case)
    ious: dict[str, list[float]] = defaultdict(list)
    boundaries: dict[str, list[float]] = defaultdict(list)
    answers = Answers(case)
    values = score_texts(case.semantics[0], texts, case.text).values if case.semantics else None
    for view, queries in queries_by_view(case):
        for query in queries:
            with case.log.stage("answer"):
                scores, above = _scores(case, answers, view, query.text, texts, values)
            mask, truth = scores > above, query.mask()
            ious[query.text].append(mask_iou(mask, truth))
            boundaries[query.text].append(boundary_iou(mask, truth))
            add_sheet(case, result, sheets, view, truth, scores, mask)
    result.values |= {"iou": [mean(each) for each in ious.values()]}
    result.figures |= {"iou": macro(ious), "boundary_iou": macro(boundaries)}
    result.per_class = {name: {"iou": mean(ious[name]), "boundary_iou": mean(boundaries[name])} for name in ious}


def _scores(
    case: Case, answers: Answers, view: View, text: str, texts: Sequence[str], values: Tensor | None
) -> tuple[Tensor, float]:
    """Score of a phrase at each pixel [H, W], and above which it is the object."""
    if values is None:
        return answers.relevancy(view, [text])[:, 0].amax(dim=0), RELEVANT
    column = values[:, [texts.index(text)]]
    mean_score, known = splat_scores(case.gaussians, view.camera, column, case.semantics[0].seen)
    return torch.where(known, mean_score[..., 0], 0.0).cpu(), case.settings.threshold


def score_strokes(case: Case, result: SceneResult, sheets: Path) -> None:
    """IoU and accuracy of the object that strokes on one view mean, in the views with a true mask."""
    if not case.semantics:
        raise InputError("method '2d' carries nothing from one view to another; choose one that lifts")
    strokes = case.scene.need("scribbles")()
    with case.log.stage("query"):
        scores = stroke_scores(case, strokes)
    ious, accuracies = [], []
    for view, queries in queries_by_view(case):
        if view.stem == strokes.stem:
            continue
        for query in queries:
            with case.log.stage("answer"):
                mean_score, known = splat_scores(case.gaussians, view.camera, scores[:, None], case.semantics[0].seen)
                shown = torch.where(known, mean_score[..., 0], -1.0).cpu()
            mask, truth = shown > 0, query.mask()
            ious.append(mask_iou(mask, truth))
            accuracies.append(float((mask == truth).float().mean()))
            add_sheet(case, result, sheets, view, truth, shown, mask)
    if not ious:
        raise InputError(f"{case.scene.folder}: scene {case.scene.name} has no view to score but the one drawn on")
    put_queries(result, iou=ious, accuracy=accuracies)


def stroke_scores(case: Case, strokes: Scribbles) -> Tensor:
    """How much more each Gaussian is like what lies under the positive strokes than under the negative ones, [N].

    Each stroke gives the mean feature of the Gaussians that it covers, by their weight at its pixels; a score is the
    difference of the cosines with the two.

    Raises:
        InputError: The view that was drawn on is not there.
    """
    view = next((one for one in case.lifted + case.scored if one.stem == strokes.stem), None)
    if view is None:
        raise InputError(f"{case.scene.folder}: the view that is drawn on, {strokes.stem}, is not among the views")
    ids = torch.full(strokes.positive.shape, -1, dtype=torch.int64)
    ids[resize_nearest(strokes.negative, ids.shape)] = 1  # type: ignore[arg-type]
    ids[strokes.positive] = 0
    drawn = lift(case.gaussians, [view], {view.stem: FeatureMap("labels", ids=ids, labels=("yes", "no"))})
    weights = drawn.features * drawn.weight[:, None]  # [N, 2]
    features = torch.nn.functional.normalize(case.semantics[0].features.float(), dim=1)
    prototypes = torch.nn.functional.normalize(weights.T @ features, dim=1)  # [2, C]
    cosines = features @ prototypes.T
    return cosines[:, 0] - cosines[:, 1]


LERF_MASK = Profile(
    name="lerf-mask",
    about="LERF-Mask: masks of phrases in test views, IoU and boundary IoU",
    reader="lerf-mask",
    score=score_phrases,
    total=total_means,
    headline=("iou", "boundary_iou"),
    scenes=("figurines", "ramen", "teatime"),
    split=split_by_label,
    defaults={"encoder": "clip:PATH+sam:PATH", "sheets": 4},
    differences=(
        "a phrase counts once: the mean over its views first, then over phrases, then over scenes",
        "Gaussian Grouping finds the first mask of a phrase with GroundingDINO and SAM; here the phrase alone is asked",
        "boundaries are 0.02 of the diagonal wide",
    ),
)
NVOS = Profile(
    name="nvos",
    about="NVOS: the object that strokes on one view mean, in another view",
    reader="nvos",
    score=score_strokes,
    total=total_of_values,
    headline=("iou", "accuracy"),
    split=split_by_label,
    defaults={"encoder": "conse"},
    differences=(
        "published systems turn strokes into points for SAM; here strokes select by lifted features alone",
        "the view that is drawn on is lifted, the scored one is not unless --views released",
    ),
)
SPIN_NERF = Profile(
    name="spin-nerf",
    about="SPIn-NeRF: the object that the mask of the first view means, in the others",
    reader="spin-nerf",
    score=score_strokes,
    total=total_of_values,
    headline=("iou", "accuracy"),
    split=split_by_label,
    defaults={"encoder": "conse", "views": "released"},
    differences=("all views are lifted; published systems train on all of them, too",),
)
