"""NVOS: forward-facing scenes with strokes on one view and the true mask of another.

| file | holds |
|---|---|
| labels/llff/masks/{scene}/{view}_mask.png | the object in the test view |
| labels/llff/reference_image/{scene}/{view}.JPG | the view that is drawn on |
| labels/llff/scribbles/{scene}/pos_*.png, neg_*.png | strokes on the object and beside it |
| scenes/{scene} or scenes/{scene}_undistort | views |

`labels/llff` may also be `labels`, `llff`, or the root.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from sgwarp.datasets.base import (
    Query,
    SceneData,
    Scribbles,
    folders_in,
    image_stems,
    images_in,
    mask_of,
    query_of_mask,
    require_scene,
    trained_in,
)
from sgwarp.errors import InputError
from sgwarp.io.views import load_views

NAME = "nvos"
ABOUT = "NVOS: labels/llff/masks, reference_image and scribbles by scene; scenes/{scene} holds the views"
PLACES = ("labels/llff", "labels", "llff", ".")
VIEWS = ("scenes/{}", "scenes/{}_undistort", "{}", "{}_undistort")
# Two objects of one scene have masks of their own: their views lie under the scene's name.
PARTS = ("_center", "_left", "_right")


def list_scenes(root: Path) -> list[str]:
    """Folders of masks."""
    place = _labels(root)
    return [] if place is None else [folder.name for folder in folders_in(place / "masks")]


def _labels(root: Path) -> Path | None:
    return next((root / name for name in PLACES if (root / name / "masks").is_dir()), None)


def open_scene(root: Path, name: str) -> SceneData:
    """A scene.

    Raises:
        InputError: There is none of that name.
    """
    require_scene(root, name, list_scenes(root))
    place = _labels(root)
    assert place is not None
    known = {name, *(name.removesuffix(part) for part in PARTS)}
    folder = next(
        (root / form.format(one) for form in VIEWS for one in known if (root / form.format(one)).is_dir()), None
    )
    masks = [path for path in images_in(place / "masks" / name) if path.stem.endswith("_mask")]
    strokes = {
        kind: [p for p in images_in(place / "scribbles" / name) if p.name.startswith(kind)] for kind in ("pos", "neg")
    }
    reference = image_stems(place / "reference_image" / name)
    missing = [] if folder else [f"scenes/{name}"]
    missing += [] if masks else [f"masks/{name}/*_mask.png"]
    missing += [f"scribbles/{name}/{kind}_*.png" for kind, found in strokes.items() if not found]
    missing += [] if reference else [f"reference_image/{name}/*.JPG"]

    def scribbles() -> Scribbles:
        return Scribbles(reference[0], *(_joined(strokes[kind]) for kind in ("pos", "neg")))

    def queries() -> list[Query]:
        return [query_of_mask(path.stem.removesuffix("_mask"), name, path) for path in masks]

    return SceneData(
        name,
        folder or place / "masks" / name,
        frames=len(image_stems(folder / "images")) if folder else 0,
        missing=tuple(missing),
        load_views=(lambda: load_views(folder)) if folder else None,
        labelled=tuple(path.stem.removesuffix("_mask") for path in masks),
        load_queries=queries if masks else None,
        load_scribbles=scribbles if reference and all(strokes.values()) else None,
        gaussians=trained_in(folder) if folder else None,
    )


def _joined(paths: list[Path]) -> Tensor:
    """Pixels of any of the images, bool [H, W]."""
    masks = [mask_of(path, 0) for path in paths]
    if len({mask.shape for mask in masks}) > 1:
        raise InputError(f"{paths[0]}: strokes of one scene differ in size")
    return torch.stack(masks).any(dim=0)
