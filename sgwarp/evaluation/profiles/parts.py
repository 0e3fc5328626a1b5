"""Profile `parts`: parts of single objects (MVImgNet). Drawn parts are scored; without any, views are compared."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from sgwarp.datasets.base import SceneData, resize_nearest
from sgwarp.errors import InputError
from sgwarp.evaluation.answers import Answers
from sgwarp.evaluation.cases import Case, split_by_label
from sgwarp.evaluation.profiles.base import Profile, add_confusion, total_means
from sgwarp.evaluation.results import SceneResult
from sgwarp.evaluation.settings import Settings
from sgwarp.evaluation.sheets import draw_labels, photograph_of
from sgwarp.metrics.segmentation import ConfusionMatrix
from sgwarp.rendering.renderer import render
from sgwarp.scene import View

AGREES = 0.05  # relative difference of two depths of one point
STEP = 2  # of the grid of pixels that are carried over


def split_parts(scene: SceneData, views: Sequence[View], settings: Settings) -> tuple[list[View], list[View]]:
    """Views with drawn parts are scored; if there are none, every `hold_out`-th is looked at."""
    if scene.labelled:
        return split_by_label(scene, views, settings)
    looked = list(views[:: settings.hold_out])
    return [view for view in views if settings.views == "released" or view not in looked][:: settings.every], looked


def score_parts(case: Case, result: SceneResult, sheets: Path) -> None:
    """Parts of the scored views, and how far successive views agree on the part of one point."""
    classes = case.settings.classes or case.scene.classes
    if not classes:
        raise InputError(f"{case.scene.folder}: names no parts; say --classes, such as seat,leg,back")
    answers = Answers(case)
    labels = {view.stem: answers.labels(view, classes) for view in case.scored}
    if case.scene.load_labels is not None and classes == case.scene.classes:
        matrix = ConfusionMatrix.empty(len(classes))
        for view in case.scored:
            truth = resize_nearest(case.scene.load_labels(view.stem), view.camera.size)
            matrix.add(labels[view.stem], truth)
            _draw(case, result, sheets, view, truth, labels[view.stem], classes)
        add_confusion(result, matrix, classes)
    with case.log.stage("compare_views"):
        pairs = zip(case.scored, case.scored[1:], strict=False)
        agreed = [agreement(case, one, other, labels) for one, other in pairs]
    same, compared = (sum(each) for each in zip(*agreed, strict=True)) if agreed else (0, 0)
    result.figures["agreement"] = same / compared if compared else float("nan")
    result.figures["unlabelled"] = float(torch.stack([(one < 0).float().mean() for one in labels.values()]).mean())


def agreement(case: Case, one: View, other: View, labels: dict[str, Tensor]) -> tuple[int, int]:
    """Points that both views see with one part, and points that both see with any."""
    depths = [render(case.gaussians, view.camera, "depth").cpu() for view in (one, other)]
    height, width = one.camera.size
    y, x = torch.meshgrid(torch.arange(0, height, STEP), torch.arange(0, width, STEP), indexing="ij")
    z = depths[0][y, x].double().flatten()
    pixels = torch.stack([x + 0.5, y + 0.5, torch.ones_like(x)], dim=2).double().reshape(-1, 3)
    world = (z[:, None] * (pixels @ torch.linalg.inv(one.camera.K).T) - one.camera.world_to_camera[:3, 3]) @ (
        one.camera.world_to_camera[:3, :3]
    )
    seen = world @ other.camera.world_to_camera[:3, :3].T + other.camera.world_to_camera[:3, 3]
    place = (seen / seen[:, 2:].clamp(min=1e-9)) @ other.camera.K.T
    u, v = place[:, 0].floor().long(), place[:, 1].floor().long()
    inside = (z > 0) & (seen[:, 2] > 0) & (u >= 0) & (v >= 0) & (u < other.camera.width) & (v < other.camera.height)
    u, v = u.clamp(0, other.camera.width - 1), v.clamp(0, other.camera.height - 1)
    visible = inside & ((depths[1][v, u] - seen[:, 2]).abs() <= AGREES * seen[:, 2])
    first, second = labels[one.stem][y, x].flatten(), labels[other.stem][v, u]
    known = visible & (first >= 0) & (second >= 0)
    return int((first[known] == second[known]).sum()), int(known.sum())


def _draw(
    case: Case, result: SceneResult, sheets: Path, view: View, truth: Tensor, ours: Tensor, classes: Sequence[str]
) -> None:
    if len(result.sheets) < case.settings.sheets:
        with case.log.stage("draw"):
            draw_labels(sheets / f"{view.stem}.png", photograph_of(case.gaussians, view), truth, ours, classes)
            result.sheets.append(f"{view.stem}.png")


PARTS = Profile(
    name="parts",
    about="MVImgNet, parts of single objects: drawn parts if there are any, agreement of views in any case",
    reader="mvimgnet",
    score=score_parts,
    total=total_means,
    headline=("miou", "macc", "agreement", "unlabelled"),
    split=split_parts,
    defaults={"encoder": "vlpart:DIR", "hold_out": 4},
    differences=(
        "MVImgNet has no true parts, and the paper shows pictures only: agreement is the share of points that two "
        "successive views see as the same part; --method 2d gives the encoder's own",
    ),
)
