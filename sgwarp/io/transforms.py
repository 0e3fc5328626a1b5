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
from sgwarp.files.exif import UPRIGHT, read_orientation
from sgwarp.files.images import read_size
from sgwarp.io.lens_models import COLMAP_MODELS, PANORAMA_REMEDY, PANORAMAS, LensModel
from sgwarp.io.names import find_named
from sgwarp.io.photograph_files import PhotographFiles
from sgwarp.io.photographs import LeftOut, fit_photograph, refuse_panorama, say_orientations
from sgwarp.io.stems import unique_stems
from sgwarp.io.undistort import Lens, Listed, pinhole_view
from sgwarp.scene import View

# Names of the coefficients, by model, in the order of sgwarp.io.lens_models.
COEFFICIENTS: dict[LensModel, tuple[str, ...]] = {
    "perspective": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "fisheye": ("k1", "k2", "k3", "k4"),
    "fov": ("omega",),
    "thin_prism_fisheye": ("k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"),
    "rad_tan_thin_prism_fisheye": tuple(["k0", "k1", "k2", "k3", "k4", "k5", "p0", "p1", "s0", "s1", "s2", "s3"]),
    "division": ("k",),
    "eucm": ("alpha", "beta"),
}
FOCAL_LENGTHS = (("fl_x", "camera_angle_x", "x_fov"), ("fl_y", "camera_angle_y", "y_fov"))  # pixels, radians, degrees
RATIONAL = ("k4", "k5", "k6")  # of FULL_OPENCV alone
MISSING, UNPOSED, TWICE = "without photograph", "whose pose holds NaN or infinity", "that are listed before"
DEPTH_UNIT, MILLIMETER = "depth_unit_scale_factor", 1e-3
BELONGINGS = ("mask_path", "depth_file_path")
IGNORED = (
    *("train_filenames", "val_filenames", "test_filenames", "semantics_path", "normal_file_path", "exposure"),
    *("depth_path", "rolling_shutter", "fisheye_crop_radius", "radial_lens"),
)
# What instant-ngp and nerfstudio know and no pinhole image can show, and what to do.
OTHER_LENSES = {
    "latlong": PANORAMA_REMEDY,
    "equirectangular": PANORAMA_REMEDY,
    "ftheta_p0": "undistort the photographs first",
    "from_mitsuba": "its axes are not OpenGL's; turn the cameras about their y axis by 180 degrees and take it out",
}
SPLITS = ("transforms_test.json", "transforms_val.json")
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])  # camera y up, z back -> y down, z forward
RIGID_TOLERANCE = 1e-3
MAX_NUMBER = 1e100  # JSON knows integers that no float can hold

Fields = Mapping[str, Any]


def read_transforms(path: str | os.PathLike[str], photographs: bool = True) -> list[View]:
    """Read the cameras of a transforms.json, in the order of its frames.

    Intrinsics (fl_x fl_y cx cy w h, or camera_angle_x/y; k1 k2 k3 k4 p1 p2) may stand in a frame or once for all; a
    frame's own win. A missing fl_y equals fl_x, a missing principal point is the centre of the image, a missing size
    is that of the photograph. The extension of a file name may be missing. Frames that cannot be used (no photograph,
    one of another shape, no rigid pose) are left out, with a logged notice of how many. Distorted photographs are
    undistorted when read (`View.undistort`), and the camera is that of the undistorted image.

    Args:
        path: The JSON file; file names in it are relative to its folder.
        photographs: False to take the cameras alone: then no photograph is looked for, and sizes must be in the file.

    Raises:
        InputError: The file is missing or malformed, or no frame is left.
    """
    path = Path(path)
    meta = _parse(path)
    left_out = LeftOut(path, "frames")
    files = PhotographFiles(path, (f.get("file_path") for f in meta["frames"] if isinstance(f, dict)))
    kept: list[tuple[int, Fields, NDArray[np.float64], Path | None]] = []
    seen: set[Path | str] = set()
    _refuse_other_lenses(path, meta)
    for index, frame in enumerate(meta["frames"]):
        where = f"{path}: frame {index}"
        name = frame.get("file_path") if isinstance(frame, dict) else None
        if not isinstance(name, str) or not name:
            error = InputError(f"{where}: has no 'file_path'; name the photograph it belongs to")
            left_out.fail(error, f"frame {index}")
            continue
        image = files.locate(path.parent, name) if photographs else None
        if photographs and image is None:
            left_out.add(MISSING, name)
            continue
        if (image or name) in seen:
            left_out.add(TWICE, name)
            continue
        try:
            pose = _world_to_camera(f"{where} ({name})", frame.get("transform_matrix"))
        except InputError as error:
            left_out.fail(error, name)
            continue
        if pose is None:
            left_out.add(UNPOSED, name)
        else:
            seen.add(image or name)
            kept.append((index, frame, pose, image))
    stems = unique_stems(path, [frame["file_path"] for _, frame, _, _ in kept])
    views, used = [], []
    for stem, (index, frame, pose, image) in zip(stems, kept, strict=True):
        try:
            view, orientation = _view(path, meta, stem, index, frame, pose, image)
        except InputError as error:
            left_out.fail(error, frame["file_path"])
            continue
        views.append(view)
        if image is not None:
            used.append((image, orientation))
    if not views:
        first = left_out.first(MISSING)
        raise InputError(
            left_out.first_error
            or f"{path}: none of {len(meta['frames'])} frames can be used: {left_out.count(MISSING)} photographs do "
            f"not exist (first {path.parent / first if first else '-'}), {left_out.count(UNPOSED)} poses hold NaN or "
            "infinity"
        )
    left_out.say()
    files.say()
    say_orientations(path, used)
    _say_ignored(path, meta)
    return views


