"""Two rooms with true labels in 2D and 3D, and label images that are wrong in a stated way.

`rendered_room` is the full room of SGWARP_DATA; the class of a Gaussian is voted for by the depth and label images of
the views in which its center lies on the surface. `generated_room` is `sgwarp.datasets.synthetic`, whose Gaussians are
born with a class and whose label images come from rays.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import sgwarp as sg
from sgwarp.datasets.synthetic import CLASSES, make_room, room_cameras
from sgwarp.datasets.synthetic_files import room_truth
from sgwarp.files.images import read_ids
from sgwarp.reconstruction.depth import gaussians_from_depth
from sgwarp.scene import Camera, FeatureMap, Gaussians, View

HOLD_OUT = 8
ON_SURFACE = 0.03  # of the depth, relative, for a center to lie on the surface
RENAMED = 0.15  # share of the segments, a class in a view, that get another name
BLOCKS = 0.10  # share of the blocks of BLOCK pixels that show a class at random
BLOCK = 8
SHIFT = 3  # the labels of a view are shifted by up to so many pixels in both directions


@dataclass(frozen=True, eq=False)
class LabelledRoom:
    """A scene with truth.

    Attributes:
        name: For tables.
        gaussians: The scene.
        views: To lift from.
        held_out: To measure on.
        truth: Class at every pixel of every view by stem, -1 for none, int64 [h, w].
        classes: Their names.
        of_gaussians: Class of every Gaussian, -1 where nobody knows, int64 [N].
        photographs: Views at the size of their photographs, by stem; none for generated rooms.
    """

    name: str
    gaussians: Gaussians
    views: list[View]
    held_out: list[View]
    truth: dict[str, Tensor]
    classes: tuple[str, ...]
    of_gaussians: Tensor
    photographs: dict[str, View] = field(default_factory=dict)

    def noisy(self, view: View) -> FeatureMap:
        """The labels of a view, corrupted; the same each time."""
        seed = int(view.stem) + 7
        return self._as_map(corrupt(self.truth[view.stem], len(self.classes), seed))

    def true(self, view: View) -> FeatureMap:
        """The true labels of a view."""
        return self._as_map(self.truth[view.stem])

    def _as_map(self, ids: Tensor) -> FeatureMap:
        return FeatureMap("labels", ids=ids, labels=self.classes)

    def with_views(self, share: float) -> LabelledRoom:
        """The same with a share of the views to lift from, evenly spread."""
        count = max(1, round(share * len(self.views)))
        return replace(self, views=[self.views[k * len(self.views) // count] for k in range(count)])

    def with_gaussians(self, share: float) -> LabelledRoom:
        """The same with a share of the Gaussians, grown so that they still cover the surfaces."""
        count = round(share * len(self.gaussians))
        chosen = torch.randperm(len(self.gaussians), generator=torch.Generator().manual_seed(1))[:count].sort().values
        fewer = self.gaussians.subset(chosen)
        grown = replace(fewer, scales=fewer.scales * share**-0.5)
        return replace(self, gaussians=grown, of_gaussians=self.of_gaussians[chosen])


def corrupt(labels: Tensor, classes: int, seed: int) -> Tensor:
    """Labels with segments renamed, borders displaced and blocks of pixels at random, int64 [h, w]."""
    rng = np.random.default_rng(seed)
    wrong = labels.numpy().copy()
    for label in np.unique(wrong[wrong >= 0]):
        if rng.random() < RENAMED:
            wrong[labels.numpy() == label] = (label + rng.integers(1, classes)) % classes
    dy, dx = rng.integers(-SHIFT, SHIFT + 1, 2)
    h, w = wrong.shape
    wrong = wrong[np.clip(np.arange(h) + dy, 0, h - 1)[:, None], np.clip(np.arange(w) + dx, 0, w - 1)]
    hit = rng.random((-(-h // BLOCK), -(-w // BLOCK))) < BLOCKS
    shown = rng.integers(0, classes, hit.shape)
    hit, shown = (np.kron(part, np.ones((BLOCK, BLOCK), part.dtype))[:h, :w] for part in (hit, shown))
    return torch.from_numpy(np.where(hit & (wrong >= 0), shown, wrong))


def rendered_room(folder: Path, count: int = 30_000, scale: int = 3) -> LabelledRoom:
    """The room of SGWARP_DATA, images divided by `scale`."""
    views = sg.load_views(folder)
    depths = {view.stem: read_ids(folder / "depth" / f"{view.stem}.png").astype(np.float32) * 1e-3 for view in views}
    labels = {
        view.stem: torch.from_numpy(read_ids(folder / "labels" / f"{view.stem}.png")).long() - 1 for view in views
    }
    names = json.loads((folder / "classes.json").read_text())
    classes = tuple(names[str(number)] for number in range(1, len(names)))
    train = [view for k, view in enumerate(views) if k % HOLD_OUT]
    gaussians = gaussians_from_depth(train, lambda view: depths[view.stem].astype(np.float32), count=count)
    of_gaussians = vote(gaussians, train, depths, labels, len(classes))
    small = [replace(view, camera=_smaller(view.camera, scale)) for view in views]
    truth = {stem: image[scale // 2 :: scale, scale // 2 :: scale] for stem, image in labels.items()}
    lifted = [view for k, view in enumerate(small) if k % HOLD_OUT]
    photographs = {view.stem: view for view in views}
    rest = (truth, classes, of_gaussians, photographs)
    return LabelledRoom("rendered", gaussians, lifted, small[::HOLD_OUT], *rest)


def _smaller(camera: Camera, scale: int) -> Camera:
    return camera.resized(camera.height // scale, camera.width // scale)


def vote(
    gaussians: Gaussians, views: list[View], depths: dict[str, np.ndarray], labels: dict[str, Tensor], classes: int
) -> Tensor:
    """Most frequent label at the centers of Gaussians where the true depth agrees with theirs, int64 [N]."""
    votes = torch.zeros(len(gaussians), classes)
    for view in views:
        camera = view.camera
        local = gaussians.means.double() @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        x, y = ((local[:, k] / local[:, 2] * camera.K[k, k] + camera.K[k, 2]).floor().long() for k in (0, 1))
        inside = (local[:, 2] > 0) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
        rows = inside.nonzero().flatten()
        depth = torch.from_numpy(depths[view.stem]).double()[y[rows], x[rows]]
        label = labels[view.stem][y[rows], x[rows]]
        agrees = ((depth - local[rows, 2]).abs() < ON_SURFACE * depth) & (label >= 0)
        votes[rows[agrees], label[agrees]] += 1
    return torch.where(votes.sum(dim=1) > 0, votes.argmax(dim=1), -1)


def generated_room(cache: Path, seed: int = 1, count: int = 30_000, views: int = 40) -> LabelledRoom:
    """A room of the generator; `cache` keeps its label images, as rays take minutes."""
    room = make_room(seed, count)
    cameras = room_cameras(room, seed, views)
    named = [View(f"{number:04d}", camera) for number, camera in enumerate(cameras)]
    path = cache / f"generated-{seed}-{count}-{views}.npz"
    if not path.is_file():
        cache.mkdir(parents=True, exist_ok=True)
        np.savez(path, **{view.stem: room_truth(room, view.camera)[0].numpy() for view in named})
    truth = {stem: torch.from_numpy(image).long() for stem, image in np.load(path).items()}
    lifted = [view for k, view in enumerate(named) if k % HOLD_OUT]
    return LabelledRoom("generated", room.gaussians, lifted, named[::HOLD_OUT], truth, CLASSES, room.classes)
