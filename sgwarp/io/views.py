"""Posed photographs in whatever format a folder holds."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from sgwarp.errors import InputError
from sgwarp.files.inputs import note_input
from sgwarp.io.colmap import find_model, read_colmap
from sgwarp.io.foreign_captures import describe_capture, describe_list, describe_unread
from sgwarp.io.transforms import read_transforms
from sgwarp.io.world import TRANSFORMS, moved_near_origin
from sgwarp.scene import View
from sgwarp.scene.extent import with_near_plane


def load_views(path: str | os.PathLike[str], image_folder: str | None = None, photographs: bool = True) -> list[View]:
    """Read posed photographs: transforms.json in the order of its frames, COLMAP sorted by name.

    Near and far planes follow the extent of the cameras, whatever their unit. Cameras that lie far from the origin (UTM
    coordinates) are moved near it, with a logged notice; `load_points` moves the points of the same data set alike.

    Args:
        path: A transforms.json, a folder that holds one, or a COLMAP data set or model. Of a folder with both,
            transforms.json is read.
        image_folder: COLMAP: name or path of the folder of photographs; if None, `images`, or else the only one that
            holds them; images_4 and the like scale the cameras.
        photographs: False to take the cameras alone; views are then rendered from the scene where an image is needed.

    Raises:
        InputError: Nothing is found there, or what is found cannot be used.
    """
    path = Path(path)
    if not os.path.exists(path):
        raise InputError(f"{path}: no such file or folder; check the path")
    files = [path] if os.path.isfile(path) else [path / name for name in TRANSFORMS]
    transforms = next((file for file in files if file.is_file()), None)
    if transforms is not None:
        if known := describe_list(transforms):
            raise InputError(f"{transforms}: {known}")
        if transforms.suffix.lower() != ".json":
            raise InputError(
                f"{transforms}: is no data set of posed photographs; give its folder, or a transforms.json (archives "
                "must be unpacked)"
            )
        if image_folder is not None:
            raise InputError(f"{transforms}: lists its photographs by path; --images is for COLMAP models only")
        return _placed(path, read_transforms(transforms, photographs))
    if find_model(path) is None:
        if known := describe_capture(path) or describe_unread(path):
            raise InputError(f"{path}: {known}")
        raise InputError(
            f"{path}: holds no views; looked for {', '.join(TRANSFORMS)} and for a COLMAP model (cameras.bin or "
            "cameras.txt) in sparse/0, sparse, colmap/sparse/0 and the folder itself; photographs alone get poses by "
            "`sgwarp poses`"
        )
    return _placed(path, read_colmap(path, image_folder, photographs))


def note_files(views: Iterable[View]) -> None:
    """Let no output take the place of what belongs to views, read or not."""
    for view in views:
        for path in (view.image_path, view.mask_path, view.depth_path):
            if path is not None:
                note_input(path)


def _placed(source: Path, views: list[View]) -> list[View]:
    """Near the origin, and with near planes that fit their unit."""
    note_files(views)
    return with_near_plane(moved_near_origin(source, views))
