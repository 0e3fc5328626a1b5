"""3D-OVS: indoor and outdoor scenes with a mask per class in a few views.

| file | holds |
|---|---|
| {scene}/images, {scene}/sparse | views |
| {scene}/segmentations/classes.txt | a class in each line |
| {scene}/segmentations/{number}/{class}.png | white on the class; the number is the place of the image by name |
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from sgwarp.datasets.base import (
    Query,
    SceneData,
    absent,
    folders_in,
    images_in,
    mask_of,
    query_of_mask,
    scene_folder,
    trained_in,
)
from sgwarp.errors import InputError
from sgwarp.files.access import read_bytes
from sgwarp.io.views import load_views

NAME = "3d-ovs"
ABOUT = "3D-OVS: {scene}/images, {scene}/segmentations/classes.txt and {number}/{class}.png"
TRUTH, CLASSES = "segmentations", "segmentations/classes.txt"
LEVEL = 128


def list_scenes(root: Path) -> list[str]:
    """Folders with names of classes."""
    return [folder.name for folder in folders_in(root) if (folder / CLASSES).is_file()]


def open_scene(root: Path, name: str) -> SceneData:
    """A scene; its classes come sorted, as the published code has them.

    Raises:
        InputError: There is none of that name, or a number of its masks is not that of an image.
    """
    folder = scene_folder(root, name, list_scenes(root))
    text = read_bytes(folder / CLASSES, 1 << 20).decode("utf-8", "replace")
    classes = tuple(sorted(line.strip() for line in text.splitlines() if line.strip()))
    images = [path.stem for path in images_in(folder / "images")]
    masks: dict[str, Path] = {}
    for place in folders_in(folder / TRUTH):
        if not place.name.isdecimal() or (images and int(place.name) >= len(images)):
            raise InputError(f"{place}: expected a number below the {len(images)} images, counted from 0 by name")
        masks[images[int(place.name)] if images else place.name] = place
    missing = absent(folder, ("images", "sparse*"))
    missing += tuple(
        f"{TRUTH}/{place.name}/{c}.png"
        for place in masks.values()
        for c in classes
        if not (place / f"{c}.png").is_file()
    )

    def labels(stem: str) -> Tensor:
        found = [mask_of(masks[stem] / f"{c}.png", LEVEL) for c in classes]
        result = torch.full(found[0].shape, -1, dtype=torch.int64)
        for index, mask in enumerate(found):
            result[mask] = index
        return result

    def queries() -> list[Query]:
        return [query_of_mask(stem, c, place / f"{c}.png", LEVEL) for stem, place in masks.items() for c in classes]

    return SceneData(
        name,
        folder,
        frames=len(images),
        missing=missing,
        load_views=lambda: load_views(folder),
        classes=classes,
        labelled=tuple(masks),
        load_labels=labels if masks else None,
        load_queries=queries if masks else None,
        gaussians=trained_in(folder),
    )
