"""Cameras from transforms.json as nerfstudio, instant-ngp and the Blender scenes of NeRF write it."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sgwarp.errors import InputError
from sgwarp.files.documents import read_json
from sgwarp.files.images import read_size
from sgwarp.io.names import inside
from sgwarp.io.stems import IMAGE_SUFFIXES, unique_stems
from sgwarp.io.undistort import Lens, pinhole_view
from sgwarp.scene import View

PERSPECTIVE_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
FISHEYE_MODELS = ("OPENCV_FISHEYE",)
PERSPECTIVE_DISTORTION = ("k1", "k2", "p1", "p2", "k3")
FISHEYE_DISTORTION = ("k1", "k2", "k3", "k4")
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])  # camera y up, z back -> y down, z forward
RIGID_TOLERANCE = 1e-3
MAX_NUMBER = 1e100  # JSON knows integers that no float can hold

Fields = Mapping[str, Any]


def read_transforms(path: str | os.PathLike[str], photographs: bool = True) -> list[View]:
    """Read the cameras of a transforms.json, in the order of its frames.

    Intrinsics (fl_x fl_y cx cy w h, or camera_angle_x/y; k1 k2 k3 k4 p1 p2) may stand in a frame or once for all; a
    frame's own win. A missing fl_y equals fl_x, a missing principal point is the centre of the image, a missing size
    is that of the first photograph. The extension of a file name may be missing. Frames whose photograph does not
    exist and frames whose pose holds NaN or infinity are left out, with a logged notice of how many. Distorted
    photographs are undistorted when read (`View.undistort`), and the camera is that of the undistorted image.

    Args:
        path: The JSON file; file names in it are relative to its folder.
        photographs: False to take the cameras alone: then no photograph is looked for, and sizes must be in the file.

    Raises:
        InputError: The file is missing or malformed, a camera model is not supported, a pose is not rigid, or no
            frame is left.
    """
    path = Path(path)
    meta = _parse(path)
    kept: list[tuple[int, Fields, NDArray[np.float64], Path | None]] = []
    missing: list[str] = []
    unposed = 0
    for index, frame in enumerate(meta["frames"]):
        where = f"{path}: frame {index}"
        name = frame.get("file_path") if isinstance(frame, dict) else None
        if not isinstance(name, str) or not name:
            raise InputError(f"{where}: has no 'file_path'; name the photograph it belongs to")
        image = _find_image(path, name) if photographs else None
        if photographs and image is None:
            missing.append(name)
            continue
        pose = _world_to_camera(f"{where} ({name})", frame.get("transform_matrix"))
        if pose is None:
            unposed += 1
            continue
        kept.append((index, frame, pose, image))
    log = logging.getLogger("sgwarp")
    if missing:
        log.warning("%s: left out %d frames without photograph, first %r", path, len(missing), missing[0])
    if unposed:
        log.warning("%s: left out %d frames whose pose holds NaN or infinity", path, unposed)
    if not kept:
        raise InputError(
            f"{path}: none of {len(meta['frames'])} frames can be used: {len(missing)} photographs do not exist (first "
            f"{path.parent / missing[0] if missing else '-'}), {unposed} poses hold NaN or infinity"
        )
    stems = unique_stems(path, [frame["file_path"] for _, frame, _, _ in kept])
    size: tuple[int, int] | None = None
    views = []
    for stem, (index, frame, pose, image) in zip(stems, kept, strict=True):
        where = f"{path}: frame {index} ({frame['file_path']})"
        if size is None and image is not None and not all(key in frame or key in meta for key in ("w", "h")):
            size = read_size(image)
        views.append(pinhole_view(where, stem, _lens(where, frame, meta, size), pose, image))
    return views


def _parse(path: Path) -> dict[str, Any]:
    meta = read_json(path)
    if not isinstance(meta, dict) or not isinstance(meta.get("frames"), list):
        raise InputError(f"{path}: has no list 'frames'; expected a transforms.json of nerfstudio or instant-ngp")
    if not meta["frames"]:
        raise InputError(f"{path}: its list 'frames' is empty; it must name at least one photograph")
    return meta


def _find_image(transforms: Path, name: str) -> Path | None:
    listed = inside(transforms, transforms.parent, name)
    candidates = (listed, *(listed.with_name(listed.name + suffix) for suffix in IMAGE_SUFFIXES))
    return next((path for path in candidates if os.path.isfile(path)), None)


def _world_to_camera(where: str, matrix: Any) -> NDArray[np.float64] | None:
    """Invert a camera-to-world matrix in OpenGL axes; None if it is not finite."""
    try:
        c2w = np.array(matrix, dtype=np.float64)
    except (OverflowError, TypeError, ValueError):
        c2w = np.empty(0)
    if c2w.shape not in ((4, 4), (3, 4)):
        raise InputError(f"{where}: 'transform_matrix' must be 4 x 4 numbers, camera to world")
    if not np.isfinite(c2w).all():
        return None
    if c2w.shape == (4, 4) and not np.allclose(c2w[3], (0, 0, 0, 1), atol=1e-6):
        raise InputError(f"{where}: the last row of 'transform_matrix' must be [0, 0, 0, 1], got {c2w[3].tolist()}")
    R = c2w[:3, :3]
    gram = R.T @ R
    if np.abs(gram - np.eye(3)).max() > RIGID_TOLERANCE:
        scale = math.sqrt(np.trace(gram) / 3)
        uniform = np.abs(gram - scale**2 * np.eye(3)).max() <= RIGID_TOLERANCE * scale**2
        fault = f"its rotation is scaled by {scale:g}; divide its first three columns by that"
        if not uniform:
            fault = "its first three columns must be orthogonal unit vectors; export the poses without scale or shear"
        raise InputError(f"{where}: 'transform_matrix' is not a rigid transform: {fault}")
    if np.linalg.det(R) < 0:
        raise InputError(f"{where}: 'transform_matrix' mirrors the world (determinant -1); negate one of its columns")
    w2c = np.eye(4)
    w2c[:3] = np.linalg.inv(np.vstack([c2w[:3], w2c[3]]) @ OPENGL_TO_OPENCV)[:3]
    return w2c


def _lens(where: str, frame: Fields, meta: Fields, size: tuple[int, int] | None) -> Lens:
    """Intrinsics of one frame; `size` is (height, width) of the photographs where the file does not say."""

    def number(*keys: str) -> tuple[str, float] | None:
        """First of `keys` that the frame has, or else the file as a whole."""
        for source in (frame, meta):
            for key in keys:
                if key in source:
                    value = source[key]
                    if isinstance(value, bool) or not isinstance(value, (int, float)) or abs(value) > MAX_NUMBER:
                        raise InputError(f"{where}: '{key}' must be a number, got {value!r}")
                    return key, float(value)
        return None

    def pixels(key: str, default: int | None) -> int:
        found = number(key)
        if found is None and default is None:
            raise InputError(f"{where}: has no '{key}' (image size in pixels)")
        value = found[1] if found else float(default or 0)
        if not (0 < value < 1e6 and value == int(value)):
            raise InputError(f"{where}: '{key}' must be a positive whole number of pixels, got {value:g}")
        return int(value)

    def focal(found: tuple[str, float], extent: int) -> float:
        key, value = found
        if not key.startswith("camera_angle"):
            return value
        if not 0 < value < math.pi:
            raise InputError(f"{where}: '{key}' must be a field of view in radians between 0 and pi, got {value:g}")
        return 0.5 * extent / math.tan(0.5 * value)

    model = frame.get("camera_model", meta.get("camera_model", "OPENCV"))
    if model not in (*PERSPECTIVE_MODELS, *FISHEYE_MODELS):
        supported = ", ".join((*PERSPECTIVE_MODELS, *FISHEYE_MODELS))
        raise InputError(
            f"{where}: camera_model {model!r} is not supported (supported: {supported}); undistort it first"
        )
    fisheye = model in FISHEYE_MODELS or bool(frame.get("is_fisheye", meta.get("is_fisheye", False)))
    keys = FISHEYE_DISTORTION if fisheye else PERSPECTIVE_DISTORTION
    distortion = tuple(found[1] if (found := number(key)) else 0.0 for key in keys)
    if not fisheye and (k4 := number("k4")) and k4[1] != 0:
        raise InputError(f"{where}: 'k4' is only defined for camera_model OPENCV_FISHEYE; correct the camera model")
    height, width = (pixels(key, size[i] if size else None) for i, key in enumerate(("h", "w")))
    horizontal = number("fl_x", "camera_angle_x") or number("fl_y", "camera_angle_y")
    if horizontal is None:
        raise InputError(f"{where}: has no focal length ('fl_x' in pixels or 'camera_angle_x' in radians)")
    fx = focal(horizontal, height if horizontal[0] == "camera_angle_y" else width)
    vertical = number("fl_y", "camera_angle_y")
    fy = focal(vertical, height) if vertical else fx
    cx, cy = number("cx"), number("cy")
    try:
        return Lens(fx, fy, cx[1] if cx else width / 2, cy[1] if cy else height / 2, width, height, distortion, fisheye)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
