"""Mip-NeRF 360: {scene}/images, images_{2,4,8} and sparse/0, without labels.

Queries in the form of LERF-OVS may lie beside the scenes, in `label`.
"""

from __future__ import annotations

from pathlib import Path

from sgwarp.datasets import lerf_ovs
from sgwarp.datasets.base import SceneData, absent, folders_in, image_stems, scene_folder, trained_in
from sgwarp.io.views import load_views

NAME = "mipnerf360"
ABOUT = "Mip-NeRF 360: {scene}/images, images_2, images_4, images_8, sparse/0"
SMALLER = ("images_8", "images_4", "images_2")  # the smallest first


def list_scenes(root: Path) -> list[str]:
    """Folders with photographs and a model."""
    return [f.name for f in folders_in(root) if (f / "sparse").is_dir() and ((f / "images").is_dir() or _small(f))]


def _small(folder: Path) -> str | None:
    return next((name for name in SMALLER if (folder / name).is_dir()), None)


def open_scene(root: Path, name: str) -> SceneData:
    """A scene; the smallest photographs are read.

    Raises:
        InputError: There is none of that name.
    """
    folder = scene_folder(root, name, list_scenes(root))
    images = _small(folder) or "images"
    annotations = sorted((root / lerf_ovs.LABELS / name).glob("*.json"))
    return SceneData(
        name,
        folder,
        frames=len(image_stems(folder / images)),
        missing=absent(folder, ("images", *sorted(SMALLER), "sparse/0")),
        load_views=lambda: load_views(folder, images),
        labelled=tuple(path.stem for path in annotations),
        load_queries=(lambda: [q for path in annotations for q in lerf_ovs.read_annotation(path)])
        if annotations
        else None,
        gaussians=trained_in(folder),
    )
