"""Transforms of whole worlds with everything that has a length, versions of files, and formats told by their bytes."""

import gzip
from dataclasses import replace

import numpy as np
import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.files.images import write_rgb
from sgwarp.files.tensors import read_tensors, write_tensors
from sgwarp.io import scenes
from sgwarp.io.instances import load_instances
from sgwarp.io.ply import columns
from sgwarp.io.store import load_semantics, read_notes
from sgwarp.io.undistort import Lens
from sgwarp.io.world import similarity_between
from sgwarp.io.world_transforms import moved_views, read_world_transform
from sgwarp.scene import Camera, View

K = torch.tensor([[40.0, 0, 21], [0, 42, 14], [0, 0, 1]])
C, S = np.cos(0.7), np.sin(0.7)
TURN = np.array([[C, -S, 0], [S, C, 0], [0, 0, 1]])


@pytest.mark.parametrize("scale", [0.02, 1.0, 50.0])
def test_all_that_has_a_length_moves_with_the_world(scale):
    """Pixels of a moved point stay where they are, and its depth, near and far are scaled."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = scale * TURN, (3.0, -2.0, 1.0)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = torch.from_numpy(TURN.T), torch.tensor([0.3, 0.2, 0.1])
    view = View("a", Camera(K, pose, 40, 30, near=0.5, far=70.0))
    (moved,) = moved_views([view], matrix)
    point = np.array([0.4, -0.3, 6.0])
    before = pose[:3, :3].numpy() @ point + pose[:3, 3].numpy()
    after = moved.camera.world_to_camera.numpy() @ (matrix @ np.append(point, 1))
    np.testing.assert_allclose(after[:3], scale * before, rtol=1e-9, atol=1e-9)
    assert (moved.camera.near, moved.camera.far) == (pytest.approx(0.5 * scale), pytest.approx(70 * scale))


@pytest.mark.parametrize("scale", [0.02, 1.0, 50.0])
def test_a_similarity_is_found_with_its_scale(scale):
    points = np.random.default_rng(0).normal(size=(9, 3))
    found = similarity_between(points, scale * points @ TURN.T + [1.0, 2.0, 3.0])
    np.testing.assert_allclose(found[:3, :3], scale * TURN, atol=1e-9 * scale)
    np.testing.assert_allclose(found[:3, 3], [1, 2, 3], atol=1e-6)


@pytest.mark.parametrize(("change", "fine"), [(0.0, True), (4e-4, True), (2e-3, False)])
def test_a_transform_has_one_scale_to_a_thousandth(tmp_path, change, fine):
    matrix = np.diag([2.0 * (1 + change), 2.0, 2.0, 1.0])[:3]
    np.savetxt(tmp_path / "m.txt", matrix)
    if fine:
        np.testing.assert_allclose(read_world_transform(tmp_path / "m.txt")[:3], matrix)
        return
    with pytest.raises(InputError, match="is not a rotation with a translation and one positive scale"):
        read_world_transform(tmp_path / "m.txt")


def test_a_lens_is_its_matrix():
    lens = Lens(40.0, 41.0, 19.0, 16.0, 40, 30)
    assert lens.K.tolist() == [[40, 0, 19], [0, 41, 16], [0, 0, 1]]
    half = lens.resized(20, 15)
    assert (half.fx, half.fy, half.cx, half.cy, half.width, half.height) == (20, 20.5, 9.5, 8, 20, 15)


@pytest.mark.parametrize("version", ["0", "2", "x", None])
@pytest.mark.parametrize(("form", "read"), [("sgwarp instances", load_instances), ("sgwarp semantics", load_semantics)])
def test_files_of_other_versions_are_refused(tmp_path, version, form, read):
    path = tmp_path / "a.safetensors"
    formats = {load_instances: "sgwarp.io.instances", load_semantics: "sgwarp.io.store"}
    name = __import__(formats[read], fromlist=["FORMAT"]).FORMAT
    metadata = {"format": name} | ({} if version is None else {"version": version})
    write_tensors(path, {"features": torch.zeros(2, 2)}, metadata)
    readers = (read, read_notes) if read is load_semantics else (read,)
    for reader in readers:
        with pytest.raises(InputError, match=f"has version {version}, this program reads 1; update it"):
            reader(path)
    write_tensors(path, {"features": torch.zeros(2, 2)}, metadata | {"format": "x", "version": "1"})
    for reader in readers:
        with pytest.raises(InputError, match="other tensors"):
            reader(path)
    assert read_tensors(path, {"features"})[0]["format"] == "x"


@pytest.mark.parametrize(
    ("name", "head", "form"),
    [
        ("a.bin", b"ply\nformat", "PLY"),
        ("a.bin", b"ply\r\nformat", "PLY"),
        ("a.bin", b"NGSP....", "SPZ"),
        ("a.bin", gzip.compress(b"NGSP", mtime=0), "SPZ"),
        ("a.bin", b"glTF....", "GLTF"),
        ("a.sog", b"PK\x03\x04", "SOG"),
        ("a.splat", b"\0" * 32, "SPLAT"),
    ],
)
def test_formats_are_told_by_their_bytes(tmp_path, name, head, form):
    (tmp_path / name).write_bytes(head)
    found = scenes.find_format(tmp_path / name)
    assert found.suffixes == getattr(scenes, form, found).suffixes
    assert form.lower().removesuffix("tf") in "".join(found.suffixes)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_columns_have_the_precision_that_is_asked_for(kind):
    rows = np.zeros(3, dtype=[("x", "<f8"), ("y", "<i4")])
    rows["x"] = 4_000_000.123456
    found = columns("a.ply", rows, ("y", "x"), kind)
    assert found.dtype == kind
    assert found[0, 1] == kind(4_000_000.123456)


@pytest.mark.parametrize(("width", "height"), [(40, 30), (41, 30), (40, 31)])
def test_a_photograph_has_the_size_of_its_camera(tmp_path, width, height):
    write_rgb(tmp_path / "a.png", np.zeros((height, width, 3), np.uint8))
    view = View("a", Camera(K, torch.eye(4), 40, 30), tmp_path / "a.png")
    if (width, height) == (40, 30):
        assert view.pixels().shape == (30, 40, 3)
        assert view.image().dtype == torch.float32
        return
    with pytest.raises(InputError, match=f"image is {width} x {height}, its camera says 40 x 30"):
        view.pixels()
    with pytest.raises(InputError, match="view a: has no photograph"):
        replace(view, image_path=None).pixels()
