"""Records of a COLMAP sparse model, from .bin or .txt files (colmap.github.io/format.html)."""

from __future__ import annotations

import io
import re
import struct
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sgwarp.errors import InputError
from sgwarp.files.access import read_bytes, reading
from sgwarp.io.lens_models import COLMAP_MODELS, PANORAMA, PANORAMA_REMEDY
from sgwarp.io.undistort import Lens

MODEL_NAMES = (*COLMAP_MODELS, PANORAMA)  # by the number in the binary format
PARAMETER_COUNTS = {name: focals + 2 + count for name, (_, focals, count) in COLMAP_MODELS.items()}
PARAMETER_COUNTS[PANORAMA] = 2
GREY = 128.0
PLACES = ("sparse", "colmap/sparse", "dense/sparse", "dense/0/sparse", "distorted/sparse", ".")
MOST_FIELDS = 32  # of a camera; more are one that is no number
LONGEST_LINE = 1 << 24  # characters; an image with 20,000 observations has 500,000
RECORD_BYTES = {"cameras": 24, "images": 73, "points3D": 43}  # the least of one record


@dataclass(frozen=True)
class ImageRecord:
    """One registered image: rotation (w, x, y, z) and translation (x, y, z), world to camera, OpenCV axes."""

    camera_id: int
    name: str
    quat: tuple[float, ...]
    translation: tuple[float, ...]


def read_cameras(folder: Path) -> dict[int, Lens | InputError]:
    """Lenses by camera id; of a camera that cannot be used, the error that says why.

    Raises:
        InputError: The file is missing or damaged.
    """
    path = _model_file(folder, "cameras")
    lenses: dict[int, Lens | InputError] = {}
    for camera_id, model, width, height, values in (
        _cameras_binary(path) if path.suffix == ".bin" else _cameras_text(path)
    ):
        lenses[camera_id] = _lens_or_error(f"{path}: camera {camera_id}", model, width, height, values)
    return lenses


def read_images(folder: Path) -> list[ImageRecord]:
    """All registered images, sorted by name (the files are in no particular order).

    Raises:
        InputError: The file is missing or damaged.
    """
    path = _model_file(folder, "images")
    records = _images_binary(path) if path.suffix == ".bin" else _images_text(path)
    return sorted(records, key=lambda record: record.name)


