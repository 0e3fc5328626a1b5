"""A scene ready to be asked: Gaussians, views that were lifted, views to score, semantics, encoders."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch

from sgwarp.datasets.base import SceneData
from sgwarp.encoders.base import MapSource, TextEncoder
from sgwarp.encoders.maps.files import LABEL_SPACE
from sgwarp.encoders.registry import make_encoder, text_encoder_for
from sgwarp.errors import InputError
from sgwarp.evaluation.methods import find_method
from sgwarp.evaluation.settings import Settings
from sgwarp.evaluation.truth_maps import TruthMaps, noise_of
from sgwarp.io.scenes import load_gaussians
from sgwarp.io.store import load_semantics, read_notes
from sgwarp.reconstruction.depth import gaussians_from_depth
from sgwarp.runs.log import RunLog
from sgwarp.scene import Gaussians, Semantics, View

Split = Callable[[SceneData, Sequence[View], Settings], tuple[list[View], list[View]]]  # to lift from, to score


@dataclass(eq=False)
class Case:
    """One scene under one set of choices.

    Attributes:
        scene: The data.
        settings: The choices.
        gaussians: The trained scene, on the device.
        lifted: Views that were lifted from.
        scored: Views to score.
        log: Stages, seconds, figures.
        sources: Of 2D semantics, one per level.
        semantics: One per level; none for a method that answers from single views.
        predicted: By the network, or None.
        text: Encoder of phrases; None for labels.
    """

    scene: SceneData
    settings: Settings
    gaussians: Gaussians
    lifted: list[View]
    scored: list[View]
    log: RunLog
    sources: list[MapSource] = field(default_factory=list)
    semantics: list[Semantics] = field(default_factory=list)
    predicted: Semantics | None = None
    text: TextEncoder | None = None

    @property
    def bytes_per_gaussian(self) -> float:
        """Of the semantics, features and weights; 0 if there are none."""
        tensors = [t for one in self.semantics for t in (one.features, one.weight, one.effective_views)]
        return sum(t.numel() * t.element_size() for t in tensors) / max(1, len(self.gaussians))


def prepare(scene: SceneData, settings: Settings, split: Split, log: RunLog) -> Case:
    """Read a scene, lift into it, and load what is needed to ask.

    Raises:
        InputError: Views, Gaussians, an encoder or the method is missing or does not fit.
    """
    case = read_case(scene, settings, split, log)
    gaussians = case.gaussians
    if settings.predicted:
        case.predicted = _on(load_semantics(in_scene(settings.predicted, scene), gaussians), gaussians, scene)
        case.predicted.require_scene(gaussians)
    if settings.semantics:
        path = in_scene(settings.semantics, scene)
        case.semantics = [_on(load_semantics(path, gaussians), gaussians, scene)]
        log.error["coverage"] = case.semantics[0].coverage
        case.text = _text(case.semantics[0].space, read_notes(path).get("encoder"), settings)
        return case
    _lift(case)
    return case


def read_case(scene: SceneData, settings: Settings, split: Split, log: RunLog) -> Case:
    """Views and Gaussians of a scene; nothing is lifted.

    Raises:
        InputError: They are missing or do not fit.
    """
    with log.stage("read"):
        views = scene.need("views")()
        lifted, scored = split(scene, views, settings)
    gaussians = _gaussians(scene, settings, lifted, log)
    return Case(scene, settings, gaussians, lifted, scored, log)


def _lift(case: Case) -> None:
    settings, scene, log = case.settings, case.scene, case.log
    method = find_method(settings.method)
    with log.stage("load_encoder"):
        names = [settings.encoder.replace("{level}", level) for level in settings.levels] or [settings.encoder]
        case.sources = [_source(name, scene, case.lifted + case.scored, settings) for name in names]
    space = case.sources[0].space
    if space != LABEL_SPACE:
        with log.stage("load_encoder"):
            case.text = _text(space, names[0], settings)
    if method.kind == "images":
        return
    if not case.lifted:
        raise InputError(f"{scene.folder}: scene {scene.name} has no view left to lift from; lower --hold-out")
    chosen = _share(case.lifted, settings.share_of_views)
    for source in case.sources:
        lifted = method.lifting()(case.gaussians, chosen, source, log=log)
        case.semantics.append(_on(lifted, case.gaussians, scene))


def _source(name: str, scene: SceneData, views: list[View], settings: Settings) -> MapSource:
    noise = noise_of(name)
    if noise is not None:
        return TruthMaps(scene, noise, settings.seed)
    name = name.replace("{scene}", scene.name).replace("{path}", str(scene.folder))
    return make_encoder(name, views, settings.device, settings.cache)


def _text(space: str, encoder: str | None, settings: Settings) -> TextEncoder | None:
    if space == LABEL_SPACE:
        return None
    return text_encoder_for(space, encoder, settings.device)


def _gaussians(scene: SceneData, settings: Settings, views: list[View], log: RunLog) -> Gaussians:
    """The trained scene, or one made of depth; a share of it if asked for."""
    path = in_scene(settings.gaussians, scene) if settings.gaussians else scene.gaussians
    if path is not None:
        with log.stage("read"):
            gaussians = load_gaussians(path)
    elif scene.load_depth is not None:
        with log.stage("gaussians_from_depth"):
            gaussians = gaussians_from_depth(views, scene.load_depth, count=settings.count)
    else:
        raise InputError(
            f"{scene.folder}: scene {scene.name} has no trained Gaussians and no depth; fit it with `sgwarp fit` and "
            "name the result with --gaussians, such as fitted/{scene}/scene.ply"
        )
    return _subset(gaussians, settings, log).to(settings.device)


def _subset(gaussians: Gaussians, settings: Settings, log: RunLog) -> Gaussians:
    share = settings.share_of_gaussians
    if share == 1:
        return gaussians
    kept = torch.randperm(len(gaussians), generator=torch.Generator().manual_seed(settings.seed))
    kept = kept[: max(1, round(share * len(gaussians)))].sort().values
    log.leave_out("gaussians_by_share", len(gaussians) - len(kept))
    part = gaussians.subset(kept)
    # A surface that keeps its area has 1/share as much of it per Gaussian: the standard deviation grows by the root.
    return Gaussians(part.means, part.quats, part.scales * share**-0.5, part.opacities, part.sh, part.extras)


def _share(views: list[View], share: float) -> list[View]:
    count = max(1, round(share * len(views)))
    return [views[i * len(views) // count] for i in range(count)]


def in_scene(pattern: str, scene: SceneData) -> Path:
    """A name of a file with the scene's name and folder put in."""
    names = {"{scene}": scene.name, "{path}": str(scene.folder), "{file}": scene.name.replace("/", "__")}
    for mark, value in names.items():
        pattern = pattern.replace(mark, value)
    return Path(pattern)


