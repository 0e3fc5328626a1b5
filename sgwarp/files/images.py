"""Photographs and label images, in and out (OpenCV codecs, no colour management: sRGB values stay as they are)."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sgwarp.errors import InputError
from sgwarp.files.access import open_input, read_bytes
from sgwarp.files.atomic import atomic_path
from sgwarp.files.exif import without_orientation
from sgwarp.files.image_headers import (
    JPEG_SIGNATURE,
    PNG_SIGNATURE,
    START_OF_SCAN,
    TIFF_SIGNATURES,
    check_image,
    image_size,
    jpeg_segments,
    plain_png,
    png_chunks,
)

HEADER_BYTES = 1 << 18
WITH_ALPHA = (b"\x89PNG", b"RIFF", *TIFF_SIGNATURES)  # first bytes, whatever the name ends in
RGB_SUFFIXES = (".png", ".jpg", ".jpeg")


def read_rgb(path: str | os.PathLike[str]) -> NDArray[np.uint8]:
    """Read a photograph, uint8 [H, W, 3], channels R, G, B.

    Pixels come as they are stored: an orientation noted in the EXIF data is not applied, because camera parameters
    refer to the stored raster. An alpha channel is dropped, 16 bits become 8, grey becomes three equal channels.

    Raises:
        InputError: The file is missing, cut short, or not an image.
    """
    import cv2

    data = read_bytes(path)
    pixels = _decode(path, data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if data[:4] in TIFF_SIGNATURES and (alpha := _alpha(path, data)) is not None:
        # The decoder multiplies colors by alpha, as it does of no other format.
        pixels = (pixels * (255 / np.maximum(alpha, 1.0))[:, :, None] + 0.5).clip(0, 255).astype(np.uint8)
    return np.ascontiguousarray(pixels[:, :, ::-1])


def read_alpha(path: str | os.PathLike[str]) -> NDArray[np.uint8] | None:
    """Alpha channel of an image, uint8 [H, W]; None if it has none or is opaque everywhere.

    Raises:
        InputError: The file is missing, cut short, or not an image.
    """
    with open_input(path) as file:
        if not file.read(4).startswith(WITH_ALPHA):
            return None
    return _alpha(path, read_bytes(path))


def _alpha(path: str | os.PathLike[str], data: bytes) -> NDArray[np.uint8] | None:
    import cv2

    pixels = _decode(path, data, cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    if pixels.ndim != 3 or pixels.shape[2] != 4:
        return None
    alpha = pixels[:, :, 3] if pixels.dtype == np.uint8 else (pixels[:, :, 3] >> 8).astype(np.uint8)
    return None if bool((alpha == 255).all()) else np.ascontiguousarray(alpha)


def read_size(path: str | os.PathLike[str]) -> tuple[int, int]:
    """(height, width) of an image [pixels]; of PNG and JPEG only the header is read.

    Raises:
        InputError: The file is missing or not an image.
    """
    with open_input(path) as file:
        head = file.read(HEADER_BYTES)
    size = image_size(head) if head.startswith((PNG_SIGNATURE, JPEG_SIGNATURE)) else None
    if size is not None:
        return size
    height, width = read_rgb(path).shape[:2]
    return height, width


def read_ids(path: str | os.PathLike[str]) -> NDArray[np.int32]:
    """Read a label or instance-id image, int32 [H, W].

    8- and 16-bit grey images hold the id itself. Of a palette image (DAVIS, DEVA short ids) the palette index is the
    id, and a grey image of 1, 2 or 4 bits holds small ids; neither is scaled. 8-bit colour images hold the long ids
    of DEVA (panopticapi), R + 256 G + 65536 B, unless all pixels are grey.

    Raises:
        InputError: The file is missing, cut short, lossy (JPEG) or holds no integer ids.
    """
    import cv2

    data = read_bytes(path)
    if data.startswith(JPEG_SIGNATURE):
        raise InputError(f"{path}: JPEG compression alters ids; store label images as PNG")
    bits = 8
    if data.startswith(PNG_SIGNATURE) and len(data) > 33:
        bits, colour_type = data[24], data[25]
        if colour_type == 3:
            data = _palette_as_grey(data)
        elif colour_type != 0:
            bits = 8
    pixels = _decode(path, data, cv2.IMREAD_UNCHANGED)
    if pixels.ndim == 3 and pixels.shape[2] == 4:
        if bool((pixels[:, :, 3] != np.iinfo(pixels.dtype).max).any()):
            raise InputError(f"{path}: has transparent pixels, which carry no id; store label images without alpha")
        pixels = pixels[:, :, :3]
    if pixels.ndim == 3:
        grey = bool((pixels == pixels[:, :, :1]).all())
        if not grey and pixels.dtype != np.uint8:
            raise InputError(f"{path}: is a {pixels.dtype} colour image; ids are 8/16-bit grey or 8-bit R, G, B")
        blue, green, red = (pixels[:, :, c].astype(np.int32) for c in range(3))
        return red if grey else red + 256 * green + 65536 * blue
    # The decoder spreads 1, 2 and 4 bits over 0..255.
    return pixels.astype(np.int32) // (255 // ((1 << bits) - 1) if bits < 8 else 1)


def read_values(path: str | os.PathLike[str]) -> NDArray[Any]:
    """The numbers of an image as they are stored, [H, W] or [H, W, C] of its type, such as depth in a TIFF file.

    Raises:
        InputError: The file is missing, cut short, or not an image.
    """
    import cv2

    return _decode(path, read_bytes(path), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)


def write_rgb(path: str | os.PathLike[str], image: Any) -> None:
    """Write a picture as PNG or JPEG (by the name).

    Args:
        path: Name ending in .png, .jpg or .jpeg.
        image: [H, W, 3], floating point in [0, 1] (values outside are clipped) or uint8; array or CPU tensor.

    Raises:
        InputError: Wrong name, shape or type, or NaN among the values.
    """
    pixels = np.asarray(image)
    if Path(path).suffix.lower() not in RGB_SUFFIXES:
        raise InputError(f"{path}: pictures are written as {', '.join(RGB_SUFFIXES)}; change the name")
    if pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.size == 0:
        raise InputError(f"{path}: a picture must have shape [H, W, 3], got {list(pixels.shape)}")
    if np.issubdtype(pixels.dtype, np.floating):
        if bool(np.isnan(pixels).any()):
            raise InputError(f"{path}: the picture holds NaN, first at {np.argwhere(np.isnan(pixels))[0].tolist()}")
        pixels = (np.clip(pixels, 0, 1) * 255 + 0.5).astype(np.uint8)
    if pixels.dtype != np.uint8:
        raise InputError(f"{path}: a picture must be floating point in [0, 1] or uint8, got {pixels.dtype}")
    _encode(path, pixels[:, :, ::-1])


def write_ids(path: str | os.PathLike[str], ids: Any) -> None:
    """Write a label image as a grey PNG of 8 or 16 bits.

    Args:
        path: Name ending in .png.
        ids: [H, W], uint8 or uint16; array or CPU tensor.

    Raises:
        InputError: Wrong name, shape or type.
    """
    pixels = np.asarray(ids)
    if Path(path).suffix.lower() != ".png":
        raise InputError(f"{path}: label images are written as .png, which is lossless; change the name")
    if pixels.ndim != 2 or pixels.size == 0:
        raise InputError(f"{path}: a label image must have shape [H, W], got {list(pixels.shape)}")
    if pixels.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{path}: a label image must be uint8 or uint16, got {pixels.dtype}")
    _encode(path, pixels)


def _decode(path: str | os.PathLike[str], data: bytes, flags: int) -> NDArray[Any]:
    import cv2

    check_image(path, data)
    if _cut_short(data):
        raise InputError(f"{path}: image is cut short ({len(data)} bytes); copy or download it again")
    if data.startswith(PNG_SIGNATURE):
        data = plain_png(data)  # the decoder takes memory for what other chunks claim
    elif data[:4] in TIFF_SIGNATURES:
        data = without_orientation(data)  # the decoder turns TIFF files whatever its flags say
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        pixels = None
    if pixels is None:
        raise InputError(f"{path}: is not an image that OpenCV can read, or is damaged; save it again as PNG or JPEG")
    return pixels


def _cut_short(data: bytes) -> bool:
    """Whether a JPEG lacks its end marker; OpenCV fills the missing part with grey."""
    if not data.startswith(JPEG_SIGNATURE):
        return False
    # An embedded thumbnail has an end marker of its own, so the search starts at the image data.
    scans = (position for marker, position in jpeg_segments(data) if marker == START_OF_SCAN)
    return data.find(b"\xff\xd9", next(scans, len(data))) < 0


def _palette_as_grey(data: bytes) -> bytes:
    """The same PNG with the palette taken out, so that the decoder yields the indices.

    Indices and grey values are filtered and packed alike (PNG specification, clauses 7 and 9); only the colour type
    in the header and the palette's own chunks tell them apart.
    """
    chunks = [PNG_SIGNATURE]
    for kind, at, length in png_chunks(data):
        chunk = data[at - 8 : at + length + 4]
        if kind == b"IHDR":
            body = kind + data[at : at + 9] + b"\x00" + data[at + 10 : at + 13]
            chunk = struct.pack(">I", 13) + body + struct.pack(">I", zlib.crc32(body))
        if kind not in (b"PLTE", b"tRNS", b"bKGD", b"hIST", b"sBIT"):
            chunks.append(chunk)
    return b"".join(chunks)


def _encode(path: str | os.PathLike[str], pixels: NDArray[Any]) -> None:
    import cv2

    done, data = cv2.imencode(Path(path).suffix.lower(), np.ascontiguousarray(pixels))
    if not done:
        raise InputError(f"{path}: OpenCV cannot encode an image of shape {list(pixels.shape)}")
    with atomic_path(path) as temporary:
        temporary.write_bytes(data.tobytes())
