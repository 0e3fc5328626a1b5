"""Readers by name, and which of them a folder is for."""

from __future__ import annotations

import os
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

from sgwarp.datasets.base import SceneData
from sgwarp.errors import InputError

# In the order in which a folder is tried: what says most about itself first.
MODULES = {
    "panoptic": "panoptic",
    "scenesplat": "scenesplat",
    "lerf-ovs": "lerf_ovs",
    "lerf-mask": "lerf_mask",
    "3d-ovs": "ovs3d",
    "nvos": "nvos",
    "scannet": "scannet",
    "folder": "labelled_folder",
    "spin-nerf": "spin_nerf",
    "mvimgnet": "mvimgnet",
    "mipnerf360": "mipnerf360",
}


class Reader(Protocol):
    """A module that reads one published format."""

    NAME: str
    ABOUT: str

    def list_scenes(self, root: Path) -> list[str]: ...

    def open_scene(self, root: Path, name: str) -> SceneData: ...


def find_reader(name: str) -> Reader:
    """The reader of a name.

    Raises:
        InputError: There is none.
    """
    if name not in MODULES:
        raise InputError(f"data set '{name}' is not known; there are {', '.join(MODULES)}")
    module: Any = import_module(f"sgwarp.datasets.{MODULES[name]}")
    reader: Reader = module
    return reader


def detect_reader(root: str | os.PathLike[str]) -> Reader | None:
    """The first reader that finds a scene in a folder; None if none does."""
    root = Path(root)
    if not root.is_dir():
        return None
    for name in MODULES:
        reader = find_reader(name)
        if reader.list_scenes(root):
            return reader
    return None


def describe_data_set(root: str | os.PathLike[str], reader: Reader) -> dict[str, Any]:
    """Name of the format, scenes, and of each how many photographs and labels it has and what is missing."""
    root = Path(root)
    scenes: dict[str, Any] = {}
    for name in reader.list_scenes(root):
        scene = reader.open_scene(root, name)
        scenes[name] = {
            "frames": scene.frames,
            "labelled": len(scene.labelled),
            "classes": len(scene.classes) or None,
            "gaussians": str(scene.gaussians) if scene.gaussians else None,
            "missing": list(scene.missing) or None,
        }
    return {"data_set": reader.NAME, "about": reader.ABOUT, "scenes": len(scenes), "by_scene": scenes}
