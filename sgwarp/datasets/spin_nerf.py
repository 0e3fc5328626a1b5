"""SPIn-NeRF multiview segmentation: the mask of one object in every view.

| file | holds |
|---|---|
| {scene}/images, {scene}/sparse/0 | views |
| {scene}/masks, images/label or images_{2,4,8}/label: {view}.png | not 0 on the object |

One of those folders is read, in this order. The mask of the first view by name is given to a method, the others are
scored.
"""

from __future__ import annotations

from pathlib import Path

from sgwarp.datasets.base import (
    Query,
    SceneData,
    Scribbles,
    absent,
    folders_in,
    image_stems,
    images_in,
    mask_of,
    query_of_mask,
    scene_folder,
    trained_in,
)
from sgwarp.io.views import load_views

NAME = "spin-nerf"
ABOUT = "SPIn-NeRF: {scene}/images, sparse/0, and masks/{view}.png or images_4/label/{view}.png"
MASKS = ("masks", "images/label", "images_4/label", "images_2/label", "images_8/label")


def list_scenes(root: Path) -> list[str]:
    """Folders with masks."""
    return [folder.name for folder in folders_in(root) if _masks(folder)]


def _masks(folder: Path) -> list[Path]:
    return next((found for name in MASKS if (found := images_in(folder / name))), [])


def open_scene(root: Path, name: str) -> SceneData:
    """A scene.

    Raises:
        InputError: There is none of that name.
    """
    folder = scene_folder(root, name, list_scenes(root))
    masks = _masks(folder)
    stems = image_stems(folder / "images")

    def queries() -> list[Query]:
        return [query_of_mask(path.stem, name, path, 0) for path in masks]

    def scribbles() -> Scribbles:
        mask = mask_of(masks[0], 0)
        return Scribbles(masks[0].stem, mask, ~mask)

    return SceneData(
        name,
        folder,
        frames=len(stems),
        missing=absent(folder, ("images*", "sparse/0")),
        load_views=lambda: load_views(folder),
        labelled=tuple(path.stem for path in masks),
        load_queries=queries,
        load_scribbles=scribbles,
        gaussians=trained_in(folder),
    )
