"""Files that name strange things, or the same thing again and again: refused in one line, in little memory."""

import json
import struct
import zipfile
import zlib

import numpy as np
import pytest
import torch

from sgwarp.cluster.listing import list_scenes
from sgwarp.errors import LONGEST, InputError
from sgwarp.files.access import read_bytes
from sgwarp.io.colmap_model import read_cameras, read_images, read_points
from sgwarp.io.formats.gltf import write_gltf
from sgwarp.io.formats.spz import HEADER, HEADER_4, MAGIC, STREAM, Header
from sgwarp.io.points import load_points
from sgwarp.io.scenes import load_gaussians
from sgwarp.io.sequences import load_sequence
from sgwarp.io.views import load_views
from sgwarp.scene import Gaussians

NAMES = ["a\0b", "a" * 5000, "/".join(["a" * 250] * 30), "a\n\x1b[2Jb", "\udcff", "."]


def refused(read) -> str:
    with pytest.raises(InputError) as caught:
        read()
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 2 * LONGEST
    return str(caught.value)


@pytest.mark.parametrize("name", NAMES, ids=range(len(NAMES)))
def test_names_that_no_file_has(tmp_path, name):
    """As a path of the caller, in a glTF, a SOG, a transforms.json and a list."""
    refused(lambda: read_bytes(tmp_path / name))
    refused(lambda: load_gaussians(tmp_path / f"{name}.ply"))
    refused(lambda: load_views(tmp_path / name))
    refused(lambda: load_points(tmp_path / name))
    refused(lambda: load_sequence(tmp_path / name))
    refused(lambda: list_scenes(str(tmp_path / name)))
    scene = tmp_path / "a.gltf"
    scene.write_text(json.dumps({"asset": {"version": "2.0"}, "buffers": [{"uri": name, "byteLength": 4}]}))
    refused(lambda: load_gaussians(scene))
    views = {"w": 8, "h": 6, "fl_x": 9, "fl_y": 9, "ply_file_path": name}
    views["frames"] = [{"file_path": name, "transform_matrix": np.eye(4).tolist()}]
    (tmp_path / "transforms.json").write_text(json.dumps(views))
    refused(lambda: load_views(tmp_path))
    refused(lambda: load_points(tmp_path))


@pytest.mark.parametrize(
    "uri", ["data:,\u00e9", "data:;base64,@@@", "%2e%2e/x", "../x", "/etc/passwd", "file:///etc/passwd"]
)
def test_buffers_that_are_none(tmp_path, uri):
    scene = tmp_path / "a.gltf"
    scene.write_text(json.dumps({"asset": {"version": "2.0"}, "buffers": [{"uri": uri, "byteLength": 4}]}))
    refused(lambda: load_gaussians(scene))


def repeated(path, count: int, times: int) -> None:
    """A .glb whose one primitive is listed `times` times."""
    ones = (torch.ones(count, *shape) for shape in ((3,), (4,), (3,), (), (1, 3)))
    write_gltf(Gaussians(*ones), path)
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    document, body = json.loads(data[20 : 20 + length]), data[20 + length :]
    document["meshes"][0]["primitives"] *= times
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    path.write_bytes(data[:8] + struct.pack("<II", 20 + len(text) + len(body), len(text)) + b"JSON" + text + body)


def test_a_gltf_that_names_its_data_again_and_again(tmp_path):
    """2 MB of file were a scene of 60 GB."""
    scene = tmp_path / "a.glb"
    repeated(scene, 50_000, 3)
    assert len(load_gaussians(scene)) == 150_000
    repeated(scene, 50_000, 20_000)
    assert "refers to its data more than" in refused(lambda: load_gaussians(scene))


def test_a_buffer_that_is_named_twice_is_read_once(tmp_path, monkeypatch):
    from sgwarp.io.formats import gltf_buffers

    reads = []
    monkeypatch.setattr(gltf_buffers, "read_bytes", lambda path: reads.append(path) or read_bytes(path))
    (tmp_path / "a.bin").write_bytes(bytes(8))
    scene = tmp_path / "a.gltf"
    scene.write_text(json.dumps({"asset": {"version": "2.0"}, "buffers": [{"uri": "a.bin", "byteLength": 8}] * 50}))
    assert len(gltf_buffers.read_document(scene).buffers) == 50
    assert reads == [scene, tmp_path / "a.bin"]


