"""MVImgNet: photographs around single objects, without labels.

| file | holds |
|---|---|
| {class}/{instance}/images, {class}/{instance}/sparse/0 | views |
| {class}/{instance}/parts/{view}.png | ids of parts, if somebody drew them |
| {class}/{instance}/parts.json | their names |
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from sgwarp.datasets.base import SceneData, absent, folders_in, image_stems, read_class_names, require_scene, trained_in
from sgwarp.files.images import read_ids
from sgwarp.io.views import load_views

NAME = "mvimgnet"
ABOUT = "MVImgNet: {class}/{instance}/images and sparse/0"
PARTS, NAMES = "parts", "parts.json"


def list_scenes(root: Path) -> list[str]:
    """class/instance of every object with photographs."""
    return [
        f"{kind.name}/{instance.name}"
        for kind in folders_in(root)
        for instance in folders_in(kind)
        if (instance / "images").is_dir() and (instance / "sparse").is_dir()
    ]


def open_scene(root: Path, name: str) -> SceneData:
    """An object.

    Raises:
        InputError: There is none of that name.
    """
    require_scene(root, name, list_scenes(root))
    folder = root / name
    drawn = image_stems(folder / PARTS) if (folder / NAMES).is_file() else ()

    def labels(stem: str) -> Tensor:
        return torch.from_numpy(read_ids(folder / PARTS / f"{stem}.png")).long() - 1

    return SceneData(
        name,
        folder,
        frames=len(image_stems(folder / "images")),
        missing=absent(folder, ("images", "sparse/0")),
        load_views=lambda: load_views(folder),
        classes=read_class_names(folder / NAMES) if drawn else (),
        labelled=drawn,
        load_labels=labels if drawn else None,
        gaussians=trained_in(folder),
    )
