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
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sgwarp.errors import InputError
from sgwarp.files.access import read_bytes
from sgwarp.files.atomic import atomic_path
from sgwarp.io.formats.axes import PLY_AXES, SPZ_AXES, change_axes
from sgwarp.io.formats.packed import most_gaussians
from sgwarp.io.formats.zstd import compress_zstd, decompress_zstd
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
    def sizes(self) -> tuple[int, ...]:
        """Bytes of positions, opacities, colors, scales, rotations, harmonics."""
        position = 6 if self.version == 1 else 9
        rotation = 3 if self.version < 3 else 4
        return tuple(self.count * width for width in (position, 1, 3, 3, rotation, 3 * SH_DEGREES[self.degree]))


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
        header, arrays = _read_gzip(path, data)
    elif data[:4] == MAGIC.to_bytes(4, "little"):
        header, arrays = _read_streams(path, data)
    else:
        raise InputError(f"{path}: is not an SPZ scene (neither gzip nor 'NGSP' at its start)")
    if header.flags & ANTIALIASED:
        logging.getLogger("sgwarp").warning("%s: was trained with antialiasing, which is not taken over", path)
    return change_axes(_decode(path, header, arrays), axes or header.axes, PLY_AXES)


def _read_gzip(path: str | os.PathLike[str], data: bytes) -> tuple[Header, list[bytes]]:
    inflater = zlib.decompressobj(wbits=31)
    try:
        start = inflater.decompress(data, HEADER.size)
        if len(start) < HEADER.size:
            raise InputError(f"{path}: is cut short: holds no SPZ header; copy or download it again")
        magic, version, count, degree, bits, flags, _ = HEADER.unpack(start)
        if start[:3] == b"ply":
            raise InputError(f"{path}: is a PLY file packed with gzip, which is not read; unpack it (gunzip)")
        if magic != MAGIC or version not in VERSIONS[:3]:
            raise InputError(f"{path}: is not an SPZ scene of version 1 to 3 (version {version})")
        header = _checked(path, Header(version, count, degree, bits, flags))
        _require_room(path, header, len(data))
        total = sum(header.sizes)
        body = inflater.decompress(inflater.unconsumed_tail, total)
        inflater.decompress(inflater.unconsumed_tail, 1)  # reaches the checksum
    except zlib.error as error:
        raise InputError(f"{path}: its gzip stream is damaged ({error}); copy or download it again") from None
    if len(body) < total:
        raise InputError(f"{path}: is cut short: holds {len(body)} of {total} bytes; copy or download it again")
    return header, _split(body, header.sizes)


def _read_streams(path: str | os.PathLike[str], data: bytes) -> tuple[Header, list[bytes]]:
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
    arrays = []
    for index, size in enumerate(sizes):
        packed, unpacked = STREAM.unpack_from(data, table + index * STREAM.size)
        if unpacked != size or packed > len(data) - position:
            raise InputError(f"{path}: stream {index} does not have the size of {count} Gaussians; it is damaged")
        arrays.append(decompress_zstd(path, memoryview(data)[position : position + packed], size))
        position += packed
    return header, arrays + [b""] * (len(header.sizes) - len(arrays))


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


def _split(data: bytes, sizes: tuple[int, ...]) -> list[bytes]:
    view, arrays, position = memoryview(data), [], 0
    for size in sizes:
        arrays.append(view[position : position + size])
        position += size
    return arrays  # type: ignore[return-value]


def _decode(path: str | os.PathLike[str], header: Header, arrays: list[bytes]) -> Gaussians:
    n = header.count
    positions, opacities, colors, scales, rotations, harmonics = (np.frombuffer(a, np.uint8) for a in arrays)
    if header.version == 1:
        means = positions.view("<f2").astype(np.float32).reshape(n, 3)
    else:
        means = _from_24_bits(positions).reshape(n, 3) * np.float32(2.0**-header.fraction_bits)
    unpack = _from_bytes if header.version < 3 else _from_words
    dc = (colors.reshape(n, 1, 3).astype(np.float32) / 255 - np.float32(0.5)) / np.float32(COLOR_SCALE)
    rest = harmonics.reshape(n, -1, 3)[:, : SH_COUNTS[-1] - 1]
    if header.degree > 3:
        logging.getLogger("sgwarp").warning("%s: harmonics of degree 4 are left out, up to 3 are kept", path)
    sh = np.concatenate([dc, rest.astype(np.float32) / 128 - 1], axis=1)
    return build_gaussians(
        path,
        means,
        unpack(rotations),
        np.exp(scales.reshape(n, 3).astype(np.float32) / 16 - 10),
        opacities.astype(np.float32) / 255,
        sh,
    )


def _from_24_bits(values: NDArray[np.uint8]) -> NDArray[np.float32]:
    wide = np.zeros((len(values) // 3, 4), np.uint8)
    wide[:, 1:] = values.reshape(-1, 3)
    return (wide.view("<i4")[:, 0] >> 8).astype(np.float32)  # the shift keeps the sign


def _from_bytes(values: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Rotations (w, x, y, z) of versions 1 and 2."""
    xyz = values.reshape(-1, 3).astype(np.float32) / np.float32(127.5) - 1
    w = np.sqrt(np.maximum(1 - (xyz**2).sum(axis=1, keepdims=True), 0))
    return np.concatenate([w, xyz], axis=1)


def _from_words(values: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Rotations (w, x, y, z) of versions 3 and 4."""
    words = values.view("<u4").astype(np.uint32)
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
