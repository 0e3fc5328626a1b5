import struct
import zlib

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sgwarp.errors import InputError
from sgwarp.files.images import read_alpha, read_ids, read_rgb, read_size, write_ids, write_rgb


def png(width, height, depth, colour_type, rows, *chunks):
    """A PNG from scan lines of packed bytes (PNG specification)."""

    def chunk(kind, body):
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", width, height, depth, colour_type, 0, 0, 0)
    pixels = zlib.compress(b"".join(b"\0" + bytes(row) for row in rows))
    extra = b"".join(chunk(*c) for c in chunks)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + extra + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


PALETTE = (b"PLTE", bytes([0, 0, 0, 250, 3, 9, 17, 200, 40, 90, 90, 255]))


def smooth(height=24, width=32):
    v, u = np.mgrid[:height, :width]
    return np.stack([u / width, v / height, (u + v) / (width + height)], axis=2).astype(np.float32)


def test_png_round_trip_is_exact(tmp_path):
    image = np.random.default_rng(0).integers(0, 256, (7, 5, 3), dtype=np.uint8)
    write_rgb(tmp_path / "a.png", image)
    assert np.array_equal(read_rgb(tmp_path / "a.png"), image)


def test_channel_order_is_rgb(tmp_path):
    (tmp_path / "red.png").write_bytes(png(1, 1, 8, 2, [[255, 10, 20]]))
    assert read_rgb(tmp_path / "red.png").tolist() == [[[255, 10, 20]]]


def test_float_is_rounded_and_clipped(tmp_path):
    values = torch.tensor([[[-1.0, 0.0, 0.5], [1.0, 2.0, 100.4 / 255]]])
    write_rgb(tmp_path / "a.png", values)
    assert read_rgb(tmp_path / "a.png").tolist() == [[[0, 0, 128], [255, 255, 100]]]


def test_jpeg_is_close(tmp_path):
    write_rgb(tmp_path / "a.jpg", smooth())
    assert np.abs(read_rgb(tmp_path / "a.jpg") / 255 - smooth()).max() < 0.05


