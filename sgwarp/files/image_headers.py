"""What an image file says about itself, read before a decoder takes memory for it.

PNG, JPEG, WebP, TIFF and BMP are known; other formats are refused, because their size cannot be seen beforehand. An
image may have `largest_image()` pixels, and no more than its bytes can hold: a deflated byte gives at most 1032, a JPEG
needs at least one bit for a block of 8 x 8. WebP needs none for pixels of one color: there only the limit holds.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator

from sgwarp.errors import InputError

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
JPEG_SIGNATURE = b"\xff\xd8\xff"
TIFF_SIGNATURES = {b"II*\0": "<", b"MM\0*": ">"}
# Place, bytes and name of formats that people have and that are not decoded.
NOT_DECODED = (
    *((4, sign, "HEIC") for sign in (b"ftypheic", b"ftypheix", b"ftyphevc", b"ftypmif1", b"ftypmsf1")),
    (4, b"ftypavif", "AVIF"),
    *((0, sign, "JPEG XL") for sign in (b"\xff\x0a", b"\0\0\0\x0cJXL ")),
    (0, b"GIF8", "GIF"),
    (0, b"\x76\x2f\x31\x01", "OpenEXR"),
    (0, b"#?RADIANCE", "HDR"),
)
START_OF_SCAN = 0xDA
START_OF_FRAME = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # baseline, progressive, ...
PNG_PIXELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # color type -> samples per pixel
PNG_PARTS = (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND")  # what the pixels depend on
LARGEST_RATIO = 1032  # of deflate
JPEG_PIXELS_PER_BYTE = 512
LARGEST_IMAGE = 2**27  # pixels, 8 bits of RGB in 400 MB
VARIABLE = "SGWARP_LARGEST_IMAGE"
TIFF_COLORS, LAB = 262, (8, 9, 10)  # CIELAB, ICC LAB and ITU LAB: libtiff takes their white for that of sRGB
TIFF_WIDTH, TIFF_HEIGHT, TIFF_BITS, TIFF_SAMPLES, TIFF_TILE_WIDTH, TIFF_TILE_HEIGHT = 256, 257, 258, 277, 322, 323


def largest_image() -> int:
    """Pixels that an image may have: the environment variable SGWARP_LARGEST_IMAGE, by default 2^27.

    Raises:
        InputError: The variable is no positive whole number.
    """
    text = os.environ.get(VARIABLE, str(LARGEST_IMAGE))
    if not text.isdecimal() or not int(text):
        raise InputError(f"{VARIABLE}={text}: expected a number of pixels")
    return int(text)


def check_image(path: str | os.PathLike[str], data: bytes) -> tuple[int, int]:
    """(height, width) of an image file [pixels], after checking that a decoder may have it.

    Raises:
        InputError: The format is not known, the file is cut short or damaged, or the image is too large.
    """
    if not data:
        raise InputError(f"{path}: image is cut short (0 bytes); copy or download it again")
    size = image_size(data)
    if size is None:
        kind = next((kind for place, sign, kind in NOT_DECODED if data[place : place + len(sign)] == sign), None)
        what = "is not an image of a known format, or is damaged"
        if kind:
            what = f"is {'an' if kind[0] in 'AO' else 'a'} {kind} image, which is not decoded"
        raise InputError(f"{path}: {what}; save it again as PNG or JPEG")
    order = TIFF_SIGNATURES.get(data[:4])
    if order and _tiff_tags(data, order).get(TIFF_COLORS) in LAB:
        raise InputError(f"{path}: holds Lab colors, which decoders read differently; save it again as RGB")
    height, width = size
    limit = largest_image()
    if height * width > limit:
        raise InputError(
            f"{path}: image is {width} x {height}, more than {limit} pixels; make it smaller, or set "
            f"{VARIABLE}={height * width}"
        )
    if data.startswith(PNG_SIGNATURE):
        _check_png(path, data, height, width)
    elif data.startswith(JPEG_SIGNATURE):
        if height * width > JPEG_PIXELS_PER_BYTE * len(data):
            raise _too_short(path, data, height, width)
    elif not data.startswith(b"RIFF") and height * width > 8 * LARGEST_RATIO * len(data):
        raise _too_short(path, data, height, width)
    return size


def image_size(data: bytes) -> tuple[int, int] | None:
    """(height, width) that the first bytes of a file state, None if they are those of no known format."""
    if data.startswith(PNG_SIGNATURE) and len(data) >= 29 and data[12:16] == b"IHDR":
        width, height = struct.unpack_from(">II", data, 16)
    elif data.startswith(JPEG_SIGNATURE):
        found = next((at for marker, at in jpeg_segments(data) if marker in START_OF_FRAME), None)
        if found is None or found + 5 > len(data):
            return None
        height, width = struct.unpack_from(">HH", data, found + 1)
    elif data.startswith(b"RIFF") and data[8:12] == b"WEBP" and len(data) >= 30:
        return _webp_size(data)
    elif data[:4] in TIFF_SIGNATURES:
        return _tiff_size(data, TIFF_SIGNATURES[data[:4]])
    elif data.startswith(b"BM") and len(data) >= 26:
        width, height = struct.unpack_from("<ii", data, 18) if data[14] != 12 else struct.unpack_from("<HH", data, 18)
        width, height = abs(width), abs(height)
    else:
        return None
    return (height, width) if height and width else None


def jpeg_segments(data: bytes) -> Iterator[tuple[int, int]]:
    """Marker and position of the content of each segment up to the image data (ITU T.81, annex B)."""
    position = 2
    while position + 4 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xFF:  # padding
            position += 1
            continue
        yield marker, position + 4
        if marker == START_OF_SCAN:
            return
        position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")


def png_chunks(data: bytes) -> Iterator[tuple[bytes, int, int]]:
    """Kind, position and length of the content of each chunk; the last one may reach beyond the end."""
    position = len(PNG_SIGNATURE)
    while position + 8 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, position)
        yield kind, position + 8, length
        if kind == b"IEND":
            return
        position += 12 + length


def plain_png(data: bytes) -> bytes:
    """The same PNG with nothing in it but what its pixels depend on: no text, profile, animation or trailing bytes."""
    parts = [PNG_SIGNATURE]
    parts += [data[at - 8 : at + length + 4] for kind, at, length in png_chunks(data) if kind in PNG_PARTS]
    return b"".join(parts)


def _check_png(path: str | os.PathLike[str], data: bytes, height: int, width: int) -> None:
    packed = 0
    ended = False
    for number, (kind, at, length) in enumerate(png_chunks(data)):
        if at + length + 4 > len(data):
            raise InputError(f"{path}: image is cut short ({len(data)} bytes); copy or download it again")
        if (number == 0) != (kind == b"IHDR"):
            raise InputError(f"{path}: is damaged (its chunks are out of order); save it again as PNG or JPEG")
        packed += length if kind == b"IDAT" else 0
        ended = kind == b"IEND"
    if not ended:
        raise InputError(f"{path}: image is cut short ({len(data)} bytes); copy or download it again")
    bits = data[24] * PNG_PIXELS.get(data[25], 4)
    if height * (width * bits // 8) > LARGEST_RATIO * packed + LARGEST_RATIO:
        raise _too_short(path, data, height, width)


def _too_short(path: str | os.PathLike[str], data: bytes, height: int, width: int) -> InputError:
    return InputError(
        f"{path}: image is cut short or damaged: {len(data)} bytes cannot hold {width} x {height} pixels; copy it again"
    )


def _webp_size(data: bytes) -> tuple[int, int] | None:
    kind = data[12:16]
    if kind == b"VP8X":
        width, height = (int.from_bytes(data[at : at + 3], "little") + 1 for at in (24, 27))
    elif kind == b"VP8L" and data[20] == 0x2F:
        bits = int.from_bytes(data[21:25], "little")
        width, height = (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    elif kind == b"VP8 " and data[23:26] == b"\x9d\x01\x2a":
        width, height = (word & 0x3FFF for word in struct.unpack_from("<HH", data, 26))
    else:
        return None
    return (height, width) if height and width else None


def _tiff_size(data: bytes, order: str) -> tuple[int, int] | None:
    """Of the first picture; a tile that is larger than the picture counts, for the decoder takes memory for it."""
    tags = _tiff_tags(data, order)
    height = max(tags.get(TIFF_HEIGHT, 0), tags.get(TIFF_TILE_HEIGHT, 0))
    width = max(tags.get(TIFF_WIDTH, 0), tags.get(TIFF_TILE_WIDTH, 0))
    if tags.get(TIFF_SAMPLES, 1) > 4:  # of an image with one to four channels no reader here wants more
        return None
    return (height, width) if height and width else None


def _tiff_tags(data: bytes, order: str) -> dict[int, int]:
    """Whole numbers of the first directory, by their tags; empty if it is cut short."""
    tags: dict[int, int] = {}
    try:
        (start,) = struct.unpack_from(f"{order}I", data, 4)
        (count,) = struct.unpack_from(f"{order}H", data, start)
        for number in range(count):
            tag, kind, _ = struct.unpack_from(f"{order}HHI", data, start + 2 + 12 * number)
            layout = {1: "B", 3: "H", 4: "I"}.get(kind)
            if layout:
                (tags[tag],) = struct.unpack_from(order + layout, data, start + 10 + 12 * number)
    except struct.error:
        return {}
    return tags
