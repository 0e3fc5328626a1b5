"""The orientation that a camera notes in a photograph's EXIF data (Exif 2.32, tag 274)."""

from __future__ import annotations

import os
import re
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sgwarp.files.access import reading

HEAD_BYTES = 1 << 18
ORIENTATION = 0x0112
UPRIGHT = 1
NAMES = {
    2: "mirrored",
    3: "upside down",
    4: "mirrored and upside down",
    5: "mirrored and sideways",
    6: "sideways",
    7: "mirrored and sideways",
    8: "sideways",
}


def read_orientation(path: str | os.PathLike[str]) -> int:
    """How the stored raster lies: 1 upright, 2 to 4 mirrored or upside down, 5 to 8 sideways; 1 if nothing is noted.

    JPEG, PNG, WebP and TIFF; only the first 256 KB are read.

    Raises:
        InputError: The file is missing or not readable.
    """
    with reading(path), open(path, "rb") as file:
        head = file.read(HEAD_BYTES)
    return _of_tiff(_exif(head))


def is_panorama(path: str | os.PathLike[str]) -> bool:
    """Whether a photograph is noted to show all around, equirectangular (GPano's ProjectionType in its XMP data).

    Raises:
        InputError: The file is missing or not readable.
    """
    with reading(path), open(path, "rb") as file:
        head = file.read(HEAD_BYTES)
    return re.search(rb"ProjectionType\W{1,4}equirectangular", head) is not None


def turn(pixels: NDArray[Any], orientation: int) -> NDArray[Any]:
    """The raster as it is to be looked at, [H, W] or [H, W, C]; width and height change places from 5 on."""
    if orientation >= 5:
        pixels = np.swapaxes(pixels, 0, 1)
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    return np.ascontiguousarray(pixels)


def _exif(head: bytes) -> bytes:
    """The TIFF structure that holds the EXIF data, empty if there is none."""
    if head[:4] in (b"II*\0", b"MM\0*"):
        return head
    if head[:3] == b"\xff\xd8\xff":
        position = 2
        while position + 4 <= len(head) and head[position] == 0xFF and head[position + 1] != 0xDA:
            size = int.from_bytes(head[position + 2 : position + 4], "big")
            content = head[position + 4 : position + 2 + size]
            if head[position + 1] == 0xE1 and content[:6] == b"Exif\0\0":
                return content[6:]
            position += 2 + size
    if head[:8] == b"\x89PNG\r\n\x1a\n":
        return _chunk(head, 8, b"eXIf", "big")
    if head[:4] == b"RIFF" and head[8:12] == b"WEBP":
        content = _chunk(head, 12, b"EXIF", "little")
        return content[6:] if content[:6] == b"Exif\0\0" else content
    return b""


def _chunk(head: bytes, position: int, wanted: bytes, order: Any) -> bytes:
    """Content of the first chunk of a name: PNG has its size before and a checksum behind, RIFF its size after."""
    while position + 8 <= len(head):
        first, second = head[position : position + 4], head[position + 4 : position + 8]
        name, size = (second, first) if order == "big" else (first, second)
        count = int.from_bytes(size, order)
        if name == wanted:
            return head[position + 8 : position + 8 + count]
        position += 12 + count if order == "big" else 8 + count + count % 2
    return b""


def _of_tiff(data: bytes) -> int:
    """The orientation in the first directory of a TIFF structure."""
    noted = _noted(data)
    return UPRIGHT if noted is None else noted[0]


def without_orientation(data: bytes) -> bytes:
    """A TIFF file that notes none, so that decoders, some of which turn pixels and some of which do so by half, don't.

    Args:
        data: The whole file.
    """
    noted = _noted(data)
    if noted is None or noted[0] == UPRIGHT:
        return data
    _, place, order = noted
    return data[:place] + struct.pack(order + "H", UPRIGHT) + data[place + 2 :]


def _noted(data: bytes) -> tuple[int, int, str] | None:
    """Orientation in the first directory of a TIFF structure, its place, and the order of bytes; None if none is."""
    if data[:2] not in (b"II", b"MM") or len(data) < 10:
        return None
    order = "<" if data[:2] == b"II" else ">"
    (start,) = struct.unpack_from(order + "I", data, 4)
    if start + 2 > len(data):
        return None
    (entries,) = struct.unpack_from(order + "H", data, start)
    for entry in range(start + 2, min(start + 2 + 12 * entries, len(data) - 11), 12):
        tag, kind, _, value = struct.unpack_from(order + "HHIH", data, entry)
        if tag == ORIENTATION and kind == 3:
            return (value, entry + 8, order) if 1 <= value <= 8 else None
    return None
