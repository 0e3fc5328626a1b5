"""Views from a COLMAP reconstruction: a sparse model beside a folder of photographs."""

from __future__ import annotations

import logging
import math
import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sgwarp.errors import InputError
from sgwarp.files.exif import UPRIGHT
from sgwarp.io.colmap_model import ImageRecord, count_images, find_model, find_models, read_cameras, read_images
from sgwarp.io.colmap_model import read_points as read_points
from sgwarp.io.image_folders import find_image_folder
from sgwarp.io.photograph_files import PhotographFiles
from sgwarp.io.photographs import LeftOut, fit_photograph, say_orientations
from sgwarp.io.stems import unique_stems
from sgwarp.io.undistort import Lens, Listed, pinhole_view
from sgwarp.scene import View

MISSING, UNPOSED, TWICE = "without photograph", "whose pose holds NaN or infinity", "that are listed before"


def read_colmap(path: str | os.PathLike[str], image_folder: str | None = None, photographs: bool = True) -> list[View]:
    """Read the registered images of a COLMAP reconstruction, sorted by name.

    Distorted photographs are undistorted when read (`View.undistort`), and the camera is that of the undistorted
    image. If the photographs are smaller or larger than the model says (images_2, images_4, images_8 of Mip-NeRF 360),
    the camera follows them. A photograph that fits its camera only when it is turned as its EXIF data say is turned.
    Photographs that do not exist or do not fit, poses with NaN or infinity and cameras of unsupported models are left
    out, with a logged notice of how many. Of several models the one with most images is read.

    Args:
        path: The data set (with sparse/0, sparse or colmap/sparse/0) or the folder of the model itself.
        image_folder: Name or path of the folder of photographs, looked for beside the model and up to three levels
            above; if None, `images`, or else the only folder that holds them.
        photographs: False to take the cameras alone; then no photograph is looked for.

    Raises:
        InputError: The model is missing or damaged, or no view is left.
    """
    path = Path(path)
    model = find_model(path)
    if model is None:
        raise InputError(f"{path}: holds no COLMAP model (cameras.bin or cameras.txt in sparse/0, sparse or itself)")
    _say_models(path, model)
    lenses = read_cameras(model)
    records = read_images(model)
    folder = find_image_folder(model, [record.name for record in records], image_folder) if photographs else None
    left_out, files = LeftOut(model, "images"), PhotographFiles(model, (record.name for record in records))
    found = {r.name: files.locate(folder, r.name) if folder is not None else None for r in records}
    kept, seen = [], set[Path | str]()
    for record in records:
        own = found[record.name] or record.name
        if own in seen:
            left_out.add(TWICE, record.name)
        elif _usable(record, lenses, folder is None or found[record.name] is not None, left_out):
            seen.add(own)
            kept.append(record)
    views, used = [], []
    for stem, record in zip(unique_stems(model, [record.name for record in kept]), kept, strict=True):
        image = found[record.name]
        lens, pose, orientation = lenses[record.camera_id], _world_to_camera(record), UPRIGHT
        assert isinstance(lens, Lens)
        assert pose is not None
        try:
            if image is not None:
                lens, orientation = fit_photograph(lens, image)
            listed = Listed(record.name, image, orientation)
            views.append(pinhole_view(f"{model}: image {record.name!r}", stem, lens, pose, listed))
        except InputError as error:
            left_out.fail(error, record.name)
            continue
        if image is not None:
            used.append((image, orientation))
    if not views:
        raise InputError(
            left_out.first_error
            or f"{model}: none of {len(records)} registered images can be used: {left_out.count(MISSING)} photographs "
            f"are not in {folder}, {left_out.count(UNPOSED)} poses hold NaN or infinity"
        )
    left_out.say()
    files.say()
    say_orientations(model, used)
    return views


def _usable(record: ImageRecord, lenses: dict[int, Lens | InputError], exists: bool, left_out: LeftOut) -> bool:
    """Whether an image has a camera, a pose and a photograph; if not, why is noted."""
    lens = lenses.get(record.camera_id) or InputError(
        f"{left_out.source}: image {record.name!r} refers to camera {record.camera_id}, which is not listed"
    )
    if not exists:
        left_out.add(MISSING, record.name)
    elif _world_to_camera(record) is None:
        left_out.add(UNPOSED, record.name)
    elif isinstance(lens, InputError):
        left_out.fail(lens, record.name)
    else:
        return True
    return False


def _say_models(path: Path, model: Path) -> None:
    """Log which of several models is read."""
    models = find_models(path)
    if len(models) > 1:
        sizes = ", ".join(f"{other.name} with {count_images(other)}" for other in models)
        logging.getLogger("sgwarp").warning(
            "%s: holds %d models (%s images); the one with most images is read, %s",
            *(path, len(models), sizes, model.name),
        )


def _world_to_camera(record: ImageRecord) -> NDArray[np.float64] | None:
    """Rigid transform float64 [4, 4], or None where the record holds NaN, infinity or a rotation of zero."""
    norm = math.sqrt(sum(q * q for q in record.quat))
    if not (norm > 0 and math.isfinite(norm) and all(map(math.isfinite, record.translation))):
        return None
    w, x, y, z = (q / norm for q in record.quat)
    pose = np.eye(4)
    pose[:3, :3] = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    pose[:3, 3] = record.translation
    return pose
