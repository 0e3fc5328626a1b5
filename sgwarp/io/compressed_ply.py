"""PlayCanvas compressed PLY: 16 bytes per Gaussian, quantised within chunks of 256.

Element `chunk` holds the bounds of positions, log scales and (from SuperSplat 2 on) colours as float32, element
`vertex` four uint32 per Gaussian, the optional element `sh` one byte per higher SH coefficient. Bits, highest first:

    packed_position, packed_scale   x 11, y 10, z 11       fraction of the chunk's bounds
    packed_rotation                 index 2, 3 x 10        the other three of (w, x, y, z), in order, in +-1/sqrt(2)
    packed_color                    r 8, g 8, b 8, a 8     colour at SH degree 0 (fraction of bounds), opacity
    f_rest_*                        8                      [-4, 4), channel-major; 0 and 255 are the ends

Source: playcanvas/engine (gsplat-compressed-data.js) and playcanvas/splat-transform (compressed-chunk.ts,
decompress-ply.ts), read for the layout only.
"""

from __future__ import annotations

import os
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sgwarp.errors import InputError
from sgwarp.io.formats.packed import blocks
from sgwarp.io.ply import (
    REST_COUNTS,
    Elements,
    build_gaussians,
    columns,
    drawn_rows,
    host_arrays,
    read_elements,
    write_elements,
)
from sgwarp.scene import Gaussians
from sgwarp.version import __version__

CHUNK = 256
SH_C0 = 0.28209479177387814  # constant of degree 0: colour = SH_C0 f_dc + 0.5
LOG_SCALE_LIMIT = 20.0  # the format's writers clamp here; exp(-20) is 2e-9
BITS_XYZ = (11, 10, 11)
BITS_RGBA = (8, 8, 8, 8)
BOUNDS = tuple(f"{end}_{axis}" for end in ("min", "max") for axis in "xyz")
SCALE_BOUNDS = tuple(f"{end}_scale_{axis}" for end in ("min", "max") for axis in "xyz")
COLOUR_BOUNDS = tuple(f"{end}_{channel}" for end in ("min", "max") for channel in "rgb")
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
# Row k: the places of w, x, y, z that are stored when component k is the largest.
OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])


def is_compressed(elements: Elements) -> bool:
    """Whether the header announces a compressed scene."""
    return "chunk" in elements and "vertex" in elements and "packed_position" in (elements["vertex"].dtype.names or ())