def read_points(path: str | Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The sparse points of a model: positions, float64 [N, 3], and colors as they stand there, float64 [N, 3].

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
    return np.ascontiguousarray(table[:, :3]), np.ascontiguousarray(table[:, 3:])


def find_model(folder: Path) -> Path | None:
    """The sparse model of a data set, the one with most images where it holds several."""
    models = find_models(folder)
    return max(models, key=count_images) if models else None  # the first of equals


def find_models(folder: Path) -> list[Path]:
    """The models in the first place that holds any: sparse/*, sparse, colmap/sparse/*, ..., the folder itself."""
    for place in (folder / name for name in PLACES):
        numbered = sorted((path for path in _folders(place) if _holds(path, "cameras")), key=_by_number)
        # The folder that was asked for counts before what lies in it.
        models = [place, *numbered] if place == folder else [*numbered, place]
        models = [path for path in models if _holds(path, "cameras")]
        if models:
            return models[:1] if models[0] == folder else models
    return []


def holds_model(folder: Path) -> bool:
    """Whether a folder is a sparse model."""
    return _holds(folder, "cameras")


def count_images(model: Path) -> int:
    """How many images a model says it holds, at most what its file has room for; 0 if it has none."""
    for suffix in (".bin", ".txt"):
        path = model / f"images{suffix}"
        if not path.is_file():
            continue
        with reading(path), open(path, "rb") as file:
            if suffix == ".bin":
                count = int.from_bytes(file.read(8), "little")
                return min(count, path.stat().st_size // RECORD_BYTES["images"])
            return sum(map(_is_image_line, file))
    return 0


def _is_image_line(line: bytes) -> bool:
    """Whether a line of images.txt lists an image, and not observations or a comment."""
    fields = line.split()
    return (
        len(fields) >= 10 and not fields[0].startswith(b"#") and not _are_observations(line.decode("utf-8", "replace"))
    )


def _folders(place: Path) -> list[Path]:
    try:
        return [path for path in place.iterdir() if path.is_dir()]
    except OSError:
        return []


def _holds(folder: Path, name: str) -> bool:
    return any((folder / f"{name}{suffix}").is_file() for suffix in (".bin", ".txt"))


def _by_number(folder: Path) -> tuple[bool, int, str]:
    number = folder.name.isdecimal()
    return not number, int(folder.name) if number else 0, folder.name


def _model_file(folder: Path, name: str) -> Path:
    """COLMAP prefers binary where a folder holds both."""
    for suffix in (".bin", ".txt"):
        if (folder / (name + suffix)).is_file():
            return folder / (name + suffix)
    raise InputError(f"{folder}: has neither {name}.bin nor {name}.txt; export the sparse model with COLMAP")


def _lens_or_error(where: str, model: str, width: int, height: int, values: tuple[float, ...]) -> Lens | InputError:
    try:
        return _lens(where, model, width, height, values)
    except InputError as error:
        return error


def _lens(where: str, model: str, width: int, height: int, values: tuple[float, ...]) -> Lens:
    model = model.upper()
    if model not in COLMAP_MODELS:
        remedy = PANORAMA_REMEDY if model == PANORAMA else "run COLMAP's image_undistorter first"
        raise InputError(f"{where}: model {model} is not supported; {remedy} (supported: {', '.join(COLMAP_MODELS)})")
    if len(values) != PARAMETER_COUNTS[model]:
        raise InputError(f"{where}: model {model} has {PARAMETER_COUNTS[model]} parameters, found {len(values)}")
    kind, focals, _ = COLMAP_MODELS[model]
    fx, fy, cx, cy, *distortion = values if focals == 2 else (values[0], *values)
    try:
        return Lens(fx, fy, cx, cy, width, height, tuple(distortion), kind)
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
        if not 0 <= number < len(MODEL_NAMES):
            # How many parameters it has is not known, so what follows cannot be read either.
            raise InputError(
                f"{path}: camera {camera_id}: model number {number} is not known (0 to {len(MODEL_NAMES) - 1} are); "
                "run COLMAP's image_undistorter, which writes PINHOLE cameras"
            )
        model = MODEL_NAMES[number]
        yield camera_id, model, width, height, data.take(f"{PARAMETER_COUNTS[model]}d")


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
    # Some editors put a mark at the start, which "utf-8-sig" takes off.
    text = io.TextIOWrapper(io.BytesIO(read_bytes(path)), "utf-8-sig", "replace")
    for number, line in enumerate(iter(lambda: text.readline(LONGEST_LINE), ""), start=1):
        if len(line) == LONGEST_LINE:
            raise InputError(f"{path}: line {number} has {LONGEST_LINE} characters or more; export the model again")
        if not line.lstrip().startswith("#"):
            yield number, line.strip()


def _cameras_text(path: Path) -> Iterator[tuple[int, str, int, int, tuple[float, ...]]]:
    for number, line in _lines(path):
        if line:
            fields = line.split(maxsplit=MOST_FIELDS)
            try:
                camera_id, width, height = (_whole(fields[i]) for i in (0, 2, 3))
                yield camera_id, fields[1], width, height, tuple(map(float, fields[4:]))
            except (IndexError, ValueError, OverflowError):
                raise _malformed(path, number, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]") from None


def _images_text(path: Path) -> Iterator[ImageRecord]:
    """Images, each with or without the line of observations that COLMAP puts below it."""
    below = False  # whether the line before was an image
    for number, line in _lines(path):
        fields = line.split(maxsplit=9)
        if not fields or (below and _are_observations(line)):
            below = False
            continue
        try:
            pose = tuple(map(float, fields[1:8]))
            record = ImageRecord(_whole(fields[8]), fields[9], pose[:4], pose[4:])
        except (IndexError, ValueError, OverflowError):
            raise _malformed(path, number, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME") from None
        below = True
        yield record


def _are_observations(line: str) -> bool:
    """Whether a line holds triplets X, Y, POINT3D_ID, and nothing but numbers."""
    count = 0
    try:
        for field in re.finditer(r"\S+", line):  # a list of all of them would take ten times the line
            float(field[0])
            count += 1
    except ValueError:
        return False
    return count % 3 == 0


def _points_text(path: Path) -> Iterator[tuple[float, ...]]:
    for number, line in _lines(path):
        if line:
            fields = line.split(maxsplit=7)
            try:
                values = tuple(map(float, fields[1:7]))
                if len(values) not in (3, 6) or not all(0 <= c <= 255 for c in values[3:]):
                    raise ValueError
            except ValueError:
                raise _malformed(path, number, "POINT3D_ID X Y Z R G B ERROR TRACK[]") from None
            yield values if len(values) == 6 else (*values, GREY, GREY, GREY)


def _whole(text: str) -> int:
    """A whole number, which some tools write as 1920.0."""
    value = float(text)
    if value != int(value):
        raise ValueError(text)
    return int(value)


def _malformed(path: Path, number: int, expected: str) -> InputError:
    return InputError(f"{path}: line {number} is malformed, expected {expected}; export the model again")
