"""Photographs with their poses as a data set in nerfstudio's format, beside a link to the photographs."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sgwarp.errors import InputError
from sgwarp.files.atomic import atomic_path
from sgwarp.io.lens_models import COLMAP_MODELS
from sgwarp.io.transforms import COEFFICIENTS, DEPTH_UNIT, OPENGL_TO_OPENCV
from sgwarp.io.undistort import Lens
from sgwarp.scene import View

LINK = "photographs"


def write_posed_photographs(folder: str | os.PathLike[str], views: Sequence[View]) -> Path:
    """Write transforms.json and a link to the folder of the photographs; `load_views(folder)` reads the same views.

    Args:
        folder: Made if it does not exist.
        views: With photographs, as `load_views` returns them; their poses are taken, and the lenses they came with.

    Raises:
        InputError: A view has no photograph, or the folder cannot be written.
    """
    folder = Path(folder)
    bare = next((view.stem for view in views if view.image_path is None), None)
    if bare is not None or not views:
        raise InputError(f"{folder}: view {bare} has no photograph; a data set of photographs needs one for each view")
    files = [path for view in views for path in (view.image_path, view.mask_path, view.depth_path) if path is not None]
    common = Path(os.path.commonpath([path.resolve().parent for path in files]))
    with atomic_path(folder / "transforms.json") as temporary:
        _link(folder / LINK, common)
        frames = [_frame(view, common) for view in views]
        temporary.write_text(json.dumps({"frames": frames}, indent=1) + "\n", encoding="utf-8")
    return folder / "transforms.json"


def _link(link: Path, target: Path) -> None:
    if link.is_symlink():
        link.unlink()
    if link.exists():
        raise InputError(f"{link}: is in the way of a link to {target}; move it away")
    try:
        link.symlink_to(target, target_is_directory=True)
    except OSError as error:
        raise InputError(f"{link}: cannot be made a link to {target} ({error.strerror or error})") from None


def _frame(view: View, common: Path) -> dict[str, Any]:
    camera = view.camera
    belongings = {"file_path": view.image_path, "mask_path": view.mask_path, "depth_file_path": view.depth_path}
    frame: dict[str, Any] = {
        key: f"{LINK}/{path.resolve().relative_to(common).as_posix()}"
        for key, path in belongings.items()
        if path is not None
    }
    if view.depth_path is not None:
        frame[DEPTH_UNIT] = view.depth_unit
    lens = getattr(view.undistort, "lens", None)
    if lens is None:
        (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
        lens = Lens(fx, fy, cx, cy, camera.width, camera.height)
    frame["camera_model"] = _model_name(lens)
    frame |= {"fl_x": lens.fx, "fl_y": lens.fy, "cx": lens.cx, "cy": lens.cy, "w": lens.width, "h": lens.height}
    frame |= dict(zip(COEFFICIENTS[lens.model], lens.distortion, strict=False))
    to_world = np.linalg.inv(camera.world_to_camera.numpy()) @ OPENGL_TO_OPENCV
    to_world[3] = (0.0, 0.0, 0.0, 1.0)
    return frame | {"transform_matrix": to_world.tolist()}


def _model_name(lens: Lens) -> str:
    """The name that the reader takes for this model, with as many coefficients."""
    if lens.model == "perspective":
        return "FULL_OPENCV" if any(lens.distortion[5:]) else "OPENCV"
    return next(name for name, (model, _, _) in COLMAP_MODELS.items() if model == lens.model)
