"""SPZ, Niantic's compressed scenes, versions 1 to 4.

Versions 1 to 3 are one gzip stream: a header of 16 bytes, then positions, opacities, colors, scales, rotations and
higher harmonics one after the other. Version 4 has a plain header of 32 bytes, a table of stream sizes and one
Zstandard stream per array. Values, little-endian:

    positions   3 x 24 bits, fixed point (version 1: 3 x float16)
    opacities   uint8, of 255
    colors      uint8, 0.15 * 255 * coefficient + 127.5
    scales      uint8, (logarithm + 10) * 16
    rotations   x, y, z as uint8, value * 127.5 + 127.5, w positive (versions 1, 2);
                index of the largest of x, y, z, w (2 bits) and the other three (sign, 9 bits) (versions 3, 4)
    harmonics   uint8, 128 * value + 128, red, green, blue of one coefficient after the other

Source: nianticlabs/spz, README and load-spz.cc, read for the layout only.
"""

from __future__ import annotations

import logging
import os
import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from sgwarp.errors import InputError
from sgwarp.files.access import read_bytes
from sgwarp.files.atomic import atomic_path
from sgwarp.io.formats.axes import PLY_AXES, SPZ_AXES, change_axes, harmonic_signs, signs_between
from sgwarp.io.formats.packed import blocks, most_gaussians
from sgwarp.io.formats.zstd import ZstdStream, compress_zstd
from sgwarp.io.ply import build_gaussians, drawn_rows, host_arrays
from sgwarp.scene import SH_COUNTS, Gaussians

MAGIC = 0x5053474E  # "NGSP"
GZIP = b"\x1f\x8b"
HEADER, HEADER_4 = struct.Struct("<IIIBBBB"), struct.Struct("<IIIBBBBI12x")
STREAM = struct.Struct("<QQ")
ANTIALIASED, EXTENDED = 1, 2  # flags
FRACTION_BITS, MOST_FRACTION_BITS = 12, 24
LEAST_STEPS = 2e-4  # of the farthest coordinate, from which on a position is too coarse with these bits
LEAST_LOG, LARGEST_LOG = -10, 255 / 16 - 10  # of a scale
COLOR_SCALE = 0.15
SH_BITS = (5, 4, 4)  # kept of degree 1, 2, 3, as Niantic's writer does
SH_DEGREES = (0, 3, 8, 15, 24)  # coefficients above degree 0, by degree
OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # of x, y, z, w, without the largest
MAX_POSITION = (1 << 23) - 1
VERSIONS = (1, 2, 3, 4)
PIECE = 1 << 16  # packed bytes given to the inflater at once, which copies what it has not used
RECORD = struct.Struct("<II")  # type and bytes of an extension
AXES_RECORD = 0xADBE0003
AXES_NAMES = ("", "LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF")  # by the number in that record


@dataclass(frozen=True)
class Header:
    version: int
    count: int
    degree: int
    fraction_bits: int
    flags: int
    axes: str = SPZ_AXES

    @property
    def widths(self) -> tuple[int, ...]:
        """Bytes of one Gaussian in positions, opacities, colors, scales, rotations, harmonics."""
        position = 6 if self.version == 1 else 9
        rotation = 3 if self.version < 3 else 4
        return position, 1, 3, 3, rotation, 3 * SH_DEGREES[self.degree]

    @property
    def sizes(self) -> tuple[int, ...]:
        """Bytes of these arrays."""
        return tuple(self.count * width for width in self.widths)


class Source(Protocol):
    """What an array of the file comes from."""

    def read(self, count: int) -> bytes:
        """The next `count` bytes, all of them, or an InputError."""
        ...


