"""Profile `panoptic-4d`: labels of a moving scene, frame by frame, in cameras that were not lifted from."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sgwarp.apps.tracking.answers import Questions, answer
from sgwarp.apps.tracking.fusion import FusionSettings
from sgwarp.apps.tracking.sources import NamedSource, open_source
from sgwarp.apps.tracking.tracker import Tracker, TrackSettings, count_frames
from sgwarp.datasets.base import SceneData, resize_nearest
from sgwarp.datasets.moving import with_label_noise
from sgwarp.encoders.maps.files import LABEL_SPACE
from sgwarp.encoders.registry import encoder_of_questions, make_encoder
from sgwarp.errors import InputError
from sgwarp.evaluation.cases import Split, split_without_views
from sgwarp.evaluation.profiles.base import Profile, add_confusion, total_pooled
from sgwarp.evaluation.results import SceneResult
from sgwarp.evaluation.settings import Settings
from sgwarp.evaluation.sheets import draw_labels, photograph_of
from sgwarp.evaluation.truth_maps import noise_of
from sgwarp.files.images import read_ids
from sgwarp.io.moving_views import FrameView, MovingViews, load_moving_views
from sgwarp.io.sequences import GaussianSequence, load_sequence
from sgwarp.metrics.segmentation import ConfusionMatrix
from sgwarp.metrics.tracking import identity_switches, matches
from sgwarp.runs.log import RunLog
from sgwarp.scene import FeatureMap, View

UNKNOWN = 255  # of a class image


@dataclass(eq=False)
class MovingCase:
    """A moving scene ready to be asked."""

    scene: SceneData
    settings: Settings
    sequence: GaussianSequence
    views: MovingViews
    asked: MovingViews
    source: NamedSource
    log: RunLog
    gaussians: Any = ()
    lifted: list[FrameView] = field(default_factory=list)
    scored: list[FrameView] = field(default_factory=list)
    bytes_per_gaussian: float = 0.0


class TrueFrames:
    """Drawn labels of every frame and view as maps, with a share of their regions wrong."""

    needs_image = False
    of_space = LABEL_SPACE

    def __init__(self, scene: SceneData, noise: float, seed: int) -> None:
        self.scene, self.noise, self.seed = scene, noise, seed

    def encode(self, frame: int, view: FrameView, image: Tensor | None) -> FeatureMap:
        """The labels of a view at a frame."""
        labels = true_labels(self.scene, frame, view.view)
        if self.noise:
            key = zlib.crc32(f"{frame} {view.view.stem}".encode())
            random = torch.Generator().manual_seed(self.seed * 1_000_003 + key)
            labels = with_label_noise(labels, self.noise, random, len(self.scene.classes))
        names = tuple(str(number + 1) for number in range(len(self.scene.classes)))
        return FeatureMap(LABEL_SPACE, ids=labels - 1, labels=names)


def true_labels(scene: SceneData, frame: int, view: View) -> Tensor:
    """Drawn ids of a view at a frame, 0 = nothing, int64 [h, w]."""
    return torch.from_numpy(read_ids(scene.folder / "truth" / f"{frame:05d}" / f"{view.stem}.png")).long()


def open_moving(scene: SceneData, settings: Settings, split: Split, log: RunLog) -> Any:
    """Gaussians, cameras and maps of a moving scene; test cameras are scored if there are some.

    Raises:
        InputError: The Gaussians or drawn labels are missing.
    """
    if scene.gaussians is None:
        raise InputError(f"{scene.folder}: has no params.npz; put the trained scene there, or name it with --gaussians")
    if not scene.labelled or not scene.classes:
        raise InputError(
            f"{scene.folder}: has no drawn labels (truth/00000/CAMERA.png and labels.json); draw some frames"
        )
    views = load_moving_views(scene.folder, "train")
    strict = settings.views == "strict" and (scene.folder / "test_meta.json").is_file()
    asked = load_moving_views(scene.folder, "test") if strict else views
    noise = noise_of(settings.encoder)
    if noise is not None:
        source: NamedSource = TrueFrames(scene, noise, settings.seed)
    else:
        name = settings.encoder.replace("{scene}", scene.name).replace("{path}", str(scene.folder))
        source = open_source(name, views.at(0), lambda n, one: make_encoder(n, one, settings.device, settings.cache))
    return MovingCase(scene, settings, load_sequence(scene.gaussians), views, asked, source, log)


def score_moving(case: MovingCase, result: SceneResult, sheets: Path) -> None:
    """One confusion matrix over frames and asked cameras, and how often an object is taken for another than before."""
    classes, settings = case.scene.classes, case.settings
    encoder = encoder_of_questions(settings.encoder, case.source.of_space, settings.device)
    labels_asked = encoder is None
    questions = Questions(None if labels_asked else classes, (), encoder, settings.scoring)
    fusion = FusionSettings(forgetting=settings.forgetting)
    tracker = Tracker(case.source, TrackSettings(fusion, device=settings.device), case.log)
    matrix, known = ConfusionMatrix.empty(len(classes)), []
    for frame in range(count_frames(case.sequence, case.views)):
        tracked = tracker.step(case.sequence.frame(frame), case.views.at(frame))
        case.gaussians, case.lifted, case.scored = tracked.gaussians, case.views.at(frame), case.asked.at(frame)
        row = tracked.features
        case.bytes_per_gaussian = (row.shape[1] * row.element_size() + 8) if row.ndim == 2 else 0.0
        with case.log.stage("answer"):
            images = answer(tracked, questions, [one.view for one in case.scored]).images
        truths, found = [], []
        for one in case.scored:
            ours = _classes_of(images[one.view.stem], labels_asked)
            truth = resize_nearest(true_labels(case.scene, frame, one.view), one.view.camera.size) - 1
            matrix.add(ours, truth)
            truths.append(truth.flatten() + 1)
            found.append(ours.flatten() + 1)
            if len(result.sheets) < settings.sheets:
                with case.log.stage("draw"):
                    name = f"{frame:05d}_{one.view.stem}.png"
                    draw_labels(sheets / name, photograph_of(tracked.gaussians, one.view), truth, ours, classes)
                    result.sheets.append(name)
        known.append(matches(torch.cat(found), torch.cat(truths)))
    add_confusion(result, matrix, classes)
    result.figures["switches"] = float(identity_switches(known))


def _classes_of(image: Any, are_ids: bool) -> Tensor:
    """Index of the class at every pixel, -1 where unknown, int64 [H, W]."""
    values = torch.from_numpy(np.asarray(image).astype(np.int64))
    return values - 1 if are_ids else torch.where(values == UNKNOWN, -1, values)


def total_moving(results: Sequence[SceneResult]) -> dict[str, float]:
    """One confusion matrix over sequences of the same classes; switches of all sequences together."""
    return total_pooled(results) | {"switches": sum(result.figures["switches"] for result in results)}


PANOPTIC = Profile(
    name="panoptic-4d",
    about="CMU Panoptic, labels of a moving scene in cameras that were not lifted from",
    reader="panoptic",
    score=score_moving,
    total=total_moving,
    headline=("miou", "macc", "scene_miou", "switches"),
    split=split_without_views,
    defaults={"encoder": "vlpart:DIR"},
    differences=(
        "the data set has no true parts, and the paper shows pictures only: draw some labels (truth/, labels.json)",
        "the paper takes every frame alone; here earlier frames count, too, unless --forgetting 0; later ones never",
    ),
    make=open_moving,
)
