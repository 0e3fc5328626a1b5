"""What every reader of a published data set gives: scenes by name, and of a scene what lies there, read when asked.

A reader is a module with `NAME`, `ABOUT`, `list_scenes(root)` and `open_scene(root, name)`. Opening a scene looks at
names of files only; views, labels, queries and points are read by the functions that the scene holds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.files.documents import read_json
from sgwarp.files.images import read_rgb, read_size
from sgwarp.io.stems import is_image_name
from sgwarp.scene import View

TRAINED = ("scene.ply", "point_cloud.ply", "splat.ply")  # in a scene's folder
ITERATIONS = "point_cloud/iteration_*/point_cloud.ply"  # below the folder of a training run


@dataclass(frozen=True, eq=False)
class Query:
    """A phrase with its object in one view.

    Attributes:
        stem: Of the view.
        text: The phrase.
        size: (height, width) of the mask [pixels].
        mask: Reads the object's pixels, bool [height, width].
        boxes: x1, y1, x2, y2 [pixels of the mask], one per occurrence, float32 [B, 4]; none if the data set has none.
    """

    stem: str
    text: str
    size: tuple[int, int]
    mask: Callable[[], Tensor]
    boxes: Tensor


@dataclass(frozen=True, eq=False)
class Scribbles:
    """Strokes on one view that say what is wanted.

    Attributes:
        stem: Of the view.
        positive, negative: Pixels on the object and beside it, bool [H, W].
    """

    stem: str
    positive: Tensor
    negative: Tensor


@dataclass(frozen=True, eq=False)
class LabelledPoints:
    """Points of a surface with their class.

    Attributes:
        positions: [m], float32 [P, 3].
        labels: Index into the classes, -1 where not scored, int64 [P].
        instances: Number of the object, 0 where there is none, int64 [P]; None if the data set does not say.
    """

    positions: Tensor
    labels: Tensor
    instances: Tensor | None = None


@dataclass(frozen=True, eq=False)
class SceneData:
    """One scene of a data set.

    Attributes:
        name: As the data set calls it.
        folder: Where its views lie.
        frames: Number of photographs.
        missing: What the format has and this copy lacks, by name.
        load_views: Reads the posed views.
        classes: Names of the classes of labels, points and ids.
        labelled: Stems of the views with label images.
        load_labels: Reads a label image: class of every pixel, -1 where not scored, int64 [h, w] at its own size.
        load_instances: Reads an image of objects: number of the object at every pixel, 0 for none, int64 [h, w].
        load_queries: Reads the phrases with their objects.
        load_scribbles: Reads the strokes.
        load_points: Reads the points with classes.
        load_depth: Reads depth of a view along the optical axis [m], 0 where there is none, float32 [h, w].
        gaussians: Trained scene that lies there, or None.
    """

    name: str
    folder: Path
    frames: int
    missing: tuple[str, ...] = ()
    load_views: Callable[[], list[View]] | None = None
    classes: tuple[str, ...] = ()
    labelled: tuple[str, ...] = ()
    load_labels: Callable[[str], Tensor] | None = None
    load_instances: Callable[[str], Tensor] | None = None
    load_queries: Callable[[], list[Query]] | None = None
    load_scribbles: Callable[[], Scribbles] | None = None
    load_points: Callable[[], LabelledPoints] | None = None
    load_depth: Callable[[View], NDArray[np.float32]] | None = None
    gaussians: Path | None = None

    def need(self, what: str) -> Any:
        """One of the functions.

        Raises:
            InputError: The scene does not have it.
        """
        found = getattr(self, f"load_{what}")
        if found is None:
            lacks = f"; it lacks {', '.join(self.missing)}" if self.missing else ""
            raise InputError(f"{self.folder}: scene {self.name} has no {what}{lacks}; download or export them")
        return found


def trained_in(folder: Path) -> Path | None:
    """The trained Gaussians in a folder: a usual name, or the last iteration of a training run."""
    for name in TRAINED:
        if (folder / name).is_file():
            return folder / name
    runs = [path for path in folder.glob(ITERATIONS) if path.parent.name.split("_")[-1].isdigit()]
    return max(runs, key=lambda path: int(path.parent.name.split("_")[-1]), default=None)


def image_stems(folder: Path) -> tuple[str, ...]:
    """Names without ending of the images in a folder, sorted; none if there is no folder."""
    return tuple(sorted(path.stem for path in images_in(folder)))


def images_in(folder: Path) -> list[Path]:
    """Images in a folder, sorted by name; none if there is no folder."""
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if is_image_name(path) and path.name[0] != ".")


def folders_in(folder: Path) -> list[Path]:
    """Folders in a folder, sorted by name.

    Raises:
        InputError: There is no such folder.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; check the path of the data set")
    return sorted(path for path in folder.iterdir() if path.is_dir() and path.name[0] != ".")


def absent(folder: Path, names: Sequence[str]) -> tuple[str, ...]:
    """Those of the files, folders or patterns that are not in a folder."""
    return tuple(name for name in names if not any(folder.glob(name)))


def scene_folder(root: Path, name: str, listed: Sequence[str]) -> Path:
    """The folder of a scene.

    Raises:
        InputError: The data set has no such scene.
    """
    require_scene(root, name, listed)
    return root if name == root.name and not (root / name).is_dir() else root / name


def require_scene(root: Path, name: str, listed: Sequence[str]) -> None:
    """Raise InputError unless a data set has a scene."""
    if name not in listed:
        there = ", ".join(listed[:8]) + (", ..." if len(listed) > 8 else "") if listed else "none"
        raise InputError(f"{root}: has no scene '{name}'; there are: {there}")


def read_class_names(path: Path) -> tuple[str, ...]:
    """Names of classes in a JSON file, a list or {"1": "couch", ...}; id 0 is void, and class k has id k + 1.

    Raises:
        InputError: The file holds something else.
    """
    content = read_json(path)
    if isinstance(content, dict) and content and all(isinstance(key, str) and key.isdecimal() for key in content):
        last = max(map(int, content))
        if last <= 2 * len(content) + 16:  # ids of a list with a few gaps, not of a hash
            content = [content.get(str(number), f"class {number}") for number in range(1, last + 1)]
    if not isinstance(content, list) or not content or not all(isinstance(name, str) and name for name in content):
        raise InputError(f'{path}: expected a list of class names, or {{"1": "couch", "2": ...}} by id')
    twice = next((name for name in content if content.count(name) > 1), None)
    if twice is not None:
        raise InputError(
            f"{path}: '{twice}' is the name of two classes; give each a name of its own, or join their ids"
        )
    return tuple(content)


def mask_of(path: Path, above: int = 128) -> Tensor:
    """Pixels of an image that are brighter than a level, bool [H, W].

    Raises:
        InputError: The image cannot be read.
    """
    pixels = torch.from_numpy(read_rgb(path))
    return pixels.amax(dim=2) > above


def query_of_mask(stem: str, text: str, path: Path, above: int = 128) -> Query:
    """A query whose object is an image: see `mask_of`."""
    return Query(stem, text, read_size(path), partial(mask_of, path, above), torch.zeros(0, 4))


def resize_nearest(labels: Tensor, size: tuple[int, int]) -> Tensor:
    """Labels or a mask at another size: each pixel takes what lies under its center, none are mixed, [h, w]."""
    if tuple(labels.shape) == tuple(size):
        return labels
    rows, columns = (
        ((torch.arange(new, dtype=torch.float64) + 0.5) * old / new).floor().long().clamp(max=old - 1)
        for new, old in zip(size, labels.shape, strict=True)
    )
    return labels[rows][:, columns]