class _GzipStream:
    """The unpacked bytes of a gzip stream, some at a time."""

    def __init__(self, path: str | os.PathLike[str], data: bytes) -> None:
        self.path, self._data = path, memoryview(data)
        self._inflater, self._at, self.given, self.total = zlib.decompressobj(wbits=31), 0, 0, 0

    def read(self, count: int) -> bytes:
        data = self.up_to(count)
        if len(data) < count:
            raise InputError(
                f"{self.path}: is cut short: holds {self.given} of {self.total} bytes; copy or download it again"
            )
        return data

    def up_to(self, count: int) -> bytes:
        """As many of the next `count` bytes as there are.

        Raises:
            InputError: The stream is damaged.
        """
        pieces, missing = [], count
        try:
            while missing and not self._inflater.eof:
                packed = self._inflater.unconsumed_tail or self._data[self._at : self._at + PIECE]
                if not self._inflater.unconsumed_tail:
                    self._at += len(packed)
                piece = self._inflater.decompress(packed, missing)
                if not packed and not piece:
                    break
                pieces.append(piece)
                missing -= len(piece)
        except zlib.error as error:
            raise InputError(f"{self.path}: its gzip stream is damaged ({error}); copy or download it again") from None
        self.given += count - missing
        return b"".join(pieces)


def read_spz(path: str | os.PathLike[str], axes: str | None = None) -> Gaussians:
    """Read an SPZ scene, version 1 to 4, into the axes of PLY files.

    Args:
        path: The file.
        axes: Directions of the file's axes. If None, what the file says (an extension of version 4), else RUB, which
            the specification asks for; several tools write those of PLY files unchanged, RDF.

    Raises:
        InputError: The file is missing, damaged, of another version, or empty.
    """
    return gaussians_from_spz(path, read_bytes(path), axes)


def gaussians_from_spz(path: str | os.PathLike[str], data: bytes, axes: str | None = None) -> Gaussians:
    """Decode the bytes of an SPZ scene; see `read_spz`."""
    if data[:2] == GZIP:
        stream, header = _open_gzip(path, data)
        gaussians = _decode(path, header, [stream] * 6, axes or header.axes)
        stream.up_to(1)  # reaches the checksum
    elif data[:4] == MAGIC.to_bytes(4, "little"):
        header, streams = _open_streams(path, data)
        gaussians = _decode(path, header, streams, axes or header.axes)
    else:
        raise InputError(f"{path}: is not an SPZ scene (neither gzip nor 'NGSP' at its start)")
    if header.flags & ANTIALIASED:
        logging.getLogger("sgwarp").warning("%s: was trained with antialiasing, which is not taken over", path)
    return gaussians


def _open_gzip(path: str | os.PathLike[str], data: bytes) -> tuple[_GzipStream, Header]:
    stream = _GzipStream(path, data)
    start = stream.up_to(HEADER.size)
    if len(start) < HEADER.size:
        raise InputError(f"{path}: is cut short: holds no SPZ header; copy or download it again")
    magic, version, count, degree, bits, flags, _ = HEADER.unpack(start)
    if start[:3] == b"ply":
        raise InputError(f"{path}: is a PLY file packed with gzip, which is not read; unpack it (gunzip)")
    if magic != MAGIC or version not in VERSIONS[:3]:
        raise InputError(f"{path}: is not an SPZ scene of version 1 to 3 (version {version})")
    header = _checked(path, Header(version, count, degree, bits, flags))
    _require_room(path, header, len(data))
    stream.given, stream.total = 0, sum(header.sizes)
    return stream, header


