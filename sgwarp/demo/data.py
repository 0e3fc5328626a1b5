"""The files of the room: a scene, posed photographs to lift from, and held-out views to measure on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from sgwarp.files.documents import read_json
from sgwarp.files.images import read_ids
from sgwarp.io.scenes import load_gaussians
from sgwarp.io.views import load_views
from sgwarp.scene import FeatureMap, Gaussians, View

ROOM = Path(__file__).parent / "room"
SCENE_FILE = "room.compressed.ply"
CLASSES_FILE = "classes.json"  # name of each id in the label images; 0 is void
HELD_OUT = "held_out"  # folder of the views that nothing is lifted from
FURNITURE = 11  # the first so many classes are objects to look for; floor, wall and ceiling follow


@dataclass(frozen=True, eq=False)
class Room:
    """A labelled scene.

    Attributes:
        folder: Where the label images are.
        gaussians: The scene.
        views: Posed photographs to lift from.
        held_out: Posed photographs to measure on.
        names: Names of the classes; class k has id k + 1 in the label images.
    """

    folder: Path
    gaussians: Gaussians
    views: list[View]
    held_out: list[View]
    names: tuple[str, ...]

    @classmethod
    def load(cls, folder: Path = ROOM) -> Room:
        """Read the room.

        Raises:
            InputError: A file is missing or damaged.
        """
        names = read_json(folder / CLASSES_FILE)
        return cls(
            folder,
            load_gaussians(folder / SCENE_FILE),
            load_views(folder),
            load_views(folder / HELD_OUT),
            tuple(names[str(number)] for number in range(1, len(names))),
        )

    def to(self, device: str) -> Room:
        """The same room with its Gaussians there; photographs and labels stay on the CPU."""
        return replace(self, gaussians=self.gaussians.to(device))

    @property
    def furniture(self) -> tuple[str, ...]:
        """The objects to look for."""
        return self.names[:FURNITURE]

    def label_map(self, view: View) -> FeatureMap:
        """True classes of a view that is lifted from, as one-hot semantics."""
        return FeatureMap("labels", ids=self._classes(self.folder, view), labels=self.names)

    @cached_property
    def truth(self) -> dict[str, Tensor]:
        """True class at every pixel of each held-out view, -1 for void, int64 [H, W]."""
        return {view.stem: self._classes(self.folder / HELD_OUT, view).long() for view in self.held_out}

    @staticmethod
    def _classes(folder: Path, view: View) -> Tensor:
        return torch.from_numpy(read_ids(folder / "labels" / f"{view.stem}.png")) - 1
