"""Origin, unit and frame of a data set: the cameras and points of one file stay together."""

import json
import struct
import sys

import numpy as np
import pytest

from sgwarp.errors import InputError
from sgwarp.files.images import write_rgb
from sgwarp.io.points import load_points
from sgwarp.io.views import load_views
from sgwarp.io.world import far_origin, similarity_between

PLACES = np.array([[1.0, 0, 0], [0, 1.0, 0.2], [-1.0, 0, 0.1], [0, -1.0, -0.2]])
POINTS = np.array([[0.1, 0.2, 3.0], [-0.3, 0.1, 2.5], [0.2, -0.4, 4.0]])
UTM = np.array([447123.4, 5411234.7, 253.2])
APPLIED = np.array([[0.0, 1, 0, 0.5], [1, 0, 0, -2], [0, 0, -1, 1]])


def write_model(folder, shift=(0, 0, 0), scale=1.0) -> None:
    """Four cameras that look along z, and three points, in binary files."""
    folder.mkdir(parents=True)
    (folder / "cameras.bin").write_bytes(struct.pack("<QiiQQ4d", 1, 1, 1, 8, 6, 8, 8, 4, 3))
    data = struct.pack("<Q", len(PLACES))
    for index, place in enumerate(PLACES * scale + shift, 1):
        data += struct.pack("<i7di", index, 1, 0, 0, 0, *-place, 1) + b"%d.png\0" % index + bytes(8)
    (folder / "images.bin").write_bytes(data)
    data = struct.pack("<Q", len(POINTS))
    for index, point in enumerate(POINTS * scale + shift, 1):
        data += struct.pack("<Q3d3BdQ", index, *point, 10, 20, 30, 0.5, 0)
    (folder / "points3D.bin").write_bytes(data)


def write_transforms(folder, places, turn=None, **meta) -> None:
    """The same cameras in a transforms.json, at other places and turned: OpenGL's, whose y points up and z back."""
    frames = []
    for index, place in enumerate(places, 1):
        write_rgb(folder / f"{index}.png", np.zeros((6, 8, 3)))
        pose = np.eye(4)
        pose[:3] = np.c_[(np.eye(3) if turn is None else turn) @ np.diag([1.0, -1.0, -1.0]), place]
        frames.append({"file_path": f"{index}.png", "transform_matrix": pose.tolist()})
    (folder / "transforms.json").write_text(json.dumps({"fl_x": 8, "w": 8, "h": 6, **meta, "frames": frames}))


def positions(views) -> np.ndarray:
    return np.stack([view.camera.position.numpy() for view in views])


def test_cameras_near_the_origin_stay():
    assert far_origin(PLACES) is None
    assert far_origin(PLACES + 500) is None
    assert far_origin(PLACES[:1] + 1e9) is None  # one camera has no extent to compare with


def test_a_part_of_a_far_capture_moves_as_the_whole_does():
    assert far_origin(PLACES + UTM).tolist() == [447100, 5411200, 300]
    assert far_origin(PLACES[:3] + UTM).tolist() == [447100, 5411200, 300]


def test_cameras_and_points_in_utm_coordinates_move_together(tmp_path, caplog):
    write_model(tmp_path / "sparse/0", UTM)
    views = load_views(tmp_path, photographs=False)
    assert "far from the origin" in caplog.text
    assert "(447100, 5411200, 300)" in caplog.text
    moved = UTM - [447100, 5411200, 300]
    np.testing.assert_allclose(positions(views), PLACES + moved, atol=1e-8)
    np.testing.assert_allclose(load_points(tmp_path)[0], POINTS + moved, atol=1e-8)
    own = load_points(tmp_path / "sparse/0/points3D.bin")[0]
    np.testing.assert_allclose(own, POINTS + UTM, atol=1e-8)
    np.testing.assert_allclose(load_points(tmp_path / "sparse/0/points3D.bin", tmp_path)[0], POINTS + moved, atol=1e-8)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e6])
def test_near_and_far_planes_follow_the_unit(tmp_path, scale):
    write_model(tmp_path / "sparse/0", scale=scale)
    camera = load_views(tmp_path, photographs=False)[0].camera
    assert camera.near == pytest.approx(0.01 * scale * 1.1 * np.linalg.norm(PLACES - PLACES.mean(0), axis=1).max())
    assert camera.far > 1000 * scale