def _open_streams(path: str | os.PathLike[str], data: bytes) -> tuple[Header, list[Source]]:
    if len(data) < HEADER_4.size:
        raise InputError(f"{path}: is cut short: holds no SPZ header; copy or download it again")
    _, version, count, degree, bits, flags, streams, table = HEADER_4.unpack_from(data)
    if version != 4:
        fault = "is not packed with gzip; write it again" if version in VERSIONS else "versions 1 to 4 are read"
        raise InputError(f"{path}: is an SPZ scene of version {version}; {fault}")
    header = _checked(path, Header(version, count, degree, bits, flags))
    sizes = [size for size in header.sizes if size]  # empty streams are not written
    position = table + streams * STREAM.size
    if streams != len(sizes) or table < HEADER_4.size or position > len(data):
        raise InputError(f"{path}: its table of {streams} streams is damaged (expected {len(sizes)})")
    _require_room(path, header, len(data))
    if header.flags & EXTENDED:
        header = replace(header, axes=_named_axes(path, data[HEADER_4.size : table]))
    sources: list[Source] = []
    for index, size in enumerate(sizes):
        packed, unpacked = STREAM.unpack_from(data, table + index * STREAM.size)
        if unpacked != size or packed > len(data) - position:
            raise InputError(f"{path}: stream {index} does not have the size of {count} Gaussians; it is damaged")
        sources.append(ZstdStream(path, memoryview(data)[position : position + packed], size))
        position += packed
    return header, sources


def _named_axes(path: str | os.PathLike[str], records: bytes) -> str:
    """Axes that an extension record names, RUB if there is none; other records are left out with a logged notice."""
    axes, position, others = "", 0, 0
    while position + RECORD.size <= len(records):
        kind, size = RECORD.unpack_from(records, position)
        position += RECORD.size
        number = int.from_bytes(records[position : position + 4], "little")
        if kind == AXES_RECORD and size == 4 and number < len(AXES_NAMES):
            axes = AXES_NAMES[number]
        else:
            others += 1
        position += size
    if others:
        logging.getLogger("sgwarp").warning("%s: %d extension records are left out", path, others)
    return axes or SPZ_AXES


def _require_room(path: str | os.PathLike[str], header: Header, size: int) -> None:
    """Compare what a file of `size` bytes claims with them, before anything is unpacked."""
    if header.count > most_gaussians(size):
        raise InputError(f"{path}: claims {header.count} Gaussians, which {size} bytes cannot hold; it is damaged")


def _checked(path: str | os.PathLike[str], header: Header) -> Header:
    if header.count == 0:
        raise InputError(f"{path}: has no Gaussians")
    if header.degree >= len(SH_DEGREES):
        raise InputError(f"{path}: degree {header.degree} of the harmonics is not one of 0 to 4; it is damaged")
    if header.fraction_bits > 24:
        raise InputError(f"{path}: {header.fraction_bits} bits of fraction in 24 are not possible; it is damaged")
    return header


def _decode(path: str | os.PathLike[str], header: Header, sources: Sequence[Source], axes: str) -> Gaussians:
    """The scene in the axes of PLY files, each array filled block by block."""
    n = header.count
    x, y, z = signs = signs_between(axes, PLY_AXES)
    if header.degree > 3:
        logging.getLogger("sgwarp").warning("%s: harmonics of degree 4 are left out, up to 3 are kept", path)
    higher = min(SH_DEGREES[header.degree], SH_COUNTS[-1] - 1)
    means, scales = np.empty((2, n, 3), np.float32)
    quats, opacities = np.empty((n, 4), np.float32), np.empty(n, np.float32)
    sh = np.empty((n, 1 + higher, 3), np.float32)

    def rows(index: int) -> Iterator[tuple[slice, NDArray[np.uint8]]]:
        """Bytes of an array, uint8 [rows, width], in the order of the file."""
        width = header.widths[index]
        for at in blocks(n) if width else ():
            data = sources[index].read((at.stop - at.start) * width)
            yield at, np.frombuffer(data, np.uint8).reshape(-1, width)

    for at, values in rows(0):
        if header.version == 1:
            means[at] = values.view("<f2")
        else:
            means[at] = _from_24_bits(values).reshape(-1, 3) * np.float32(2.0**-header.fraction_bits)
        means[at] *= np.array(signs, np.float32)
    for at, values in rows(1):
        opacities[at] = values[:, 0].astype(np.float32) / 255
    for at, values in rows(2):
        sh[at, 0] = (values.astype(np.float32) / 255 - np.float32(0.5)) / np.float32(COLOR_SCALE)
    for at, values in rows(3):
        scales[at] = np.exp(values.astype(np.float32) / 16 - 10)
    for at, values in rows(4):
        quats[at] = _from_bytes(values) if header.version < 3 else _from_words(values)
        quats[at, 1:] *= np.array([y * z, x * z, x * y], np.float32)  # as `change_axes`
    turned = harmonic_signs(signs, torch.from_numpy(sh)).numpy()[1:, None]
    for at, values in rows(5):
        sh[at, 1:] = values.reshape(len(values), -1, 3)[:, :higher].astype(np.float32) / 128 - 1
        sh[at, 1:] *= turned
    return build_gaussians(path, means, quats, scales, opacities, sh)


