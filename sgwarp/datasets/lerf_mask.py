"""LERF-Mask, as Gaussian Grouping released it: masks of phrases in test views.

| file | holds |
|---|---|
| {scene}/images, {scene}/sparse/0 | views |
| {scene}/test_mask/{view}/{phrase}.png | brighter than 128 on the object |
| {scene}/object_mask/{view}.png | ids of objects that were found in the photographs |
"""

from __future__ import annotations

from pathlib import Path

from sgwarp.datasets.base import (
    Query,
    SceneData,
    absent,
    folders_in,
    image_stems,
    images_in,
    query_of_mask,
    scene_folder,
    trained_in,
)
from sgwarp.io.views import load_views

NAME = "lerf-mask"
ABOUT = "LERF-Mask (Gaussian Grouping): {scene}/test_mask/{view}/{phrase}.png"
MASKS, LEVEL = "test_mask", 128


def list_scenes(root: Path) -> list[str]:
    """Folders with test masks."""
    return [folder.name for folder in folders_in(root) if (folder / MASKS).is_dir()]


def open_scene(root: Path, name: str) -> SceneData:
    """A scene.

    Raises:
        InputError: There is none of that name.
    """
    folder = scene_folder(root, name, list_scenes(root))
    views = folders_in(folder / MASKS)
    stems = image_stems(folder / "images")
    missing = absent(folder, ("images", "sparse/0"))
    missing += tuple(f"images/{view.name}.*" for view in views if stems and view.name not in stems)

    def queries() -> list[Query]:
        return [query_of_mask(view.name, path.stem, path, LEVEL) for view in views for path in images_in(view)]

    return SceneData(
        name,
        folder,
        frames=len(stems),
        missing=missing,
        load_views=lambda: load_views(folder),
        labelled=tuple(view.name for view in views),
        load_queries=queries if views else None,
        gaussians=trained_in(folder),
    )
