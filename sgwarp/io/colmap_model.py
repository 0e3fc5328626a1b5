"""Records of a COLMAP sparse model, from .bin or .txt files (colmap.github.io/format.html)."""

from __future__ import annotations

import io
import struct
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sgwarp.errors import InputError
from sgwarp.files.access import read_bytes
from sgwarp.io.undistort import Lens

# Number in the binary format -> name and number of parameters.
MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
}
PARAMETER_COUNTS = dict(MODELS.values())
SUPPORTED = (
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "FULL_OPENCV",
    "OPENCV_FISHEYE",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
)


@dataclass(frozen=True)
class ImageRecord:
    """One registered image: rotation (w, x, y, z) and translation (x, y, z), world to camera, OpenCV axes."""

    camera_id: int
    name: str
    quat: tuple[float, ...]
    translation: tuple[float, ...]


def read_cameras(folder: Path) -> dict[int, Lens]:
    """Lenses by camera id.

    Raises:
        InputError: The file is missing or damaged, or a camera model is not supported.
    """
    path = _model_file(folder, "cameras")
    lenses: dict[int, Lens] = {}
    for camera_id, model, width, height, values in (
        _cameras_binary(path) if path.suffix == ".bin" else _cameras_text(path)
    ):
        lenses[camera_id] = _lens(f"{path}: camera {camera_id}", model, width, height, values)
    return lenses


def read_images(folder: Path) -> list[ImageRecord]:
    """All registered images, sorted by name (the files are in no particular order).

    Raises:
        InputError: The file is missing or damaged.
    """
    path = _model_file(folder, "images")
    records = _images_binary(path) if path.suffix == ".bin" else _images_text(path)
    return sorted(records, key=lambda record: record.name)


