"""SOG, PlayCanvas' scenes of WebP pictures, version 2: a .sog (zip) or the meta.json of a folder.

    means_l, means_u    low and high byte of 16 bits between mins and maxs of sign(x) ln(1 + |x|)
    quats               red, green, blue: the three smaller of (w, x, y, z) * sqrt(2) in +-1; alpha: 252 + the largest
    scales              index into a codebook of 256 logarithms, per axis
    sh0                 index into a codebook of 256 coefficients, per channel; alpha: opacity
    shN_labels          16 bits, red and green: which of up to 65,536 palettes
    shN_centroids       64 palettes a row, one pixel a coefficient, each channel an index into a codebook

Source: the format's page at developer.playcanvas.com and playcanvas/splat-transform, read for the layout only.
"""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sgwarp.errors import InputError
from sgwarp.files.access import read_bytes
from sgwarp.files.archives import Archive, open_archive
from sgwarp.files.documents import parse_json
from sgwarp.io.formats.axes import PLY_AXES, change_axes
from sgwarp.io.formats.packed import blocks, most_gaussians
from sgwarp.io.ply import build_gaussians
from sgwarp.scene import Gaussians

META = "meta.json"
PALETTES_A_ROW = 64
COEFFICIENTS = {1: 3, 2: 8, 3: 15}  # above degree 0, by bands
OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
LARGEST_META = 1 << 20  # bytes

Fetch = Callable[[str], bytes]


def read_sog(path: str | os.PathLike[str], axes: str = PLY_AXES) -> Gaussians:
    """Read a SOG scene, version 2.

    Args:
        path: A .sog, a meta.json, or the folder that holds one.
        axes: Directions of the file's axes; SOG keeps those of the PLY it was made from, RDF.

    Raises:
        InputError: A file is missing, damaged, or of another version.
    """
    path = Path(path)
    if path.is_dir():
        path = path / META
    if path.suffix.lower() == ".json":
        files = {file.name: file.stat().st_size for file in path.parent.iterdir()} if path.parent.is_dir() else {}

        def fetch(name: str) -> bytes:
            if "/" in name or "\\" in name:
                raise InputError(f"{path}: names the picture {name[:80]!r}, which does not lie beside it")
            return read_bytes(path.parent / name)

        gaussians = _decode(path, read_bytes(path), fetch, sum(files.values()))
    else:
        with open_archive(path) as archive:
            root = _root(archive)
            read = lambda name: _member(archive, root + name)  # noqa: E731
            gaussians = _decode(path, read(META), read, archive.size)
    return change_axes(gaussians, axes, PLY_AXES)


def _root(archive: Archive) -> str:
    """What stands before the names of a scene's files: nothing, or the folder that was packed."""
    inside = [re.split(r"[/\\]", name) for name in archive.members]
    metas = [parts for parts in inside if parts[-1] == META and parts[0] != "__MACOSX"]
    least = min(map(len, metas), default=0)
    found = sorted({name[: -len(META)] for name in archive.members if re.split(r"[/\\]", name) in metas})
    found = [root for root in found if len(re.split(r"[/\\]", root)) == least]
    if len(found) > 1:
        raise InputError(f"{archive.path}: holds {len(found)} scenes ({', '.join(found)[:80]}); unpack it and give one")
    return found[0] if found else ""


def _member(archive: Archive, name: str) -> bytes:
    """A picture or the JSON of an archive; neither shrinks much in a zip, so that a larger claim is false."""
    info = archive.members.get(name)
    if info is not None and info.file_size > 4 * archive.size + LARGEST_META:
        raise InputError(f"{archive.path}: its entry {name[:80]!r} claims {info.file_size} bytes; the file is damaged")
    return bytes(archive.read(name))


