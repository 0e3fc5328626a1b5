"""Profiles `lerf-ovs-loc`, `lerf-ovs-seg` and `lerf-ovs-3d`: phrases in the four scenes that LangSplat annotated."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from sgwarp.datasets.base import Query
from sgwarp.errors import InputError
from sgwarp.evaluation.answers import Answers
from sgwarp.evaluation.cases import Case, split_by_label
from sgwarp.evaluation.profiles.base import Profile, total_of_values
from sgwarp.evaluation.results import SceneResult
from sgwarp.evaluation.sheets import draw_query, photograph_of
from sgwarp.metrics.overlap import accuracy_at, mask_iou, mean
from sgwarp.metrics.relevancy_maps import hits_any_box, locate, to_mask
from sgwarp.querying.scoring import score_texts
from sgwarp.rendering.renderer import render
from sgwarp.scene import View

SCENES = ("figurines", "ramen", "teatime", "waldo_kitchen")
GRAY_ABOVE = 10 / 255  # of a rendering of the selection alone (OpenGaussian)
GRAY = (0.299, 0.587, 0.114)  # of red, green and blue (ITU-R 601)

QUERIES = (
    "queries: 56 in figurines, 71 in ramen, 59 in teatime, 22 in waldo_kitchen; the headline is the mean of scenes"
)
RELEASED = (
    "views: the published scripts lift (or train on) the annotated photographs as well; here they are left out, unless "
    "--views released"
)
ENCODER = (
    "published figures use OpenCLIP ViT-B-16 laion2b_s34b_b88k on SAM masks of three levels, bare labels as phrases"
)
SCORES = "LangSplat compares rendered features with phrases; here scores of Gaussians are rendered (paper, Sec. III-D)"


def queries_by_view(case: Case) -> Iterator[tuple[View, list[Query]]]:
    """Scored views at the size of their annotations, with their queries.

    Raises:
        InputError: Annotations of one view differ in size.
    """
    found: dict[str, list[Query]] = defaultdict(list)
    for query in case.scene.need("queries")():
        found[query.stem].append(query)
    for view in case.scored:
        queries = found.get(view.stem, [])
        if len({query.size for query in queries}) > 1:
            raise InputError(f"{case.scene.folder}: masks of view {view.stem} differ in size; store them in one size")
        if queries:
            yield replace(view, camera=view.camera.resized(*queries[0].size)), queries


def all_texts(case: Case) -> list[str]:
    """Every phrase of a scene once, in the order of the annotations."""
    return list(dict.fromkeys(query.text for query in case.scene.need("queries")()))


def image_at(case: Case, view: View) -> Tensor:
    """The photograph at the size of an annotation, float32 [H, W, 3]."""
    source = next(one for one in case.scored if one.stem == view.stem)
    image = photograph_of(case.gaussians, source).permute(2, 0, 1)[None]
    return torch.nn.functional.interpolate(image, view.camera.size, mode="area")[0].permute(1, 2, 0)


def score_maps(case: Case, result: SceneResult, sheets: Path) -> None:
    """Location and mask of every query out of relevancy maps by level."""
    answers, texts = Answers(case), all_texts(case)
    located, ious = [], []
    for view, queries in queries_by_view(case):
        maps = answers.relevancy(view, [query.text for query in queries], texts)
        for index, query in enumerate(queries):
            with case.log.stage("measure"):
                truth, place = query.mask(), locate(maps[:, index])
                mask, level = to_mask(maps[:, index])
                boxes = query.boxes if len(query.boxes) else _box_of(truth)
                located.append(float(hits_any_box(place.pixels, boxes)))
                ious.append(mask_iou(mask, truth))
            result.per_class[f"{query.text} ({view.stem})"] = {"located": located[-1], "iou": ious[-1]}
            pixel = (int(place.pixels[0, 0]), int(place.pixels[0, 1]))
            add_sheet(case, result, sheets, view, truth, maps[level, index], mask, pixel)
    put_queries(result, located=located, iou=ious)


def score_selection(case: Case, result: SceneResult, sheets: Path) -> None:
    """IoU of every query's selected Gaussians, rendered alone: what is brighter than 10 of 255 is the mask."""
    if not case.semantics:
        raise InputError("method '2d' selects no Gaussians; profile lerf-ovs-3d needs one that lifts")
    texts = all_texts(case)
    with case.log.stage("query"):
        options = {"predicted": case.predicted, "ensemble": case.settings.ensemble}
        scores = [
            score_texts(one, texts, case.text, measure="relevancy", **options).values  # type: ignore[arg-type]
            for one in case.semantics
        ]
        best = torch.stack(scores).amax(dim=0)
    ious = []
    for view, queries in queries_by_view(case):
        for query in queries:
            with case.log.stage("answer"):
                chosen = best[:, texts.index(query.text)] > case.settings.threshold
                mask = selection_mask(case, view, chosen)
            ious.append(mask_iou(mask, query.mask()))
            result.per_class[f"{query.text} ({view.stem})"] = {
                "iou": ious[-1],
                "selected": float(chosen.float().mean()),
            }
            if len(result.sheets) < case.settings.sheets:
                with case.log.stage("draw"):
                    column = best[:, texts.index(query.text)].clamp(0, 1)[:, None]
                    shown = render(case.gaussians, view.camera, "features", column)[..., 0].cpu()
                add_sheet(case, result, sheets, view, query.mask(), shown, mask)
    put_queries(result, iou=ious)


