"""LERF-OVS, as LangSplat released it: four scenes with phrases drawn as polygons in a few views each.

| file | holds |
|---|---|
| {scene}/images, {scene}/sparse/0 | views |
| label/{scene}/frame_XXXXX.json | info {name, width, height}, objects [{category, segmentation [[x, y]..], bbox}] |

A view is found by the stem of the JSON file, never by counting frames. Occurrences of one category are one object with
several boxes. Polygons are filled as OpenCV fills them after cutting off decimals, as in the published script.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sgwarp.datasets.base import Query, SceneData, absent, folders_in, image_stems, scene_folder, trained_in
from sgwarp.errors import InputError
from sgwarp.files.documents import read_json
from sgwarp.files.image_headers import largest_image
from sgwarp.io.views import load_views

NAME = "lerf-ovs"
ABOUT = "LERF-OVS (LangSplat): {scene}/images, {scene}/sparse/0, label/{scene}/frame_XXXXX.json"
LABELS = "label"


def list_scenes(root: Path) -> list[str]:
    """Folders of the root that `label` has a folder of the same name for."""
    if not (root / LABELS).is_dir():
        return []
    return [
        folder.name for folder in folders_in(root) if folder.name != LABELS and (root / LABELS / folder.name).is_dir()
    ]


def open_scene(root: Path, name: str) -> SceneData:
    """A scene.

    Raises:
        InputError: There is none of that name.
    """
    folder, annotated = scene_folder(root, name, list_scenes(root)), root / LABELS / name
    files = sorted(annotated.glob("*.json"))
    stems = set(image_stems(folder / "images"))
    missing = absent(folder, ("images", "sparse/0"))
    lost = [path.stem for path in files if stems and path.stem not in stems]
    missing += tuple(f"images/{stem}.jpg" for stem in lost)
    return SceneData(
        name,
        folder,
        frames=len(stems),
        missing=missing if files else (*missing, f"{LABELS}/{name}/*.json"),
        load_views=lambda: load_views(folder),
        labelled=tuple(path.stem for path in files),
        load_queries=(lambda: [query for path in files for query in read_annotation(path)]) if files else None,
        gaussians=trained_in(folder),
    )


def read_annotation(path: Path) -> list[Query]:
    """The phrases of one view, in the order of their first occurrence.

    Raises:
        InputError: The file does not have the format.
    """
    content = read_json(path)
    try:
        info, objects = content["info"], content["objects"]
        size = int(info["height"]), int(info["width"])
        if min(size) < 1 or size[0] * size[1] > largest_image():
            raise InputError(f"{path}: info: an image of {size[1]} x {size[0]} pixels cannot be; correct it")
        polygons: dict[str, list[Any]] = {}
        boxes: dict[str, list[Any]] = {}
        for entry in objects:
            polygon = np.asarray(entry["segmentation"], dtype=np.float64)
            box = np.asarray(entry["bbox"], dtype=np.float64).reshape(-1)
            if polygon.ndim != 2 or polygon.shape[1] != 2 or box.shape != (4,) or not np.isfinite(polygon).all():
                raise InputError(f"{path}: '{entry['category']}': expected points [[x, y], ..] and a box of 4 numbers")
            polygons.setdefault(str(entry["category"]), []).append(polygon)
            boxes.setdefault(str(entry["category"]), []).append(box)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: is no annotation of LERF-OVS ({type(error).__name__}: {error})") from None
    return [
        Query(
            path.stem,
            text,
            size,
            partial(fill_polygons, drawn, size),
            torch.tensor(np.array(boxes[text]), dtype=torch.float32),
        )
        for text, drawn in polygons.items()
    ]


def fill_polygons(polygons: list[Any], size: tuple[int, int]) -> Tensor:
    """Pixels of any of the polygons, outlines included, bool [H, W]; decimals of the corners are cut off."""
    import cv2

    mask = np.zeros(size, dtype=np.uint8)
    for polygon in polygons:
        cv2.fillPoly(mask, [np.clip(polygon, -(2**15), 2**15).astype(np.int32)], 1)
    return torch.from_numpy(mask).bool()