class _Meta:
    """What meta.json says, checked when asked for."""

    def __init__(self, path: Path, data: bytes) -> None:
        self.path = path
        try:
            meta = parse_json(path, data) if len(data) <= LARGEST_META else None
        except InputError:
            meta = None
        if not isinstance(meta, dict) or not isinstance(meta.get("means"), dict):
            raise InputError(f"{path}: its meta.json is damaged, or not that of a SOG scene")
        if meta.get("version") != 2:
            raise InputError(
                f"{path}: is SOG of version {meta.get('version', 1)}, version 2 is read; convert it with "
                "splat-transform"
            )
        self.meta = meta

    def section(self, name: str) -> Mapping[str, Any]:
        section = self.meta.get(name)
        if not isinstance(section, dict):
            raise InputError(f"{self.path}: its meta.json lacks '{name}'")
        return section

    def files(self, name: str, count: int) -> list[str]:
        files = self.section(name).get("files")
        if not isinstance(files, list) or len(files) != count or not all(isinstance(file, str) for file in files):
            raise InputError(f"{self.path}: '{name}' must name {count} files")
        return files

    def numbers(self, name: str, key: str, count: int) -> NDArray[np.float32]:
        try:
            values = np.array(self.section(name).get(key), np.float64)
        except (OverflowError, TypeError, ValueError):
            values = np.empty(0)
        if values.shape != (count,) or not np.isfinite(values).all():
            raise InputError(f"{self.path}: '{key}' of '{name}' must be {count} finite numbers")
        return values.astype(np.float32)

    def whole(self, value: Any, name: str, low: int, high: int) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise InputError(f"{self.path}: '{name}' must be a whole number from {low} to {high}, got {value!r}")
        return value


def _decode(path: Path, data: bytes, fetch: Fetch, size: int) -> Gaussians:
    meta = _Meta(path, data)
    count = meta.whole(meta.meta.get("count"), "count", 1, most_gaussians(size))

    def pixels(name: str, least: int = count) -> NDArray[np.uint8]:
        return _picture(path, name, fetch(name), least).reshape(-1, 4)

    higher = _Higher.of(path, meta, fetch, pixels)
    means, scales = np.empty((2, count, 3), np.float32)
    quats, opacities = np.empty((count, 4), np.float32), np.empty(count, np.float32)
    sh = np.empty((count, 1 + higher.width, 3), np.float32)
    low, high = (pixels(name) for name in meta.files("means", 2))
    mins, maxs = meta.numbers("means", "mins", 3), meta.numbers("means", "maxs", 3)
    for at in blocks(count):
        logs = mins + (maxs - mins) * ((high[at, :3].astype(np.float32) * 256 + low[at, :3]) / 65535)
        with np.errstate(over="ignore"):
            means[at] = np.sign(logs) * np.expm1(np.abs(logs))
    del low, high  # a picture is let go before the next one comes
    with np.errstate(over="ignore"):
        sizes = np.exp(meta.numbers("scales", "codebook", 256))
    _look_up(scales, sizes, pixels(meta.files("scales", 1)[0]))
    rotations = pixels(meta.files("quats", 1)[0])
    for at in blocks(count):
        quats[at] = _quaternions(path, rotations[at])
    del rotations
    rgba = pixels(meta.files("sh0", 1)[0])
    _look_up(sh[:, 0], meta.numbers("sh0", "codebook", 256), rgba)
    for at in blocks(count):
        opacities[at] = rgba[at, 3].astype(np.float32) / 255
    del rgba
    higher.fill(sh)
    return build_gaussians(path, means, quats, scales, opacities, sh)


def _look_up(values: NDArray[np.float32], codebook: NDArray[np.float32], rgba: NDArray[np.uint8]) -> None:
    """Fill [N, 3] with what red, green and blue stand for."""
    for at in blocks(len(values)):
        values[at] = codebook[rgba[at, :3]]


def _quaternions(path: Path, rgba: NDArray[np.uint8]) -> NDArray[np.float32]:
    largest = rgba[:, 3].astype(np.intp) - 252
    if bool((largest < 0).any()):
        raise InputError(f"{path}: its rotations are damaged (no index of the largest component)")
    smaller = (rgba[:, :3].astype(np.float32) / 255 - np.float32(0.5)) * np.float32(np.sqrt(2.0))
    quats = np.repeat(np.sqrt(np.maximum(1 - (smaller**2).sum(axis=1, keepdims=True), 0)), 4, axis=1)
    np.put_along_axis(quats, OTHERS[largest], smaller, axis=1)
    return quats


