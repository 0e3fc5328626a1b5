"""Profiles `room-instances` and `scannet-instances`: average precision of objects without classes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from sgwarp.apps.instances.finder import instances
from sgwarp.apps.instances.maps import render_ids
from sgwarp.datasets.base import LabelledPoints, SceneData, resize_nearest
from sgwarp.encoders.base import MissingMap
from sgwarp.encoders.masks.sources import MaskSource, ViewMasks
from sgwarp.encoders.registry import make_mask_source
from sgwarp.errors import InputError
from sgwarp.evaluation.cases import Case, Split, read_case, split_without_views
from sgwarp.evaluation.profiles.base import Profile, total_means
from sgwarp.evaluation.profiles.scannet import SCENES_10, nearest_gaussians
from sgwarp.evaluation.results import SceneResult
from sgwarp.evaluation.settings import Settings
from sgwarp.evaluation.sheets import draw_labels, photograph_of
from sgwarp.evaluation.truth_maps import NAME as TRUTH
from sgwarp.metrics.detection import Detections, masks_of
from sgwarp.runs.log import RunLog
from sgwarp.scene import InstanceMap, View

SMALLEST_IN_VIEW = 50  # pixels, as in profile `room`
SMALLEST_IN_MESH = 100  # vertices, ScanNet's own
SURFACES = (1, 2)  # wall and floor in nyu40: no objects on ScanNet


@dataclass(frozen=True)
class TrueMasks:
    """True objects of each view as masks. No mask says which object it shows: views agree in nothing."""

    scene: SceneData
    needs_image: bool = field(default=False, init=False)

    def read(self, view: View, image: Tensor | None) -> ViewMasks:
        """Masks of a view.

        Raises:
            MissingMap: It has no image of objects.
        """
        if view.stem not in self.scene.labelled:
            raise MissingMap(f"{self.scene.folder}: view {view.stem} is not labelled")
        masks = masks_of(self.scene.need("instances")(view.stem))
        return ViewMasks(masks, torch.full((len(masks),), -1))


@dataclass(eq=False)
class InstanceCase(Case):
    """A scene with its objects.

    Attributes:
        found: The instances.
    """

    found: InstanceMap | None = None

    @property
    def bytes_per_gaussian(self) -> float:
        """As stored: 4 bytes a candidate, 2 a share, 2 for the observations."""
        assert self.found is not None
        levels, _, width = self.found.candidates.shape
        return levels * width * 6.0 + 2.0


def find_objects(scene: SceneData, settings: Settings, split: Split, log: RunLog) -> InstanceCase:
    """Objects of a scene from the masks of its lifted views; --encoder names the source of the masks.

    Raises:
        InputError: Views, Gaussians or masks are missing.
    """
    if settings.semantics or settings.predicted:
        raise InputError("--semantics, --predicted: this profile finds objects by masks; leave them out")
    read = read_case(scene, settings, split, log)
    name = settings.encoder.replace("{scene}", scene.name).replace("{path}", str(scene.folder))
    source: MaskSource = TrueMasks(scene) if name == TRUTH else make_mask_source(name, read.lifted, settings.device)
    case = InstanceCase(scene, settings, read.gaussians, read.lifted, read.scored, log)
    case.found = instances(read.gaussians, read.lifted, source, log=log)
    return case


def score_views(case: InstanceCase, result: SceneResult, sheets: Path) -> None:
    """AP of the objects rendered into the scored views, each view an image of its own."""
    assert case.found is not None
    detections = Detections()
    for index, view in enumerate(case.scored):
        truth = resize_nearest(case.scene.need("instances")(view.stem), view.camera.size)
        with case.log.stage("answer"):
            ids, sure = (part.cpu() for part in render_ids(case.gaussians, case.found, view.camera))
        add_objects(detections, ids, truth, sure, SMALLEST_IN_VIEW)
        if index < case.settings.sheets:
            with case.log.stage("draw"):
                _draw(sheets / f"{view.stem}.png", case, view, truth, ids)
                result.sheets.append(f"{view.stem}.png")
    _add_figures(result, detections, case)


def score_mesh(case: InstanceCase, result: SceneResult, sheets: Path) -> None:
    """AP of the objects on the vertices of the mesh.

    Raises:
        InputError: The mesh does not say which vertex belongs to which object.
    """
    assert case.found is not None
    points: LabelledPoints = case.scene.need("points")()
    if points.instances is None:
        name = case.scene.name
        raise InputError(
            f"{case.scene.folder}: scene {name} has no objects on its mesh; download {name}.aggregation.json and "
            f"{name}_vh_clean_2.0.010000.segs.json"
        )
    with case.log.stage("match"):
        nearest = nearest_gaussians(case, points.positions)
    objects = ~torch.isin(points.labels, torch.tensor((0, *SURFACES)))
    detections = Detections()
    ids, sure = case.found.instance().clamp(min=0)[nearest], case.found.confidence()[nearest]
    add_objects(detections, ids, torch.where(objects, points.instances, 0), sure, SMALLEST_IN_MESH)
    _add_figures(result, detections, case)


def add_objects(detections: Detections, ids: Tensor, truth: Tensor, sure: Tensor, smallest: int) -> None:
    """Add an image or a mesh. Objects that are too small are not scored, nor are predictions on them.

    Args:
        detections: Where to.
        ids: Instance of every pixel or vertex, 0 for none.
        truth: Object of every pixel or vertex, 0 where nothing is scored.
        sure: Confidence of every pixel or vertex; its mean over a mask ranks the mask.
        smallest: Pixels or vertices.
    """
    masks, objects = masks_of(ids), masks_of(truth)
    masks = masks[masks.flatten(1).sum(dim=1) >= smallest]
    objects = objects[objects.flatten(1).sum(dim=1) >= smallest]
    scores = torch.stack([sure[mask].mean() for mask in masks]) if len(masks) else torch.zeros(0)
    detections.add(masks, objects, scores, ignored=~objects.any(dim=0))


def _add_figures(result: SceneResult, detections: Detections, case: InstanceCase) -> None:
    assert case.found is not None
    found = detections.precision()
    result.figures |= {"ap": found.ap, "ap50": found.ap50, "ap25": found.ap25}
    result.figures |= {"undecided": case.log.error["undecided"], "nothing": case.log.error["nothing"]}
    result.values["instances"] = [float(len(case.found.table))]


def _draw(path: Path, case: InstanceCase, view: View, truth: Tensor, ids: Tensor) -> None:
    """Instances in the numbers of the objects that they overlap most, so that the colors of both agree."""
    numbers = truth.unique().tolist()
    places = torch.searchsorted(torch.tensor(numbers), truth)
    ours = torch.full_like(ids, -1)
    for mask in masks_of(ids):
        ours[mask] = int(torch.bincount(places[mask]).argmax())
    names = [f"object {number}" if number else "nothing" for number in numbers]
    draw_labels(path, photograph_of(case.gaussians, view), places, ours, names)


def total_objects(results: Sequence[SceneResult]) -> dict[str, float]:
    """Means of the scenes."""
    return total_means(results)


HEADLINE = ("ap", "ap50", "ap25", "undecided")
ROOM = Profile(
    name="room-instances",
    about="labelled folders with instances/: objects without classes in held-out views",
    reader="folder",
    score=score_views,
    total=total_objects,
    headline=HEADLINE,
    defaults={"encoder": TRUTH},
    differences=(
        "--encoder is a source of masks, as of `sgwarp instances`; truth: the objects' own, without their numbers",
        "walls, floor and ceiling are objects like others; a view is an image, objects below 50 pixels are not scored",
    ),
    make=find_objects,
)
SCANNET = Profile(
    name="scannet-instances",
    about="ScanNet, objects without classes on the vertices of 10 scenes",
    reader="scannet",
    score=score_mesh,
    total=total_objects,
    headline=HEADLINE,
    scenes=SCENES_10,
    split=split_without_views,
    defaults={"encoder": "sam:PATH", "every": 5},
    differences=(
        "AP of each scene, then the mean; ScanNet's script pools all scenes of the validation set",
        "a vertex takes the instance of its nearest Gaussian of opacity 0.1 or more; wall and floor are not scored",
        "published rows are from eight views of a scene; here every 5th frame is lifted",
    ),
    make=find_objects,
)