def gaussians_from_packed(path: str | os.PathLike[str], elements: Elements) -> Gaussians:
    """Decode the elements of a compressed scene; see `read_compressed_ply`."""
    vertex, chunk = elements["vertex"], elements["chunk"]
    missing = [n for n in PACKED if n not in (vertex.dtype.names or ())]
    missing += [n for n in (*BOUNDS, *SCALE_BOUNDS) if n not in (chunk.dtype.names or ())]
    if missing:
        raise InputError(f"{path}: lacks the columns {', '.join(missing)} of a compressed scene")
    wrong = [n for n in PACKED if vertex.dtype[n].kind not in "iu" or vertex.dtype[n].itemsize != 4]
    if wrong:
        raise InputError(f"{path}: column {wrong[0]} must be uint (32 bits), is {vertex.dtype[wrong[0]]}")
    count = len(vertex)
    if count == 0:
        raise InputError(f"{path}: has no Gaussians (element 'vertex' has 0 rows)")
    chunks = -(-count // CHUNK)
    if len(chunk) != chunks:
        raise InputError(f"{path}: {count} Gaussians need {chunks} chunks, element 'chunk' has {len(chunk)}")
    rest = _rest_names(path, elements.get("sh"), count)
    bounded = set(COLOUR_BOUNDS) <= set(chunk.dtype.names or ())
    means, scales = np.empty((2, count, 3), np.float32)
    quats, opacities = np.empty((count, 4), np.float32), np.empty(count, np.float32)
    sh = np.empty((count, 1 + len(rest) // 3, 3), np.float32)
    for at in blocks(count):  # whole chunks
        own = chunk[at.start // CHUNK : -(-at.stop // CHUNK)]
        position, rotation, scale, colour = (_words(vertex[name][at]) for name in PACKED)
        rgba = _unpack(colour, BITS_RGBA)
        rgb = _within(columns(path, own, COLOUR_BOUNDS), rgba[:, :3]) if bounded else rgba[:, :3]
        log_scales = _within(columns(path, own, SCALE_BOUNDS), _unpack(scale, BITS_XYZ))
        with np.errstate(over="ignore", invalid="ignore"):
            means[at] = _within(columns(path, own, BOUNDS), _unpack(position, BITS_XYZ))
            scales[at] = np.exp(log_scales)
            sh[at, 0] = (rgb - 0.5) / SH_C0
        quats[at], opacities[at] = _unpack_rotation(rotation), rgba[:, 3]
        if rest:
            sh[at, 1:] = _unpack_sh(columns(path, elements["sh"][at], rest))
    return build_gaussians(path, means, quats, scales, opacities, sh)


def read_compressed_ply(path: str | os.PathLike[str]) -> Gaussians:
    """Read a PlayCanvas compressed scene (SH degree 0 to 3).

    Raises:
        InputError: The file is missing, cut short, no compressed scene, or empty.
    """
    elements = read_elements(path)
    if not is_compressed(elements):
        raise InputError(f"{path}: is not a compressed PLY (no element 'chunk' with packed columns)")
    return gaussians_from_packed(path, elements)


def write_compressed_ply(gaussians: Gaussians, path: str | os.PathLike[str]) -> torch.Tensor:
    """Write a scene in PlayCanvas' compressed format, quantised.

    **The order changes**: Gaussians are sorted along a Morton curve, which keeps the bounds of a chunk small and so
    the precision high. Rows that are never rendered (NaN, infinity, a rotation of zero) are left out with a
    logged notice, log scales are clamped to +-20, higher SH coefficients to [-4, 4]; without any, no element `sh` is
    written. Semantics lifted on `gaussians` belong to its order and do not fit the file.

    Returns:
        Row of `gaussians` that each row of the file was made from, int64 [M].

    Raises:
        InputError: There is no Gaussian to write, or the file cannot be written.
    """
    means, quats, scales, opacities, sh = host_arrays(gaussians)
    norms = np.linalg.norm(quats.astype(np.float64), axis=1)
    kept = drawn_rows(path, gaussians).numpy()
    order = kept[np.argsort(morton_codes(means[kept]), kind="stable")]
    with np.errstate(divide="ignore"):
        log_scales = np.log(scales[order]).clip(-LOG_SCALE_LIMIT, LOG_SCALE_LIMIT)
    rgb = sh[order, 0] * np.float32(SH_C0) + np.float32(0.5)
    bounds, fractions = zip(*(_bounds_and_fractions(v) for v in (means[order], log_scales, rgb)), strict=True)
    rgba = np.concatenate([fractions[2], opacities[order, None]], axis=1)
    packed = (
        _pack(fractions[0], BITS_XYZ),
        _pack_rotation(quats[order] / norms[order, None]),
        _pack(fractions[1], BITS_XYZ),
        _pack(rgba, BITS_RGBA),
    )
    elements = {
        "chunk": _table(np.concatenate(bounds, axis=1), (*BOUNDS, *SCALE_BOUNDS, *COLOUR_BOUNDS), "<f4"),
        "vertex": _table(np.stack(packed, axis=1), PACKED, "<u4"),
    }
    rest = sh[order, 1:].transpose(0, 2, 1).reshape(len(order), -1)
    if rest.any():
        levels = np.floor((rest.astype(np.float64) / 8 + 0.5) * 256).clip(0, 255)
        elements["sh"] = _table(levels, tuple(f"f_rest_{i}" for i in range(rest.shape[1])), "u1")
    write_elements(path, elements, comment=f"Generated by sgwarp {__version__}")
    return torch.from_numpy(order)


def morton_codes(points: NDArray[np.float32]) -> NDArray[np.uint64]:
    """Position along a Z-order curve through the bounding box, 21 bits per axis, uint64 [N]."""
    low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
    cells = (points - low) / np.where(high > low, high - low, 1.0) * (2**21 - 1)
    codes = np.zeros(len(points), dtype=np.uint64)
    for axis in range(3):
        bits = cells[:, axis].astype(np.uint64)
        # Move the bits apart, so that two zeros follow each: halves, quarters, ... of the word in turn.
        for shift, mask in (
            (32, 0x1F00000000FFFF),
            (16, 0x1F0000FF0000FF),
            (8, 0x100F00F00F00F00F),
            (4, 0x10C30C30C30C30C3),
            (2, 0x1249249249249249),
        ):
            bits = (bits | (bits << np.uint64(shift))) & np.uint64(mask)
        codes |= bits << np.uint64(2 - axis)
    return codes


def _words(column: NDArray[Any]) -> NDArray[np.uint32]:
    return column.astype(column.dtype.newbyteorder("=")).view(np.uint32)


def _unpack(words: NDArray[np.uint32], bits: tuple[int, ...]) -> NDArray[np.float64]:
    """Split words into fields (highest first), as fractions of their largest value, float64 [N, len(bits)]."""
    shifts = np.cumsum(bits[::-1])[::-1] - np.array(bits)
    top = (1 << np.array(bits)) - 1
    fields = [(words >> np.uint32(s)) & np.uint32(t) for s, t in zip(shifts, top, strict=True)]
    return np.stack(fields, axis=1) / top


def _pack(fractions: NDArray[Any], bits: tuple[int, ...]) -> NDArray[np.uint32]:
    words = np.zeros(len(fractions), dtype=np.uint32)
    for j, width in enumerate(bits):
        top = (1 << width) - 1
        level = np.floor(fractions[:, j] * float(top) + 0.5).clip(0, top)
        words = (words << np.uint32(width)) | level.astype(np.uint32)
    return words


def _unpack_rotation(words: NDArray[np.uint32]) -> NDArray[np.float32]:
    """Unit quaternions w, x, y, z from the three smaller components; the largest is positive."""
    others = OTHERS[words >> np.uint32(30)]
    smaller = (_unpack(words & np.uint32(0x3FFFFFFF), (10, 10, 10)) - 0.5) * np.sqrt(2.0)
    largest = np.sqrt(np.maximum(1.0 - (smaller**2).sum(axis=1), 0.0))
    quats = np.repeat(largest[:, None], 4, axis=1)
    np.put_along_axis(quats, others, smaller, axis=1)
    return quats.astype(np.float32)


def _pack_rotation(quats: NDArray[np.float64]) -> NDArray[np.uint32]:
    largest = np.abs(quats).argmax(axis=1)
    signed = quats * np.where(np.take_along_axis(quats, largest[:, None], axis=1) < 0, -1.0, 1.0)
    smaller = np.take_along_axis(signed, OTHERS[largest], axis=1)
    return (largest.astype(np.uint32) << np.uint32(30)) | _pack(smaller / np.sqrt(2.0) + 0.5, (10, 10, 10))


def _rest_names(path: str | os.PathLike[str], sh: NDArray[Any] | None, count: int) -> tuple[str, ...]:
    """Columns of the higher coefficients; none without the element `sh`."""
    if sh is None:
        return ()
    rest = len(sh.dtype.names or ())
    names = tuple(f"f_rest_{i}" for i in range(rest))
    if rest not in REST_COUNTS or set(names) != set(sh.dtype.names or ()) or len(sh) != count:
        raise InputError(
            f"{path}: element 'sh' has {rest} columns and {len(sh)} rows, expected f_rest_0 up to f_rest_8, 23 or 44 "
            f"and {count} rows"
        )
    wrong = [n for n in names if sh.dtype[n] != np.uint8]
    if wrong:
        raise InputError(f"{path}: column {wrong[0]} of element 'sh' must be uchar, is {sh.dtype[wrong[0]]}")
    return names


def _unpack_sh(levels: NDArray[np.float32]) -> NDArray[np.float32]:
    """Higher coefficients, float32 [N, K - 1, 3]; a byte stands for the middle of its interval, the ends for -4, 4."""
    values = (levels + np.float32(0.5)) / 32 - 4
    values[values == np.float32(0.5 / 32 - 4)] = -4
    values[values == np.float32(255.5 / 32 - 4)] = 4
    return values.reshape(len(values), 3, -1).transpose(0, 2, 1)


def _within(bounds: NDArray[np.float32], fractions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values from fractions of their chunk's bounds; `bounds` is [chunks, minima and maxima]."""
    with np.errstate(invalid="ignore"):  # infinite bounds times 0
        wide = np.repeat(bounds.astype(np.float64), CHUNK, axis=0)[: len(fractions)]
        low, high = np.split(wide, 2, axis=1)
        return low * (1 - fractions) + high * fractions


def _bounds_and_fractions(values: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Bounds per chunk, [chunks, minima and maxima], and the place of each value between them."""
    starts = np.arange(0, len(values), CHUNK)
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    wide = np.repeat(np.stack([low, high]).astype(np.float64), CHUNK, axis=1)[:, : len(values)]
    base, span = wide[0], wide[1] - wide[0]
    fractions = np.divide(values - base, span, out=np.zeros_like(base), where=span > 0)
    return np.concatenate([low, high], axis=1), fractions


def _table(values: NDArray[Any], names: tuple[str, ...], kind: str) -> NDArray[Any]:
    rows = np.ascontiguousarray(values.astype(kind))
    return rows.view([(name, kind) for name in names]).reshape(-1)