class _Higher:
    """Coefficients above degree 0: palettes, and which of them each Gaussian has."""

    def __init__(
        self, path: Path, width: int = 0, table: NDArray[np.float32] | None = None, labels: Any = None
    ) -> None:
        self.path, self.width, self._table, self._labels = path, width, table, labels

    @classmethod
    def of(cls, path: Path, meta: _Meta, fetch: Fetch, pixels: Callable[[str], NDArray[np.uint8]]) -> _Higher:
        if "shN" not in meta.meta:
            return cls(path)
        section = meta.section("shN")
        palettes = meta.whole(section.get("count"), "shN.count", 1, 65536)
        width = COEFFICIENTS[meta.whole(section.get("bands"), "shN.bands", 1, 3)]
        centroid_file, label_file = meta.files("shN", 2)
        rows = -(-palettes // PALETTES_A_ROW)
        picture = _picture(path, centroid_file, fetch(centroid_file), rows * PALETTES_A_ROW * width)
        if picture.shape[1] != PALETTES_A_ROW * width or len(picture) < rows:
            raise InputError(
                f"{path}: {centroid_file} is {picture.shape[1]} x {len(picture)}, too small for its palettes"
            )
        table = meta.numbers("shN", "codebook", 256)[picture[:rows, :, :3].reshape(-1, width, 3)]
        return cls(path, width, table[:palettes], lambda: pixels(label_file))

    def fill(self, sh: NDArray[np.float32]) -> None:
        """Write them into [N, K, 3]."""
        if self._table is None:
            return
        labels = self._labels()
        for at in blocks(len(sh)):
            chosen = labels[at, 0].astype(np.intp) + 256 * labels[at, 1].astype(np.intp)
            if int(chosen.max()) >= len(self._table):
                highest, count = int(chosen.max()), len(self._table)
                raise InputError(f"{self.path}: a Gaussian has palette {highest} of {count}; it is damaged")
            sh[at, 1:] = self._table[chosen]


def _picture(path: Path, name: str, data: bytes, least: int) -> NDArray[np.uint8]:
    """A lossless WebP picture, uint8 [H, W, 4] in the order red, green, blue, alpha, of at least `least` pixels."""
    import cv2

    size = webp_size(data)
    if size is None:
        raise InputError(f"{path}: {name[:80]} is not a WebP picture, or is cut short")
    width, height = size
    # The header is checked first: a decoder would allocate whatever it says.
    if not least <= width * height <= 2 * least + 8192:
        raise InputError(f"{path}: {name[:80]} is {width} x {height}, expected about {least} pixels; it is damaged")
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        pixels = None
    if pixels is None or pixels.dtype != np.uint8 or pixels.shape[:2] != (height, width) or pixels.ndim != 3:
        raise InputError(f"{path}: {name[:80]} cannot be decoded; copy or download the scene again")
    if pixels.shape[2] == 3:  # opaque throughout
        pixels = np.concatenate([pixels, np.full((height, width, 1), 255, np.uint8)], axis=2)
    red = pixels[:, :, 2].copy()
    pixels[:, :, 2] = pixels[:, :, 0]
    pixels[:, :, 0] = red
    return pixels  # type: ignore[return-value]


def webp_size(data: bytes) -> tuple[int, int] | None:
    """(width, height) of a WebP picture [pixels] by its header, or None (Google's container specification)."""
    if len(data) < 30 or data[:4] != b"RIFF" or data[8:12] != b"WEBP":
        return None
    kind = data[12:16]
    if kind == b"VP8L" and data[20] == 0x2F:
        bits = struct.unpack_from("<I", data, 21)[0]
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if kind == b"VP8X":
        return int.from_bytes(data[24:27], "little") + 1, int.from_bytes(data[27:30], "little") + 1
    if kind == b"VP8 " and data[23:26] == b"\x9d\x01\x2a":
        width, height = struct.unpack_from("<HH", data, 26)
        return width & 0x3FFF, height & 0x3FFF
    return None