def _view(
    path: Path, meta: Fields, stem: str, index: int, frame: Fields, pose: NDArray[np.float64], image: Path | None
) -> tuple[View, int]:
    """The view of a frame, and the EXIF orientation that its photograph has to be turned by."""
    name = frame["file_path"]
    where = f"{path}: frame {index} ({name})"
    sized = all(frame.get(key, meta.get(key)) is not None for key in ("w", "h"))
    size, orientation = (None, UPRIGHT)
    if image is not None and not sized:
        size, orientation = _size_of(image, frame, meta)
    lens = _lens(where, frame, meta, size)
    if image is not None and sized:
        lens, orientation = fit_photograph(lens, image)
    mask, depth = (_belonging(path, frame, key) for key in BELONGINGS)
    units = [source[DEPTH_UNIT] for source in (frame, meta) if source.get(DEPTH_UNIT) is not None]
    unit = _number(where, DEPTH_UNIT, units[0] if units else MILLIMETER)
    if not unit > 0:
        raise InputError(f"{where}: '{DEPTH_UNIT}' must be a positive number of meters, got {unit:g}")
    listed = Listed(name, image, orientation, mask, depth, unit)
    return pinhole_view(where, stem, lens, pose, listed), orientation


def _size_of(image: Path, frame: Fields, meta: Fields) -> tuple[tuple[int, int], int]:
    """(height, width) of a photograph whose camera gives none, and the EXIF orientation that it has to be turned by.

    One that lies sideways is turned if the principal point is nearer to the middle of the upright one.
    """
    height, width = read_size(image)
    refuse_panorama(image, height, width)
    orientation = read_orientation(image)
    middle = [frame.get(key, meta.get(key)) for key in ("cx", "cy")]
    if orientation >= 5 and all(isinstance(value, (int, float)) for value in middle):
        lying, upright = (math.dist(middle, (w / 2, h / 2)) for w, h in ((width, height), (height, width)))
        if upright < lying:
            return (width, height), orientation
    return (height, width), UPRIGHT


def _belonging(path: Path, frame: Fields, key: str) -> Path | None:
    """A file that a frame names beside its photograph, or None; `_say_ignored` tells of those that do not exist."""
    name = frame.get(key)
    if not isinstance(name, str) or not name:
        return None
    return find_named(path, path.parent, name)


def _say_ignored(path: Path, meta: Fields) -> None:
    """Log what the file declares and nothing here reads, and files that it names and that do not exist."""
    frames = [frame for frame in meta["frames"] if isinstance(frame, dict)]
    for key in BELONGINGS:
        named = [frame[key] for frame in frames if frame.get(key)]
        absent = [frame[key] for frame in frames if frame.get(key) and _belonging(path, frame, key) is None]
        if absent:
            logging.getLogger("sgwarp").warning(
                "%s: %d of %d files that its frames name as %s do not exist, first %s",
                *(path, len(absent), len(named), key, absent[0]),
            )
    ignored = [key for key in IGNORED if _says(meta.get(key))]
    ignored += [f"{key} of the frames" for key in IGNORED if any(_says(frame.get(key)) for frame in frames)]
    beside = [name for name in SPLITS if path.name == "transforms_train.json" and (path.parent / name).is_file()]
    if beside:
        logging.getLogger("sgwarp").info("%s: is read alone; give %s by name to read that", path, " or ".join(beside))
    if ignored:
        logging.getLogger("sgwarp").warning("%s: not used: %s", path, ", ".join(dict.fromkeys(ignored)))