@pytest.mark.parametrize("version", [3, 4])
def test_an_spz_of_more_gaussians_than_bytes(tmp_path, version):
    """Deflate makes 1032 bytes of one, Zstandard 30,000."""
    zstandard = pytest.importorskip("zstandard")
    header = Header(version, 300_000, 0, 12, 0)
    if version == 3:
        packer = zlib.compressobj(9, wbits=31)
        start = HEADER.pack(MAGIC, 3, header.count, 0, 12, 0, 0)
        data = packer.compress(start + bytes(sum(header.sizes))) + packer.flush()
    else:
        streams = [(zstandard.ZstdCompressor().compress(bytes(size)), size) for size in header.sizes if size]
        start = HEADER_4.pack(MAGIC, 4, header.count, 0, 12, 0, len(streams), HEADER_4.size)
        data = start + b"".join(STREAM.pack(len(packed), size) for packed, size in streams)
        data += b"".join(packed for packed, _ in streams)
    (tmp_path / "a.spz").write_bytes(data)
    assert "300000 Gaussians" in refused(lambda: load_gaussians(tmp_path / "a.spz"))


@pytest.mark.parametrize("name", ["meta.json", "means_l.webp"])
def test_a_sog_whose_members_unpack_to_more(tmp_path, name):
    meta = {"version": 2, "count": 4, "means": {"files": ["means_l.webp", "x"]}}
    members = {"meta.json": json.dumps(meta).encode(), "means_l.webp": b""}
    members[name] += b" " * 40_000_000
    with zipfile.ZipFile(tmp_path / "a.sog", "w", zipfile.ZIP_DEFLATED) as archive:
        for member, data in members.items():
            archive.writestr(member, data)
    assert "claims 400" in refused(lambda: load_gaussians(tmp_path / "a.sog"))


def test_frames_that_unpack_to_more_than_an_archive_may(tmp_path):
    with zipfile.ZipFile(tmp_path / "params.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        header = {"descr": "<f4", "fortran_order": False, "shape": (1, 30_000_000, 3)}
        with archive.open("means3D.npy", "w") as member:
            np.lib.format.write_array_header_1_0(member, header)
            for _ in range(360):
                member.write(bytes(1_000_000))
    assert "claims 360" in refused(lambda: load_sequence(tmp_path / "params.npz"))


def test_lines_of_a_model_without_end(tmp_path, monkeypatch):
    from sgwarp.io import colmap_model

    (tmp_path / "cameras.txt").write_text("1 PINHOLE 8 6 " + "1 " * 3000)
    refused(lambda: read_cameras(tmp_path))
    (tmp_path / "images.txt").write_text(
        "1 1 0 0 0 0 0 0 1 a.png\n" + "1 2 3 " * 5000 + "\n2 1 0 0 0 0 0 0 1 b.png\n\n"
    )
    assert [record.name for record in read_images(tmp_path)] == ["a.png", "b.png"]
    (tmp_path / "points3D.txt").write_text("1 0 0 0 1 2 3 0 " + "1 " * 5000 + "\n")
    assert len(read_points(tmp_path)[0]) == 1
    monkeypatch.setattr(colmap_model, "LONGEST_LINE", 1000)
    assert "line 2 has 1000 characters or more" in refused(lambda: read_images(tmp_path))
    assert "line 1 has 1000 characters or more" in refused(lambda: read_points(tmp_path))


@pytest.mark.parametrize(
    "content", [b"path\n" + b"a" * 200_000 + b"\n", b'path\n"a\n' + b"b" * 200_000, b"\xff\xfe", b"path\n\n"]
)
def test_lists_that_are_none(tmp_path, content):
    (tmp_path / "a.csv").write_bytes(content)
    refused(lambda: list_scenes(str(tmp_path / "a.csv")))


def test_long_messages_keep_both_ends():
    message = str(InputError("a.ply: " + "x" * 10**6 + "; write it again"))
    assert len(message) < 2 * LONGEST
    assert message.startswith("a.ply: xxx")
    assert message.endswith("xxx; write it again")