def test_exif_orientation_is_not_applied(tmp_path):
    write_rgb(tmp_path / "a.jpg", smooth())
    plain = (tmp_path / "a.jpg").read_bytes()
    tiff = b"MM\0*" + struct.pack(">IHHHIHHI", 8, 1, 0x0112, 3, 1, 6, 0, 0)  # rotate by 90 degrees
    exif = b"Exif\0\0" + tiff
    (tmp_path / "b.jpg").write_bytes(plain[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + plain[2:])
    assert np.array_equal(read_rgb(tmp_path / "b.jpg"), read_rgb(tmp_path / "a.jpg"))


def test_grey_and_alpha_become_rgb(tmp_path):
    (tmp_path / "grey.png").write_bytes(png(2, 1, 8, 0, [[7, 9]]))
    (tmp_path / "rgba.png").write_bytes(png(1, 1, 8, 6, [[1, 2, 3, 128]]))
    assert read_rgb(tmp_path / "grey.png").tolist() == [[[7] * 3, [9] * 3]]
    assert read_rgb(tmp_path / "rgba.png").tolist() == [[[1, 2, 3]]]


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("share", [0.3, 0.6, 0.999])
def test_cut_short(tmp_path, suffix, share):
    path = tmp_path / f"a{suffix}"
    write_rgb(path, np.random.default_rng(1).integers(0, 256, (40, 40, 3), dtype=np.uint8))
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    with pytest.raises(InputError, match=rf"a\{suffix}: image is cut short"):
        read_rgb(path)


def test_thumbnail_does_not_hide_a_cut(tmp_path):
    write_rgb(tmp_path / "small.jpg", smooth(8, 8))
    write_rgb(tmp_path / "a.jpg", smooth(64, 64))
    thumbnail, data = (tmp_path / "small.jpg").read_bytes(), (tmp_path / "a.jpg").read_bytes()
    whole = data[:2] + b"\xff\xe1" + struct.pack(">H", len(thumbnail) + 2) + thumbnail + data[2:]
    (tmp_path / "whole.jpg").write_bytes(whole)
    assert read_rgb(tmp_path / "whole.jpg").shape == (64, 64, 3)
    assert read_size(tmp_path / "whole.jpg") == (64, 64)
    (tmp_path / "cut.jpg").write_bytes(whole[:-40])
    with pytest.raises(InputError, match="cut short"):
        read_rgb(tmp_path / "cut.jpg")


def test_missing_folder_and_foreign(tmp_path):
    (tmp_path / "text.png").write_text("hello")
    (tmp_path / "empty.png").touch()
    with pytest.raises(InputError, match=r"none\.png: no such file"):
        read_rgb(tmp_path / "none.png")
    with pytest.raises(InputError, match="is a folder"):
        read_ids(tmp_path)
    with pytest.raises(InputError, match=r"text\.png: is not an image"):
        read_rgb(tmp_path / "text.png")
    with pytest.raises(InputError, match=r"empty\.png: image is cut short"):
        read_ids(tmp_path / "empty.png")


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp"])
def test_size(tmp_path, suffix):
    import cv2

    cv2.imwrite(str(tmp_path / f"a{suffix}"), np.zeros((6, 11, 3), np.uint8))
    assert read_size(tmp_path / f"a{suffix}") == (6, 11)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_ids_round_trip(tmp_path, kind):
    ids = np.array([[0, 1, 2], [np.iinfo(kind).max, 17, 3]], dtype=kind)
    write_ids(tmp_path / "ids.png", ids)
    read = read_ids(tmp_path / "ids.png")
    assert read.dtype == np.int32
    assert np.array_equal(read, ids)


def test_long_ids(tmp_path):
    (tmp_path / "deva.png").write_bytes(png(2, 1, 8, 2, [[1, 2, 3, 250, 0, 0]]))
    assert read_ids(tmp_path / "deva.png").tolist() == [[1 + 2 * 256 + 3 * 65536, 250]]


def test_grey_stored_as_colour_is_the_grey_value(tmp_path):
    (tmp_path / "a.png").write_bytes(png(2, 1, 8, 2, [[7, 7, 7, 0, 0, 0]]))
    assert read_ids(tmp_path / "a.png").tolist() == [[7, 0]]
    (tmp_path / "b.png").write_bytes(png(1, 1, 8, 6, [[7, 7, 7, 255]]))
    assert read_ids(tmp_path / "b.png").tolist() == [[7]]


def test_palette_index_is_the_id(tmp_path):
    (tmp_path / "p8.png").write_bytes(png(4, 1, 8, 3, [[3, 1, 0, 2]], PALETTE, (b"tRNS", b"\0")))
    assert read_ids(tmp_path / "p8.png").tolist() == [[3, 1, 0, 2]]
    (tmp_path / "p2.png").write_bytes(png(4, 1, 2, 3, [[0b11_01_00_10]], PALETTE))
    assert read_ids(tmp_path / "p2.png").tolist() == [[3, 1, 0, 2]]


@pytest.mark.parametrize(
    ("depth", "row", "ids"),
    [(1, [0b1010_0000], [1, 0, 1]), (2, [0b11_01_10_00], [3, 1, 2]), (4, [0xF3, 0x10], [15, 3, 1])],
)
def test_few_bits_are_not_scaled(tmp_path, depth, row, ids):
    (tmp_path / "a.png").write_bytes(png(3, 1, depth, 0, [row]))
    assert read_ids(tmp_path / "a.png").tolist() == [ids]


def test_what_cannot_hold_ids(tmp_path):
    write_rgb(tmp_path / "a.jpg", smooth())
    with pytest.raises(InputError, match="JPEG compression alters ids"):
        read_ids(tmp_path / "a.jpg")
    (tmp_path / "alpha.png").write_bytes(png(1, 1, 8, 6, [[1, 2, 3, 0]]))
    with pytest.raises(InputError, match="transparent"):
        read_ids(tmp_path / "alpha.png")
    (tmp_path / "deep.png").write_bytes(png(1, 1, 16, 2, [[0, 1, 0, 2, 0, 3]]))
    with pytest.raises(InputError, match="uint16 colour image"):
        read_ids(tmp_path / "deep.png")


def test_bad_output(tmp_path):
    with pytest.raises(InputError, match=r"\[H, W, 3\], got \[4, 4\]"):
        write_rgb(tmp_path / "a.png", np.zeros((4, 4)))
    with pytest.raises(InputError, match="int64"):
        write_rgb(tmp_path / "a.png", np.zeros((4, 4, 3), np.int64))
    with pytest.raises(InputError, match=r"NaN, first at \[1, 0, 2\]"):
        write_rgb(tmp_path / "a.png", np.array([[[0.0] * 3], [[0.0, 0.0, np.nan]]]))
    with pytest.raises(InputError, match=r"\.tga: pictures are written as \.png"):
        write_rgb(tmp_path / "a.tga", smooth())
    with pytest.raises(InputError, match="lossless"):
        write_ids(tmp_path / "a.jpg", np.zeros((4, 4), np.uint8))
    with pytest.raises(InputError, match="uint8 or uint16, got int32"):
        write_ids(tmp_path / "a.png", np.zeros((4, 4), np.int32))
    with pytest.raises(InputError, match=r"\[H, W\]"):
        write_ids(tmp_path / "a.png", np.zeros((4, 4, 1), np.uint8))
    assert list(tmp_path.iterdir()) == []


@settings(deadline=None, max_examples=60)
@given(body=st.binary(max_size=200), start=st.sampled_from([b"", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe0", b"BM"]))
def test_random_bytes_are_only_input_errors(tmp_path_factory, body, start):
    path = tmp_path_factory.getbasetemp() / "random.png"
    path.write_bytes(start + body)
    for read in (read_rgb, read_ids):
        with pytest.raises(InputError, match=r"random\.png"):
            read(path)


@settings(deadline=None, max_examples=60)
@given(position=st.integers(0, 10_000), value=st.integers(0, 255))
def test_damaged_label_image(tmp_path_factory, allow_input_error, position, value):
    path = tmp_path_factory.getbasetemp() / "damaged.png"
    data = bytearray(png(4, 2, 4, 3, [[0x31, 0x02], [0x00, 0x11]], PALETTE))
    data[position % len(data)] = value
    path.write_bytes(bytes(data))
    with allow_input_error(path):
        assert read_ids(path).dtype == np.int32


def test_alpha_is_told_by_the_content_not_the_name(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (6, 8, 4), dtype=np.uint8)
    data = cv2.imencode(".png", pixels)[1].tobytes()
    (tmp_path / "cut_out.jpg").write_bytes(data)
    alpha = read_alpha(tmp_path / "cut_out.jpg")
    assert alpha is not None
    assert np.array_equal(alpha, pixels[:, :, 3])
    (tmp_path / "photo.png").write_bytes(cv2.imencode(".jpg", pixels[:, :, :3])[1].tobytes())
    assert read_alpha(tmp_path / "photo.png") is None


def test_colors_of_a_transparent_tiff_are_not_multiplied_by_alpha(tmp_path):
    """An uncompressed TIFF with an alpha channel that is not multiplied in (TIFF 6.0, ExtraSamples = 2), by hand."""
    rgba = np.random.default_rng(0).integers(64, 256, (4, 5, 4), dtype=np.uint8)
    entries = [
        *[(256, 3, 1, 5), (257, 3, 1, 4), (258, 3, 4, 200), (259, 3, 1, 1), (262, 3, 1, 2), (273, 4, 1, 208)],
        *[(277, 3, 1, 4), (278, 3, 1, 4), (279, 4, 1, rgba.size), (338, 3, 1, 2)],
    ]
    head = b"II*\0" + struct.pack("<IH", 8, len(entries)) + b"".join(struct.pack("<HHII", *e) for e in entries)
    data = (head + bytes(4)).ljust(200, b"\0") + struct.pack("<4H", 8, 8, 8, 8) + rgba.tobytes()
    (tmp_path / "a.tif").write_bytes(data)
    assert np.abs(read_rgb(tmp_path / "a.tif").astype(int) - rgba[:, :, :3]).max() <= 2  # 8 bits, there and back
    alpha = read_alpha(tmp_path / "a.tif")
    assert alpha is not None
    assert np.array_equal(alpha, rgba[:, :, 3])