def selection_mask(case: Case, view: View, chosen: Tensor) -> Tensor:
    """Pixels that the chosen Gaussians alone, on black, make brighter than 10 of 255, bool [H, W]."""
    if not bool(chosen.any()):
        return torch.zeros(view.camera.size, dtype=torch.bool)
    picture = render(case.gaussians.subset(chosen), view.camera).cpu().clamp(0, 1)
    return (picture * torch.tensor(GRAY)).sum(dim=2) > GRAY_ABOVE


def add_sheet(
    case: Case,
    result: SceneResult,
    sheets: Path,
    view: View,
    truth: Tensor,
    scores: Tensor,
    mask: Tensor,
    pixel: tuple[int, int] | None = None,
) -> None:
    """Draw a query beside its truth, unless the scene has as many sheets as were asked for."""
    if len(result.sheets) < case.settings.sheets:
        with case.log.stage("draw"):
            name = f"{view.stem}_{len(result.sheets)}.png"
            draw_query(sheets / name, image_at(case, view), truth, scores, mask, pixel)
            result.sheets.append(name)


def put_queries(result: SceneResult, **values: list[float]) -> None:
    """Outcomes of queries and their means into a record; of IoUs also the share above 0.25 and 0.5."""
    for name, each in values.items():
        result.values[name] = each
        result.figures[name] = mean(each)
        if name == "iou":
            result.figures |= {"acc_25": accuracy_at(each, 0.25), "acc_50": accuracy_at(each, 0.5)}


def _box_of(mask: Tensor) -> Tensor:
    """The box around a mask, [1, 4]; none around an empty one."""
    rows, columns = mask.nonzero(as_tuple=True)
    if not len(rows):
        return torch.zeros(0, 4)
    return torch.tensor([[columns.min(), rows.min(), columns.max(), rows.max()]], dtype=torch.float32)


LOCATION = Profile(
    name="lerf-ovs-loc",
    about="LERF-OVS, location of phrases: the best pixel of the averaged relevancy map lies in a box of the object",
    reader="lerf-ovs",
    score=score_maps,
    total=total_of_values,
    headline=("located", "micro_located"),
    scenes=SCENES,
    split=split_by_label,
    defaults={"encoder": "clip:PATH+sam:PATH"},
    differences=(QUERIES, RELEASED, ENCODER, SCORES, "the paper's ramen and figurines figures are probably swapped"),
)
SEGMENTATION = Profile(
    name="lerf-ovs-seg",
    about="LERF-OVS, masks of phrases: the stretched relevancy map above 0.4, majority of 7 x 7",
    reader="lerf-ovs",
    score=score_maps,
    total=total_of_values,
    headline=("iou", "micro_iou", "located", "acc_25", "acc_50"),
    scenes=SCENES,
    split=split_by_label,
    defaults={"encoder": "clip:PATH+sam:PATH"},
    differences=(QUERIES, RELEASED, ENCODER, SCORES, "LangSplatV2 reports means over all queries (micro)"),
)
SELECTION = Profile(
    name="lerf-ovs-3d",
    about="LERF-OVS, selection in 3D: the selected Gaussians are rendered alone and compared with the masks",
    reader="lerf-ovs",
    score=score_selection,
    total=total_of_values,
    headline=("iou", "acc_25", "acc_50", "micro_iou"),
    scenes=SCENES,
    split=split_by_label,
    defaults={"encoder": "clip:PATH+sam:PATH"},
    differences=(
        QUERIES,
        RELEASED,
        ENCODER,
        "selection: Gaussians above one threshold on a scale from the scene's median to its best thousandth; others "
        "select clusters or instances first",
        "published tables differ by about 3 between scripts",
    ),
)
