"""Coordinates of a data set: moved near the origin where they are far from it, and points brought to its cameras."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sgwarp.errors import InputError
from sgwarp.files.documents import read_json
from sgwarp.io.colmap_model import find_model, read_images
from sgwarp.scene import View

Array = NDArray[np.float64]

logger = logging.getLogger("sgwarp")
TRANSFORMS = ("transforms.json", "transforms_train.json")
FAR = 1000.0  # distance of the cameras from the origin at which float32 blurs what they see [radius of the cameras]
GRID = 10.0  # the origin moves in powers of ten at least this large [radius of the cameras]
TOLERANCE = 0.01  # between the cameras of two files, after a transform [radius of the cameras]
LEAST_COMMON = 2  # photographs that both list
ARM = 0.1  # length of the axes of a camera when it is compared with another [radius of the cameras]


def far_origin(places: Array) -> Array | None:
    """Where to put the origin of cameras that lie far from it, such as those in UTM coordinates; else None.

    The place is round, so that a part of a capture moves as the whole does.

    Args:
        places: Of the cameras [world units], [N, 3].
    """
    if not len(places):
        return None
    center = places.mean(axis=0)
    radius = float(np.linalg.norm(places - center, axis=1).max())
    if radius == 0 or np.linalg.norm(center) <= FAR * radius:
        return None
    step = 10.0 ** np.ceil(np.log10(GRID * radius))
    return np.asarray(np.round(center / step) * step)


def moved_near_origin(source: Path, views: Sequence[View]) -> list[View]:
    """The views of a data set, moved and a notice logged if they lie far from the origin."""
    origin = far_origin(camera_places(source))
    if origin is None:
        return list(views)
    logger.warning(
        "%s: lies far from the origin, where float32 is coarse; coordinates are taken relative to (%s), and so are "
        "scenes of these views",
        *(source, ", ".join(f"{value:.12g}" for value in origin)),
    )
    return [_moved(view, torch.from_numpy(origin)) for view in views]


def _moved(view: View, origin: torch.Tensor) -> View:
    pose = view.camera.world_to_camera.clone()
    pose[:3, 3] += pose[:3, :3] @ origin
    x, y, z = origin.tolist()
    return replace(view, camera=replace(view.camera, world_to_camera=pose), origin=(x, y, z))


def transform_of_points(transforms: Path, meta: Mapping[str, Any], model: Path) -> Array | None:
    """From the world of a COLMAP model into that of a transforms.json beside it, [4, 4]; None if there is none.

    It is what the file declares (`applied_transform`, then `applied_scale`), checked by the cameras that both list. If
    they contradict it, as in files of old versions that declared nothing, the similarity between them is measured.

    Raises:
        InputError: `applied_transform` is not a matrix, or `applied_scale` not a positive number.
    """
    declared = _declared(transforms, meta)
    ours, theirs = _common_cameras(meta, model)
    if len(ours) < LEAST_COMMON:
        return declared
    radius = _radius(ours)
    if _distance(declared, _arms(theirs), _arms(ours)) <= TOLERANCE * radius:
        return declared
    measured = similarity_between(_arms(theirs), _arms(ours))
    if _distance(measured, _arms(theirs), _arms(ours)) <= TOLERANCE * radius:
        logger.warning(
            "%s: its cameras are those of %s in another frame; the points are moved there", transforms, model
        )
        return measured
    reason = ""
    turned = ours * np.array([1.0, 1.0, -1.0, -1.0])[:, None]
    for matrix in (declared, similarity_between(_arms(theirs), _arms(turned))):
        if _distance(matrix, _arms(theirs), _arms(turned)) <= TOLERANCE * radius:
            reason = ": they look the other way; its poses have to be in OpenGL's axes, x right, y up, z back"
    logger.warning("%s: its cameras are not those of %s, whose points are not used%s", transforms, model, reason)
    return None


def _radius(cameras: Array) -> float:
    """Of the places of cameras around their center; 1 if all are in one place."""
    places = cameras[:, 0]
    return float(np.linalg.norm(places - places.mean(axis=0), axis=1).max()) or 1.0


def _arms(cameras: Array) -> Array:
    """Places of cameras and of points ahead of them along their axes, which tell how cameras on a line are turned."""
    places, axes = cameras[:, :1], cameras[:, 1:]
    return np.concatenate([places, places + ARM * _radius(cameras) * axes], axis=1).reshape(-1, 3)


def _declared(transforms: Path, meta: Mapping[str, Any]) -> Array:
    matrix = np.eye(4)
    if (given := meta.get("applied_transform")) is not None:
        try:
            rows = np.array(given, dtype=np.float64)
        except (TypeError, ValueError):
            rows = np.empty(0)
        if rows.shape not in ((3, 4), (4, 4)) or not np.isfinite(rows).all():
            raise InputError(f"{transforms}: 'applied_transform' must be 3 x 4 numbers; export the file again")
        matrix[:3] = rows[:3]
    scale = meta.get("applied_scale", 1.0)
    if isinstance(scale, bool) or not isinstance(scale, (int, float)) or not 0 < scale < 1e30:
        raise InputError(f"{transforms}: 'applied_scale' must be a positive number, got {scale!r}")
    matrix[:3] *= scale
    return matrix


def _common_cameras(meta: Mapping[str, Any], model: Path) -> tuple[Array, Array]:
    """The cameras that both list by file name, in the file's world and in the model's, [N, 4, 3] each."""
    ours, theirs = (_by_file_name(cameras) for cameras in (_cameras_in_transforms(meta), _cameras_in_model(model)))
    common = sorted(set(ours) & set(theirs))
    return tuple(np.array([cameras[name] for name in common]).reshape(-1, 4, 3) for cameras in (ours, theirs))  # type: ignore[return-value]


def camera_places(data_set: Path) -> Array:
    """Places of all cameras that a data set lists, usable or not [world units], [N, 3]."""
    files = [data_set] if data_set.is_file() else [data_set / name for name in TRANSFORMS]
    if file := next((file for file in files if file.is_file()), None):
        cameras = _cameras_in_transforms(read_json(file))
    elif model := find_model(data_set):
        cameras = _cameras_in_model(model)
    else:
        cameras = {}
    return np.array(list(cameras.values())).reshape(-1, 4, 3)[:, 0]


def _by_file_name(cameras: Mapping[str, Array]) -> dict[str, Array]:
    """Without folders and endings, as far as names are unique so."""
    names = [PurePosixPath(name.replace("\\", "/")).stem for name in cameras]
    counts = Counter(names)
    return {name: camera for name, camera in zip(names, cameras.values(), strict=True) if counts[name] == 1}


def _cameras_in_transforms(meta: Mapping[str, Any]) -> dict[str, Array]:
    """By name: place and axes x, y, z of OpenCV's camera in the world, [4, 3]."""
    cameras: dict[str, Array] = {}
    frames = meta.get("frames") if isinstance(meta, Mapping) else None
    for frame in frames if isinstance(frames, list) else []:
        try:
            pose = np.array(frame["transform_matrix"], dtype=np.float64)
            name = str(frame["file_path"])
        except (KeyError, OverflowError, TypeError, ValueError):
            continue  # whoever reads the cameras says what is wrong with the file
        if pose.shape in ((3, 4), (4, 4)) and np.isfinite(pose).all():
            x, up, back, place = pose[:3].T
            cameras[name] = np.stack([place, x, -up, -back])
    return cameras