def _says(value: Any) -> bool:
    """Whether a field holds more than nothing, zeros or a negative number that stands for nothing."""
    numbers = value if isinstance(value, list) else [value]
    return any(not (isinstance(n, (int, float)) and n <= 0) and bool(n) for n in numbers)


def _refuse_other_lenses(path: Path, meta: Fields) -> None:
    """Raise InputError where the file asks for a lens or axes that would otherwise be silently taken for others."""
    for key, remedy in OTHER_LENSES.items():
        if meta.get(key) or any(isinstance(frame, dict) and frame.get(key) for frame in meta["frames"]):
            raise InputError(f"{path}: '{key}' is not supported; {remedy}")


def _parse(path: Path) -> dict[str, Any]:
    meta = read_json(path)
    if not isinstance(meta, dict) or not isinstance(meta.get("frames"), list):
        raise InputError(f"{path}: has no list 'frames'; expected a transforms.json of nerfstudio or instant-ngp")
    if not meta["frames"]:
        raise InputError(f"{path}: its list 'frames' is empty; it must name at least one photograph")
    return meta


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


def _number(where: str, key: str, value: Any) -> float:
    """A number, which some tools write in quotes."""
    try:
        number = math.nan if isinstance(value, (bool, list, dict)) or value is None else float(value)
    except (OverflowError, ValueError):
        number = math.nan
    if not abs(number) <= MAX_NUMBER:
        raise InputError(f"{where}: '{key}' must be a number, got {value!r}")
    return number


def _lens(where: str, frame: Fields, meta: Fields, size: tuple[int, int] | None) -> Lens:
    """Intrinsics of one frame; `size` is (height, width) of the photographs where the file does not say."""

    def number(*keys: str) -> tuple[str, float] | None:
        """First of `keys` that the frame has, or else the file as a whole."""
        for source in (frame, meta):
            for key in keys:
                if source.get(key) is not None:
                    return key, _number(where, key, source[key])
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
        if key.startswith("fl_"):
            return value
        degrees = key.endswith("_fov")
        angle = math.radians(value) if degrees else value
        if not 0 < angle < math.pi:
            unit = "degrees between 0 and 180" if degrees else "radians between 0 and pi"
            perhaps = (
                f"; if these are degrees, name it '{key[-1]}_fov'" if not degrees and math.pi < value < 180 else ""
            )
            raise InputError(f"{where}: '{key}' must be a field of view in {unit}, got {value:g}{perhaps}")
        return 0.5 * extent / math.tan(0.5 * angle)

    model = frame.get("camera_model", meta.get("camera_model", "OPENCV"))
    name = model.upper() if isinstance(model, str) else ""
    name = "OPENCV" if name == "PERSPECTIVE" else name  # as nerfstudio calls it in other places
    if name not in COLMAP_MODELS:
        remedy = PANORAMA_REMEDY if name in PANORAMAS else "undistort the photographs first"
        raise InputError(
            f"{where}: camera_model {model!r} is not supported; {remedy} (supported: {', '.join(COLMAP_MODELS)})"
        )
    kind: LensModel = COLMAP_MODELS[name][0]
    if kind == "perspective" and frame.get("is_fisheye", meta.get("is_fisheye", False)):
        kind = "fisheye"
    distortion = tuple(found[1] if (found := number(key)) else 0.0 for key in COEFFICIENTS[kind])
    if kind == "perspective" and name != "FULL_OPENCV":
        for key in RATIONAL:
            if (found := number(key)) and found[1] != 0:
                raise InputError(f"{where}: '{key}' is not defined for camera_model {model}; correct the camera model")
        distortion = distortion[: -len(RATIONAL)]
    height, width = (pixels(key, size[i] if size else None) for i, key in enumerate(("h", "w")))
    across, down = FOCAL_LENGTHS
    horizontal = number(*across) or number(*down)
    if horizontal is None:
        raise InputError(f"{where}: has no focal length ('fl_x' in pixels or 'camera_angle_x' in radians)")
    fx = focal(horizontal, height if horizontal[0] in down else width)
    vertical = number(*down)
    fy = focal(vertical, height) if vertical else fx
    cx, cy = number("cx"), number("cy")
    if size and cx and cy and not any(0.25 < c[1] / extent < 0.75 for c, extent in ((cx, width), (cy, height))):
        raise InputError(
            f"{where}: has no 'w' and 'h', and its photograph is {width} x {height}, while 'cx' and 'cy' are the "
            f"middle of one of about {2 * cx[1]:.0f} x {2 * cy[1]:.0f}; add the size that the numbers are meant for"
        )
    try:
        return Lens(fx, fy, cx[1] if cx else width / 2, cy[1] if cy else height / 2, width, height, distortion, kind)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
