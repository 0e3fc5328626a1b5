"""TIFF files by hand that note an orientation (TIFF 6.0, tag 274) or Lab colors (tag 262)."""

import struct

import numpy as np
import pytest

from sgwarp.errors import InputError
from sgwarp.files.exif import read_orientation, turn
from sgwarp.files.images import read_rgb, read_size, read_values

HEIGHT, WIDTH = 4, 6


def tiff(pixels: np.ndarray, orientation: int, order: str = "<", colors: int = 2) -> bytes:
    """One uncompressed strip, gray or RGB."""
    height, width = pixels.shape[:2]
    samples = 1 if pixels.ndim == 2 else 3
    bits = 8 * pixels.itemsize
    entries = [(256, 4, width), (257, 4, height), (258, 3, bits), (259, 3, 1), (262, 3, 1 if samples == 1 else colors)]
    entries += [(273, 4, None), (274, 3, orientation), (277, 3, samples), (278, 4, height), (279, 4, pixels.nbytes)]
    end = 8 + 2 + 12 * len(entries) + 4
    data = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "IH", 8, len(entries))
    for tag, kind, value in entries:
        if tag == 258 and samples == 3:
            data += struct.pack(order + "HHII", tag, kind, 3, end)
            continue
        value = end + 6 if value is None else value
        data += struct.pack(order + "HHI" + ("I" if kind == 4 else "HH"), tag, kind, 1, *([value, 0][: 5 - kind]))
    return (
        data
        + bytes(4)
        + struct.pack(order + "HHH", bits, bits, bits)
        + pixels.astype(order + pixels.dtype.str[1:]).tobytes()
    )


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_pixels_come_as_they_are_stored(tmp_path, orientation, order):
    random = np.random.default_rng(0)
    rgb, gray = (
        random.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8),
        random.integers(0, 2**16, (HEIGHT, WIDTH), np.uint16),
    )
    (tmp_path / "rgb.tif").write_bytes(tiff(rgb, orientation, order))
    (tmp_path / "depth.tif").write_bytes(tiff(gray, orientation, order))
    np.testing.assert_array_equal(read_rgb(tmp_path / "rgb.tif"), rgb)
    np.testing.assert_array_equal(read_values(tmp_path / "depth.tif"), gray)
    assert read_size(tmp_path / "rgb.tif") == (HEIGHT, WIDTH)
    assert read_orientation(tmp_path / "rgb.tif") == orientation


def test_they_are_turned_as_pillow_turns_them(tmp_path):
    image = pytest.importorskip("PIL.Image")
    rgb = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    for orientation in range(1, 9):
        (tmp_path / "rgb.tif").write_bytes(tiff(rgb, orientation))
        turned = np.asarray(image.open(tmp_path / "rgb.tif"))  # Pillow turns TIFF files as it opens them
        np.testing.assert_array_equal(turn(read_rgb(tmp_path / "rgb.tif"), orientation), turned)


@pytest.mark.parametrize("colors", [8, 9, 10])
def test_lab_colors_are_refused(tmp_path, colors):
    path = tmp_path / "lab.tif"
    path.write_bytes(tiff(np.full((HEIGHT, WIDTH, 3), 100, np.uint8), 1, colors=colors))
    with pytest.raises(InputError, match=r"holds Lab colors, .*; save it again as RGB"):
        read_rgb(path)