def _cameras_in_model(model: Path) -> dict[str, Array]:
    """By name: place and axes x, y, z of the camera in the world, [4, 3]."""
    cameras: dict[str, Array] = {}
    if not any((model / f"images{suffix}").is_file() for suffix in (".bin", ".txt")):
        return cameras  # points may come alone
    for record in read_images(model):
        norm = float(np.linalg.norm(record.quat))
        if norm > 0 and np.isfinite(norm) and np.isfinite(record.translation).all():
            quat = np.array(record.quat) / norm
            axes = [_rotated_back(quat, axis) for axis in np.eye(3)]
            cameras[record.name] = np.stack([-_rotated_back(quat, np.array(record.translation)), *axes])
    return cameras


def _rotated_back(quat: Array, vector: Array) -> Array:
    """The inverse rotation of a unit quaternion (w, x, y, z) applied to a vector."""
    w, axis = quat[0], -quat[1:]
    return vector + 2 * np.cross(axis, np.cross(axis, vector) + w * vector)


def _distance(matrix: Array, source: Array, target: Array) -> float:
    return float(np.linalg.norm(source @ matrix[:3, :3].T + matrix[:3, 3] - target, axis=1).max())


def similarity_between(source: Array, target: Array) -> Array:
    """The similarity that maps points onto others with the least squares (Umeyama 1991), [4, 4]."""
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    u, s, v = np.linalg.svd(b.T @ a)
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ v)) or 1.0])
    scale = float((s * sign.diagonal()).sum() / max((a * a).sum(), 1e-300))
    matrix = np.eye(4)
    matrix[:3, :3] = scale * u @ sign @ v
    matrix[:3, 3] = target.mean(axis=0) - matrix[:3, :3] @ source.mean(axis=0)
    return matrix


def apply_transform(matrix: Array, points: Array) -> Array:
    """Points [N, 3] after a transform [4, 4]."""
    return np.asarray(points @ matrix[:3, :3].T + matrix[:3, 3])