def _from_24_bits(values: NDArray[np.uint8]) -> NDArray[np.float32]:
    wide = np.zeros((values.size // 3, 4), np.uint8)
    wide[:, 1:] = values.reshape(-1, 3)
    return (wide.view("<i4")[:, 0] >> 8).astype(np.float32)  # the shift keeps the sign


def _from_bytes(values: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Rotations (w, x, y, z) of versions 1 and 2."""
    xyz = values.astype(np.float32) / np.float32(127.5) - 1
    w = np.sqrt(np.maximum(1 - (xyz**2).sum(axis=1, keepdims=True), 0))
    return np.concatenate([w, xyz], axis=1)


def _from_words(values: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Rotations (w, x, y, z) of versions 3 and 4."""
    words = values.view("<u4")[:, 0].astype(np.uint32)
    largest = words >> np.uint32(30)
    fields = np.stack([words >> np.uint32(shift) for shift in (20, 10, 0)], axis=1) & np.uint32(1023)
    magnitudes = (fields & 511).astype(np.float32) * np.float32(np.sqrt(0.5) / 511)
    smaller = np.where(fields >> 9, -magnitudes, magnitudes)
    xyzw = np.repeat(np.sqrt(np.maximum(1 - (smaller**2).sum(axis=1, keepdims=True), 0)), 4, axis=1)
    np.put_along_axis(xyzw, OTHERS[largest], smaller, axis=1)
    return xyzw[:, [3, 0, 1, 2]]


def write_spz(
    gaussians: Gaussians, path: str | os.PathLike[str], version: int = 4, axes: str = SPZ_AXES
) -> torch.Tensor:
    """Write a scene as SPZ, quantised.

    Rows that are never rendered (NaN, infinity, a rotation of zero) are left out with a logged notice. Coordinates
    beyond +-2048 get fewer bits of fraction than 12, with another.

    Args:
        version: 2 (rotations of 8 bits), 3 (smallest three) or 4 (Zstandard); 1 is read only.
        axes: Directions of the file's axes; RUB is what the specification says.

    Returns:
        Row of `gaussians` that each row of the file was made from, int64 [M].

    Raises:
        InputError: There is no Gaussian to write, another version, or the file cannot be written.
    """
    if version not in VERSIONS[1:]:
        raise InputError(f"{path}: SPZ is written in version 2, 3 or 4, not {version}")
    kept = drawn_rows(path, gaussians)
    header, arrays = _encode(path, change_axes(gaussians.subset(kept), PLY_AXES, axes), version)
    plain = [array.tobytes() for array in arrays]
    if version < 4:
        start = HEADER.pack(MAGIC, version, header.count, header.degree, header.fraction_bits, header.flags, 0)
        deflater = zlib.compressobj(wbits=31)
        data = b"".join([deflater.compress(part) for part in (start, *plain)]) + deflater.flush()
    else:
        streams = [(compress_zstd(path, part), len(part)) for part in plain if part]
        values = (header.count, header.degree, header.fraction_bits, header.flags, len(streams), HEADER_4.size)
        table = b"".join(STREAM.pack(len(packed), size) for packed, size in streams)
        data = HEADER_4.pack(MAGIC, version, *values) + table + b"".join(packed for packed, _ in streams)
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)
    return kept


def _encode(path: str | os.PathLike[str], gaussians: Gaussians, version: int) -> tuple[Header, list[NDArray[Any]]]:
    means, quats, scales, opacities, sh = host_arrays(gaussians)
    bits = FRACTION_BITS
    farthest = float(np.abs(means).max())
    while bits < MOST_FRACTION_BITS and 2.0**-bits > LEAST_STEPS * farthest:
        bits += 1
    while bits and round(farthest * 2.0**bits) > MAX_POSITION:
        bits -= 1
    if bits < FRACTION_BITS:
        step = 2.0**-bits
        logging.getLogger("sgwarp").warning(
            "%s: coordinates reach %g, so positions are kept to %g", path, farthest, step
        )
    fixed = np.rint(means.astype(np.float64) * 2.0**bits).clip(-MAX_POSITION, MAX_POSITION).astype("<i4")
    positions = fixed.reshape(-1).view(np.uint8).reshape(-1, 4)[:, :3]
    with np.errstate(divide="ignore"):
        log_scales = np.log(scales.astype(np.float64))
    beyond = ((log_scales < LEAST_LOG) & (scales > 0)) | (log_scales > LARGEST_LOG)
    if beyond.any():
        logging.getLogger("sgwarp").warning(
            "%s: %d Gaussians have scales outside %.1e to %.0f, which SPZ cannot hold; they are clipped; give the "
            "scene another unit",
            *(path, int(beyond.any(axis=1).sum()), np.exp(LEAST_LOG), np.exp(LARGEST_LOG)),
        )
    xyzw = _unit(quats)[:, [1, 2, 3, 0]]
    arrays = [
        positions,
        _levels(opacities * 255.0),
        _levels(sh[:, 0] * (COLOR_SCALE * 255) + 127.5),
        _levels((log_scales + 10) * 16),
        _to_words(xyzw) if version >= 3 else _to_bytes(xyzw),
        _harmonic_levels(sh[:, 1:]),
    ]
    return Header(version, len(means), gaussians.sh_degree, bits, 0), arrays


def _levels(values: NDArray[Any]) -> NDArray[np.uint8]:
    return np.rint(values).clip(0, 255).astype(np.uint8)


def _unit(quats: NDArray[np.float32]) -> NDArray[np.float64]:
    """Unit quaternions (w, x, y, z); one of zero, which has no direction, becomes the identity."""
    wide = quats.astype(np.float64)
    norms = np.linalg.norm(wide, axis=1, keepdims=True)
    return np.where(norms > 0, wide / np.where(norms > 0, norms, 1), [1.0, 0.0, 0.0, 0.0])


def _to_bytes(xyzw: NDArray[np.float64]) -> NDArray[np.uint8]:
    return _levels(np.where(xyzw[:, 3:] < 0, -xyzw, xyzw)[:, :3] * 127.5 + 127.5)


def _to_words(xyzw: NDArray[np.float64]) -> NDArray[Any]:
    largest = np.abs(xyzw).argmax(axis=1)
    signed = np.where(np.take_along_axis(xyzw, largest[:, None], axis=1) < 0, -xyzw, xyzw)
    smaller = np.take_along_axis(signed, OTHERS[largest], axis=1)
    magnitudes = np.rint(np.abs(smaller) * (511 * np.sqrt(2.0))).clip(0, 511).astype(np.uint32)
    fields = magnitudes | (smaller < 0).astype(np.uint32) << np.uint32(9)
    words = largest.astype(np.uint32) << np.uint32(30)
    for field, shift in zip(fields.T, (20, 10, 0), strict=True):
        words |= field << np.uint32(shift)
    return words.astype("<u4")


def _harmonic_levels(rest: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Bytes of the higher coefficients, on the steps that Niantic's writer keeps, [N, K - 1, 3]."""
    degrees = np.repeat([0, 1, 2], [3, 5, 7])[: rest.shape[1]]
    step = np.array([1 << (8 - bits) for bits in SH_BITS])[degrees][:, None]
    return _levels(np.rint((rest * 128.0 + 128.0) / step) * step)
