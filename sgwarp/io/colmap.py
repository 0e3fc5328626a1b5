"""Views from a COLMAP reconstruction: a sparse model beside a folder of photographs."""

from __future__ import annotations

import logging
import math
import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sgwarp.errors import InputError
from sgwarp.files.images import read_size
from sgwarp.io.colmap_model import ImageRecord, find_model, read_cameras, read_images
from sgwarp.io.colmap_model import read_points as read_points
from sgwarp.io.image_folders import find_image_folder
from sgwarp.io.names import inside
from sgwarp.io.stems import unique_stems
from sgwarp.io.undistort import Lens, pinhole_view
from sgwarp.scene import View


def read_colmap(path: str | os.PathLike[str], image_folder: str | None = None, photographs: bool = True) -> list[View]:
    """Read the registered images of a COLMAP reconstruction, sorted by name.

    Distorted photographs are undistorted when read (`View.undistort`), and the camera is that of the undistorted
    image. If the photographs are an integer factor smaller than the model says (images_2, images_4, images_8 of
    Mip-NeRF 360), the camera follows them. Photographs that do not exist and poses with NaN or infinity are left out,
    with a logged notice of how many.

    Args:
        path: The data set (with sparse/0, sparse or colmap/sparse/0) or the folder of the model itself.
        image_folder: Name or path of the folder of photographs, looked for beside the model and up to three levels
            above; if None, `images`, or else the only folder that holds them.
        photographs: False to take the cameras alone; then no photograph is looked for.

    Raises:
        InputError: The model is missing or damaged, a camera model is not supported, photographs and cameras differ
            in size, or no view is left.
    """
    path = Path(path)
    model = find_model(path)
    if model is None:
        raise InputError(f"{path}: holds no COLMAP model (cameras.bin or cameras.txt in sparse/0, sparse or itself)")
    lenses = read_cameras(model)
    records = read_images(model)
    folder = find_image_folder(model, [record.name for record in records], image_folder) if photographs else None
    kept: list[tuple[ImageRecord, NDArray[np.float64], Path | None]] = []
    missing: list[str] = []
    unposed = 0
    for record in records:
        if record.camera_id not in lenses:
            raise InputError(f"{model}: image {record.name!r} refers to camera {record.camera_id}, which is not listed")
        image = inside(model, folder, record.name) if folder is not None else None
        pose = _world_to_camera(record)
        if image is not None and not os.path.isfile(image):
            missing.append(record.name)
        elif pose is None:
            unposed += 1
        else:
            kept.append((record, pose, image))
    log = logging.getLogger("sgwarp")
    if missing:
        log.warning("%s: left out %d images without photograph, first %r", model, len(missing), missing[0])
    if unposed:
        log.warning("%s: left out %d images whose pose holds NaN or infinity", model, unposed)
    if not kept:
        raise InputError(
            f"{model}: none of {len(records)} registered images can be used: {len(missing)} photographs are not in "
            f"{folder}, {unposed} poses hold NaN or infinity"
        )
    views = []
    for stem, (record, pose, image) in zip(unique_stems(model, [r.name for r, _, _ in kept]), kept, strict=True):
        lens = lenses[record.camera_id]
        if image is not None:
            lens = _fitted(lens, image)
        views.append(pinhole_view(f"{model}: image {record.name!r}", stem, lens, pose, image))
    return views


def _fitted(lens: Lens, image: Path) -> Lens:
    """The lens for photographs that may be an integer factor smaller than the model says."""
    height, width = read_size(image)
    if (height, width) == (lens.height, lens.width):
        return lens
    factor = max(1, round(lens.width / width))
    # Tools round the smaller size up or down.
    if max(abs(lens.width / factor - width), abs(lens.height / factor - height)) >= 1:
        raise InputError(
            f"{image}: image is {width} x {height}, its camera says {lens.width} x {lens.height}, which is no integer "
            "factor; resize one of them"
        )
    return lens.resized(width, height)


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
