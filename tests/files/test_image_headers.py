"""Images are looked at before they are decoded: what a file cannot hold takes no memory."""

import contextlib
import struct
import zlib

import cv2
import numpy as np
import pytest

from sgwarp.errors import InputError
from sgwarp.files.image_headers import PNG_SIGNATURE, check_image, image_size, plain_png, png_chunks

PIXELS = np.random.default_rng(0).integers(0, 255, (33, 47, 3), np.uint8)
FORMATS = {
    "png": (".png", []),
    "jpg": (".jpg", []),
    "progressive": (".jpg", [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]),
    "webp": (".webp", [cv2.IMWRITE_WEBP_QUALITY, 80]),
    "lossless webp": (".webp", [cv2.IMWRITE_WEBP_QUALITY, 101]),
    "tif": (".tif", []),
    "bmp": (".bmp", []),
}


def encoded(name: str, pixels=PIXELS) -> bytes:
    suffix, options = FORMATS[name]
    return cv2.imencode(suffix, pixels, options)[1].tobytes()


@pytest.mark.parametrize("name", FORMATS)
def test_sizes_are_those_of_the_pixels(name):
    assert check_image("a", encoded(name)) == (33, 47)


@pytest.mark.parametrize("name", FORMATS)
def test_one_color_of_a_large_image_is_not_taken_for_a_lie(name):
    """The smallest files that an encoder makes of many pixels."""
    assert check_image("a", encoded(name, np.zeros((2000, 3000, 3), np.uint8))) == (2000, 3000)


def test_alpha_makes_an_extended_webp():
    data = cv2.imencode(".webp", np.dstack([PIXELS, PIXELS[:, :, 0]]), [cv2.IMWRITE_WEBP_QUALITY, 80])[1].tobytes()
    assert data[12:16] == b"VP8X"
    assert check_image("a", data) == (33, 47)


def chunk(kind: bytes, content: bytes, length: int | None = None) -> bytes:
    body = kind + content
    return struct.pack(">I", len(content) if length is None else length) + body + struct.pack(">I", zlib.crc32(body))


def png(width: int, height: int, rows: bytes, extra: bytes = b"") -> bytes:
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return PNG_SIGNATURE + head + extra + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def test_a_chunk_that_reaches_beyond_the_end_is_refused():
    good = png(4, 3, bytes(39), chunk(b"tEXt", b"hello"))
    assert check_image("a", good) == (3, 4)
    for kind, at, length in png_chunks(good):
        if kind != b"IEND":
            for claim in (length + 2**20, 2**31 - 1, 2**32 - 1):
                bad = good[: at - 8] + struct.pack(">I", claim) + good[at - 4 :]
                with pytest.raises(InputError, match=r"cut short|damaged|not an image"):
                    check_image("a", bad)


@pytest.mark.parametrize(("width", "height"), [(20_000, 5_000), (2**31 - 1, 1), (10_000, 10_000)])
def test_a_png_whose_bytes_cannot_hold_it_is_refused(width, height):
    with pytest.raises(InputError, match=r"cannot hold|more than"):
        check_image("a.png", png(width, height, bytes(100)))


def test_a_jpeg_whose_bytes_cannot_hold_it_is_refused():
    data = bytearray(encoded("jpg"))
    at = data.find(b"\xff\xc0") + 5
    data[at : at + 4] = struct.pack(">HH", 9000, 9000)
    with pytest.raises(InputError, match="cannot hold 9000 x 9000"):
        check_image("a.jpg", bytes(data))


def test_the_limit_can_be_lifted(monkeypatch):
    data = encoded("png")
    monkeypatch.setenv("SGWARP_LARGEST_IMAGE", "1000")
    with pytest.raises(InputError, match=r"47 x 33, more than 1000 pixels.*SGWARP_LARGEST_IMAGE=1551"):
        check_image("a.png", data)
    monkeypatch.setenv("SGWARP_LARGEST_IMAGE", "1551")
    assert check_image("a.png", data) == (33, 47)
    monkeypatch.setenv("SGWARP_LARGEST_IMAGE", "much")
    with pytest.raises(InputError, match="expected a number of pixels"):
        check_image("a.png", data)


@pytest.mark.parametrize(
    "data", [b"", b"GIF89a" + bytes(30), b"hello", PNG_SIGNATURE, b"\xff\xd8\xff", b"BM", b"II*\0", b"RIFF"]
)
def test_other_files_are_refused(data):
    with pytest.raises(InputError):
        check_image("a", data)
    assert image_size(data) is None


def test_a_plain_png_has_the_same_pixels():
    extra = chunk(b"tEXt", b"hello") + chunk(b"iTXt", bytes(100)) + chunk(b"acTL", bytes(8))
    data = png(4, 3, bytes(range(39)).replace(b"\x0d", b"\0"), extra) + b"trailing"
    plain = plain_png(data)
    assert [kind for kind, _, _ in png_chunks(plain)] == [b"IHDR", b"IDAT", b"IEND"]
    assert len(plain) < len(data) - 120
    whole = encoded("png")
    assert np.array_equal(cv2.imdecode(np.frombuffer(plain_png(whole), np.uint8), -1), PIXELS)


def test_every_way_to_cut_an_image_short_leaves_no_other_error():
    for name in FORMATS:
        data = encoded(name)
        for length in range(0, len(data), 13):
            with contextlib.suppress(InputError):
                check_image("a", data[:length])
