"""A plain labelled folder: posed views, a label image for each, and names of the classes.

| file | holds |
|---|---|
| transforms.json or sparse/0 | views |
| labels/{stem}.png | ids, 0 = void |
| instances/{stem}.png | numbers of objects, the same in all views, 0 = none; if there are any |
| classes.json | names by id, a list from id 1 on or {"1": "couch", ...} |
| depth/{stem}.png | uint16 [mm], if there is depth |
| scene.ply | the trained scene, if there is one |

The root is one scene, or holds a folder for each.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgwarp.datasets.base import SceneData, absent, folders_in, image_stems, read_class_names, scene_folder, trained_in
from sgwarp.errors import InputError
from sgwarp.files.images import read_ids
from sgwarp.io.colmap_model import find_model
from sgwarp.io.views import load_views
from sgwarp.scene import View

NAME = "folder"
ABOUT = "plain labelled folder: transforms.json or COLMAP, labels/{stem}.png, classes.json"
CLASSES = "classes.json"


def list_scenes(root: Path) -> list[str]:
    """The root itself, or the folders in it that are labelled."""
    if _is_scene(root):
        return [root.absolute().name]
    return [folder.name for folder in folders_in(root) if _is_scene(folder)]


def _is_scene(folder: Path) -> bool:
    return (folder / CLASSES).is_file() and (folder / "labels").is_dir()


def open_scene(root: Path, name: str) -> SceneData:
    """A scene.

    Raises:
        InputError: There is none of that name, or its names of classes cannot be read.
    """
    root = root.absolute()
    folder = scene_folder(root, name, list_scenes(root))
    classes = read_class_names(folder / CLASSES)
    posed = (folder / "transforms.json").is_file() or find_model(folder) is not None
    labelled = image_stems(folder / "labels")

    def labels(stem: str) -> Tensor:
        path = folder / "labels" / f"{stem}.png"
        ids = torch.from_numpy(read_ids(path)).long()
        if int(ids.max()) > len(classes):
            raise InputError(f"{path}: id {int(ids.max())}, but {CLASSES} names {len(classes)} classes; complete it")
        return ids - 1

    def depth(view: View) -> NDArray[np.float32]:
        return read_ids(folder / "depth" / f"{view.stem}.png").astype(np.float32) * np.float32(0.001)

    def instances(stem: str) -> Tensor:
        return torch.from_numpy(read_ids(folder / "instances" / f"{stem}.png")).long()

    has_depth = (folder / "depth").is_dir()
    return SceneData(
        name,
        folder,
        frames=len(image_stems(folder / "images")) or len(labelled),
        missing=() if posed else absent(folder, ("transforms.json",)),
        load_views=(lambda: load_views(folder)) if posed else None,
        classes=classes,
        labelled=labelled,
        load_labels=labels if labelled else None,
        load_instances=instances if (folder / "instances").is_dir() else None,
        load_depth=depth if has_depth else None,
        gaussians=trained_in(folder),
    )