@pytest.mark.parametrize("scale", [None, 2.5])
def test_a_declared_transform_applies_to_the_points(tmp_path, scale, caplog):
    write_model(tmp_path / "colmap/sparse/0")
    factor = scale or 1.0
    extra = {} if scale is None else {"applied_scale": scale}
    moved = factor * (PLACES @ APPLIED[:, :3].T + APPLIED[:, 3])
    write_transforms(tmp_path, moved, APPLIED[:, :3], applied_transform=APPLIED.tolist(), **extra)
    np.testing.assert_allclose(
        load_points(tmp_path)[0], factor * (POINTS @ APPLIED[:, :3].T + APPLIED[:, 3]), atol=1e-12
    )
    assert not caplog.text


def test_a_transform_that_is_not_declared_is_measured(tmp_path, caplog):
    write_model(tmp_path / "colmap/sparse/0")
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    write_transforms(tmp_path, 3 * PLACES @ turn.T + [5, 6, 7], turn)
    np.testing.assert_allclose(load_points(tmp_path)[0], 3 * POINTS @ turn.T + [5, 6, 7], atol=1e-9)
    assert "in another frame; the points are moved there" in caplog.text


@pytest.mark.parametrize("count", [2, 5])
def test_cameras_on_a_line_tell_how_the_points_are_turned_about_it(tmp_path, monkeypatch, count):
    monkeypatch.setattr(sys.modules[__name__], "PLACES", np.linspace([-1.0, 0, 0], [1.0, 0, 0], count))
    write_model(tmp_path / "colmap/sparse/0")
    c, s = np.cos(0.8), np.sin(0.8)
    turn = np.array([[1.0, 0, 0], [0, c, -s], [0, s, c]])
    write_transforms(tmp_path, 3 * PLACES @ turn.T + [5, 6, 7], turn)
    np.testing.assert_allclose(load_points(tmp_path)[0], 3 * POINTS @ turn.T + [5, 6, 7], atol=1e-9)


@pytest.mark.parametrize("turn", [np.eye(3), np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])])
def test_poses_in_the_axes_of_opencv_are_told_from_those_of_a_model(tmp_path, caplog, turn):
    write_model(tmp_path / "colmap/sparse/0")
    write_transforms(tmp_path, PLACES @ turn.T, turn @ np.diag([1.0, -1.0, -1.0]))
    with pytest.raises(InputError, match="do not belong to"):
        load_points(tmp_path)
    assert "its poses have to be in OpenGL's axes" in caplog.text


def test_points_of_other_cameras_are_refused(tmp_path):
    write_model(tmp_path / "colmap/sparse/0")
    write_transforms(tmp_path, np.array([[0.0, 0, 0], [9, 0, 0], [0, 1, 0], [3, 3, 3]]))
    with pytest.raises(InputError, match="do not belong to"):
        load_points(tmp_path)


@pytest.mark.parametrize("model", ["sparse/0", "colmap/sparse/0"])
def test_points_as_ply_within_a_model_are_the_models(tmp_path, model):
    """3DGS trainers write one beside points3D.bin; a transforms.json moves it as it moves the model's own."""
    write_model(tmp_path / model)
    (tmp_path / model / "points3D.bin").unlink()
    header = (
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    )
    rows = "".join(" ".join(map(str, point)) + "\n" for point in POINTS)
    (tmp_path / model / "points3D.ply").write_text(header + rows)
    np.testing.assert_allclose(load_points(tmp_path)[0], POINTS, atol=1e-6)
    write_transforms(tmp_path, 3 * PLACES + [5, 6, 7])
    np.testing.assert_allclose(load_points(tmp_path)[0], 3 * POINTS + [5, 6, 7], atol=1e-6)


@pytest.mark.parametrize("meta", [{"applied_transform": [[1, 2]]}, {"applied_transform": "x"}, {"applied_scale": 0}])
def test_declared_transforms_that_are_none_are_refused(tmp_path, meta):
    write_model(tmp_path / "colmap/sparse/0")
    write_transforms(tmp_path, PLACES, **meta)
    with pytest.raises(InputError, match="'applied_"):
        load_points(tmp_path)


def test_the_similarity_between_points_is_found_and_never_mirrors():
    random = np.random.default_rng(0)
    a = random.normal(size=(20, 3))
    q, _ = np.linalg.qr(random.normal(size=(3, 3)))
    q *= np.sign(np.linalg.det(q))
    matrix = similarity_between(a, 0.3 * a @ q.T + [1, 2, 3])
    np.testing.assert_allclose(matrix[:3], np.c_[0.3 * q, [1, 2, 3]], atol=1e-12)
    assert np.linalg.det(similarity_between(a, a * [1, 1, -1])[:3, :3]) > 0
