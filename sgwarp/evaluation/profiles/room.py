"""Profile `room`: a labelled folder, such as a rendered room. All classes in held-out views, and the place of each."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from sgwarp.datasets.base import resize_nearest
from sgwarp.evaluation.answers import Answers, askable
from sgwarp.evaluation.cases import Case
from sgwarp.evaluation.profiles.base import Profile, add_confusion, total_of_values, total_pooled
from sgwarp.evaluation.results import SceneResult
from sgwarp.evaluation.sheets import draw_labels, photograph_of
from sgwarp.lifting.residuals import residual
from sgwarp.metrics.localization import hits_mask
from sgwarp.metrics.overlap import mean
from sgwarp.metrics.segmentation import ConfusionMatrix
from sgwarp.querying.scores import class_votes
from sgwarp.querying.scoring import score_texts
from sgwarp.querying.segmentation import BOX, box_mean, splat_scores

SMALLEST = 50  # an object with fewer pixels in a view is not looked for there
TRUTH_COLUMN = "label"  # of the scene's PLY file: true class of each Gaussian, from 0


def score_room(case: Case, result: SceneResult, sheets: Path) -> None:
    """Segment the scored views; look for each class where it shows; compare the Gaussians' own classes, if known."""
    classes, answers = case.scene.classes, Answers(case)
    matrix = ConfusionMatrix.empty(len(classes))
    truths: dict[str, Tensor] = {}
    for index, view in enumerate(case.scored):
        truth = resize_nearest(case.scene.need("labels")(view.stem), view.camera.size)
        ours = answers.labels(view, classes)
        matrix.add(ours, truth)
        truths[view.stem] = truth
        if index < case.settings.sheets:
            with case.log.stage("draw"):
                path = sheets / f"{view.stem}.png"
                draw_labels(path, photograph_of(case.gaussians, view), truth, ours, classes)
                result.sheets.append(path.name)
    add_confusion(result, matrix, classes)
    if case.semantics:
        hits = _locate(case, truths)
        result.values["located"] = hits
        result.figures["located"] = sum(hits) / len(hits) if hits else float("nan")
        result.figures |= _of_gaussians(case)
        result.figures["held_out_residual"] = held_out_residual(case)
    for name in ("coverage", "residual"):
        if name in case.log.error:
            result.figures[name] = case.log.error[name]


def _locate(case: Case, truths: dict[str, Tensor]) -> list[float]:
    """Whether the best pixel of each class lies on it, in each scored view that shows it."""
    hits = []
    asked = askable(case.semantics[0], case.scene.classes)
    with case.log.stage("locate"):
        options = {"predicted": case.predicted, "ensemble": case.settings.ensemble}
        scores = score_texts(case.semantics[0], asked, case.text, **options)  # type: ignore[arg-type]
        for view in case.scored:
            shown, known = splat_scores(case.gaussians, view.camera, scores.values, scores.seen)
            for channel, name in enumerate(asked):
                mask = truths[view.stem] == case.scene.classes.index(name)
                if int(mask.sum()) >= SMALLEST:
                    smooth = torch.where(known, box_mean(shown[..., channel], known, BOX), -torch.inf).cpu()
                    y, x = divmod(int(smooth.argmax()), view.camera.width)
                    hits.append(float(hits_mask((x, y), mask)))
    return hits


def held_out_residual(case: Case) -> float:
    """How far the lifted features, rendered into the scored views, miss the 2D maps of those: see `residual`."""
    if not case.sources:
        return float("nan")
    semantics, source, missed = case.semantics[0], case.sources[0], []
    for view in case.scored:
        image = photograph_of(case.gaussians, view) if source.needs_image else None
        with case.log.stage("encode"):
            found = source.encode(view, image)
        with case.log.stage("residual"):
            seen = semantics.seen.to(torch.float32)
            missed.append(residual(case.gaussians, view.camera, found, semantics.features.float(), seen))
    return mean(missed)


def _of_gaussians(case: Case) -> dict[str, float]:
    """Share of the Gaussians with the right class, over those of which it is known; an unseen one is wrong."""
    column = (case.gaussians.extras or {}).get(TRUTH_COLUMN)
    if column is None:
        return {}
    truth = torch.as_tensor(column).long()
    options = {"predicted": case.predicted, "ensemble": case.settings.ensemble, "scoring": case.settings.scoring}
    asked = askable(case.semantics[0], case.scene.classes)
    votes = class_votes(case.semantics[0], asked, case.text, **options)  # type: ignore[arg-type]
    best, column = votes.cpu().max(dim=1)
    channel = torch.tensor([case.scene.classes.index(name) for name in asked])[column]
    known = (truth >= 0) & (truth < len(case.scene.classes))
    right = (channel == truth) & (best > 0)
    return {"accuracy_3d": float(right[known].float().mean()) if bool(known.any()) else float("nan")}


def total_room(results: Sequence[SceneResult]) -> dict[str, float]:
    """One confusion matrix over rooms of the same classes; locations and the rest as means of the rooms."""
    whole = total_pooled(results)
    return total_of_values(results) | whole


ROOM = Profile(
    name="room",
    about="labelled folders, such as rendered rooms: segmentation and location in held-out views",
    reader="folder",
    score=score_room,
    total=total_room,
    headline=("miou", "macc", "located", "coverage", "residual"),
    differences=("no published protocol: every 8th view is held out, all classes are scored, void is not",),
)