def read_points(path: str | Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """The sparse points of a model: positions, float64 [N, 3], and colours, uint8 [N, 3].

    Args:
        path: points3D.bin, points3D.txt, or a folder that holds one (the model, or what `load_views` takes).

    Raises:
        InputError: The file is missing or damaged.
    """
    path = Path(path)
    if path.is_dir():
        path = _model_file(find_model(path) or path, "points3D")
    numbers = array("d")  # 8 bytes each; as Python's numbers they would take five times the file
    for row in _points_binary(path) if path.suffix == ".bin" else _points_text(path):
        numbers.extend(row)
    table = np.frombuffer(numbers, dtype=np.float64).reshape(-1, 6) if numbers else np.zeros((0, 6))
    return np.ascontiguousarray(table[:, :3]), table[:, 3:].astype(np.uint8)


def find_model(folder: Path) -> Path | None:
    """The sparse model of a data set: in sparse/0, sparse, colmap/sparse/0 or the folder itself."""
    for candidate in (folder / "sparse" / "0", folder / "sparse", folder / "colmap" / "sparse" / "0", folder):
        if any((candidate / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt")):
            return candidate
    return None


def _model_file(folder: Path, name: str) -> Path:
    """COLMAP prefers binary where a folder holds both."""
    for suffix in (".bin", ".txt"):
        if (folder / (name + suffix)).is_file():
            return folder / (name + suffix)
    raise InputError(f"{folder}: has neither {name}.bin nor {name}.txt; export the sparse model with COLMAP")


def _lens(where: str, model: str, width: int, height: int, values: tuple[float, ...]) -> Lens:
    if model not in SUPPORTED:
        raise InputError(
            f"{where}: model {model} is not supported (supported: {', '.join(SUPPORTED)}); run COLMAP's "
            "image_undistorter first"
        )
    if len(values) != PARAMETER_COUNTS[model]:
        raise InputError(f"{where}: model {model} has {PARAMETER_COUNTS[model]} parameters, found {len(values)}")
    if model.startswith("SIMPLE_") or model in ("RADIAL", "RADIAL_FISHEYE"):
        values = (values[0], *values)  # one focal length for both axes
    fx, fy, cx, cy, *distortion = values
    try:
        # The order of FULL_OPENCV (k1 k2 p1 p2 k3 k4 k5 k6), and so of those that are a part of it, is OpenCV's.
        return Lens(fx, fy, cx, cy, width, height, tuple(distortion), "FISHEYE" in model)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


class _Bytes:
    """A binary file read field by field, little-endian; running out of bytes is an InputError."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.data = read_bytes(path)
        self.position = 0
        self.record = "the number of records"

    def take(self, layout: str) -> tuple[Any, ...]:
        size = struct.calcsize("<" + layout)
        self.skip(size)
        return struct.unpack_from("<" + layout, self.data, self.position - size)

    def skip(self, size: int) -> None:
        if self.position + size > len(self.data):
            raise self.cut_short()
        self.position += size

    def name(self) -> str:
        """A zero-terminated string."""
        end = self.data.find(b"\0", self.position)
        if end < 0:
            raise self.cut_short()
        text = self.data[self.position : end].decode("utf-8", "replace")
        self.position = end + 1
        return text

    def cut_short(self) -> InputError:
        return InputError(
            f"{self.path}: is cut short: ends after {len(self.data)} bytes in {self.record}; copy or export it again"
        )

    def records(self, kind: str) -> Iterator[int]:
        (count,) = self.take("Q")
        for index in range(count):
            self.record = f"{kind} {index} of {count}"
            yield index


def _cameras_binary(path: Path) -> Iterator[tuple[int, str, int, int, tuple[float, ...]]]:
    data = _Bytes(path)
    for _ in data.records("camera"):
        camera_id, number, width, height = data.take("iiQQ")
        if number not in MODELS:
            raise InputError(
                f"{path}: camera {camera_id}: model number {number} is not known; export the model as text"
            )
        model, count = MODELS[number]
        yield camera_id, model, width, height, data.take(f"{count}d")


def _images_binary(path: Path) -> Iterator[ImageRecord]:
    data = _Bytes(path)
    for _ in data.records("image"):
        _, *pose, camera_id = data.take("i7di")
        name = data.name()
        (observations,) = data.take("Q")
        data.skip(24 * observations)  # x, y, id of the point
        yield ImageRecord(camera_id, name, tuple(pose[:4]), tuple(pose[4:]))


def _points_binary(path: Path) -> Iterator[tuple[float, ...]]:
    data = _Bytes(path)
    for _ in data.records("point"):
        _, *values, _, observations = data.take("Q3d3BdQ")
        data.skip(8 * observations)  # id of the image, index of the observation
        yield tuple(values)


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Numbered lines without comments."""
    text = io.TextIOWrapper(io.BytesIO(read_bytes(path)), "utf-8", "replace")
    for number, line in enumerate(text, start=1):
        if not line.lstrip().startswith("#"):
            yield number, line.strip()


def _cameras_text(path: Path) -> Iterator[tuple[int, str, int, int, tuple[float, ...]]]:
    for number, line in _lines(path):
        if line:
            fields = line.split()
            try:
                camera_id, width, height = int(fields[0]), int(fields[2]), int(fields[3])
                yield camera_id, fields[1], width, height, tuple(map(float, fields[4:]))
            except (IndexError, ValueError):
                raise _malformed(path, number, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]") from None


def _images_text(path: Path) -> Iterator[ImageRecord]:
    lines = _lines(path)
    for number, line in lines:
        if line:
            fields = line.split(maxsplit=9)
            try:
                pose = tuple(map(float, fields[1:8]))
                record = ImageRecord(int(fields[8]), fields[9], pose[:4], pose[4:])
            except (IndexError, ValueError):
                raise _malformed(path, number, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME") from None
            yield record
            next(lines, None)  # the observations, an empty line if there are none


def _points_text(path: Path) -> Iterator[tuple[float, ...]]:
    for number, line in _lines(path):
        if line:
            fields = line.split(maxsplit=7)
            try:
                values = tuple(map(float, fields[1:7]))
                if len(values) < 6 or not all(0 <= c <= 255 for c in values[3:]):
                    raise ValueError
            except ValueError:
                raise _malformed(path, number, "POINT3D_ID X Y Z R G B ERROR TRACK[]") from None
            yield values


def _malformed(path: Path, number: int, expected: str) -> InputError:
    return InputError(f"{path}: line {number} is malformed, expected {expected}; export the model again")