def _on(semantics: Semantics, gaussians: Gaussians, scene: SceneData) -> Semantics:
    names = ("features", "weight", "effective_views")
    moved = {name: getattr(semantics, name).to(gaussians.device) for name in names}
    labels = None if semantics.labels is None else named_labels(semantics.labels, scene.classes)
    return replace(semantics, **moved, labels=labels)


def named_labels(labels: Sequence[str], classes: Sequence[str]) -> tuple[str, ...]:
    """Labels by name, where they are the ids that a data set stores: class k has id k + 1."""
    ids = [int(label) for label in labels if label.isdecimal()]
    if not classes or len(ids) < len(labels) or max(ids, default=0) > len(classes) or set(labels) <= set(classes):
        return tuple(labels)
    return tuple(classes[number - 1] for number in ids)


def split_by_number(scene: SceneData, views: Sequence[View], settings: Settings) -> tuple[list[View], list[View]]:
    """Every `hold_out`-th view is scored and not lifted; with views="released", it is lifted, too.

    Raises:
        InputError: None of them is labelled.
    """
    scored = [view for index, view in enumerate(views) if index % settings.hold_out == 0]
    labelled = [view for view in scored if view.stem in scene.labelled]
    if not labelled:
        raise InputError(f"{scene.folder}: scene {scene.name} has no label image of a view to score; see `sgwarp info`")
    return _train(views, scored, settings), labelled


def split_by_label(scene: SceneData, views: Sequence[View], settings: Settings) -> tuple[list[View], list[View]]:
    """Labelled views are scored; with views="strict", they are not lifted.

    Raises:
        InputError: No label belongs to a view.
    """
    named = set(scene.labelled)
    scored = [view for view in views if view.stem in named]
    if not scored:
        some = ", ".join(scene.labelled[:3]) or "none"
        raise InputError(f"{scene.folder}: no view has the name of a labelled one ({some}); rename one of them")
    return _train(views, scored, settings), scored


def split_by_every(scene: SceneData, views: Sequence[View], settings: Settings) -> tuple[list[View], list[View]]:
    """Every `every`-th view is lifted; all labelled ones are scored, with views="strict" only those not lifted.

    Raises:
        InputError: None is left to score.
    """
    lifted = list(views[:: settings.every])
    stems = {view.stem for view in lifted} if settings.views == "strict" else set()
    scored = [view for view in views if view.stem in scene.labelled and view.stem not in stems]
    if not scored:
        raise InputError(f"{scene.folder}: scene {scene.name} has no labelled view that is not lifted; raise --every")
    return lifted, scored


def split_without_views(scene: SceneData, views: Sequence[View], settings: Settings) -> tuple[list[View], list[View]]:
    """Every `every`-th view is lifted; none is scored: the truth is in 3D."""
    return list(views[:: settings.every]), []


def _train(views: Sequence[View], scored: Sequence[View], settings: Settings) -> list[View]:
    stems = set() if settings.views == "released" else {view.stem for view in scored}
    return [view for view in views if view.stem not in stems][:: settings.every]
