"""Where a value begins to count: limits, units, bytes of more than one digit, and what is said or refused there."""

import json
import logging
import zipfile
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement

from sgwarp.errors import InputError
from sgwarp.files.images import write_rgb
from sgwarp.io.formats.dot_splat import write_splat
from sgwarp.io.formats.sog import read_sog
from sgwarp.io.formats.spz import read_spz, write_spz
from sgwarp.io.names import inside
from sgwarp.io.photographs import fit_photograph
from sgwarp.io.ply import write_ply
from sgwarp.io.ply_header import check_ply
from sgwarp.io.points import load_points
from sgwarp.io.posed_photographs import write_posed_photographs
from sgwarp.io.sequence_files import write_meta
from sgwarp.io.sequences import ParamsSequence, load_sequence
from sgwarp.io.transforms import read_transforms
from sgwarp.io.undistort import Lens
from sgwarp.io.views import load_views
from sgwarp.io.world import far_origin, transform_of_points
from sgwarp.scene import Camera, Gaussians, View


def gaussians(count: int = 6, degree: int = 0) -> Gaussians:
    random = torch.Generator().manual_seed(3)
    return Gaussians(
        torch.randn(count, 3, generator=random),
        torch.randn(count, 4, generator=random),
        0.1 + torch.rand(count, 3, generator=random),
        torch.full((count,), 0.5),
        torch.full((count, (degree + 1) ** 2, 3), 0.25),
    )


# Scene files.


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_color_that_a_splat_file_cannot_hold_is_said(tmp_path, caplog, degree):
    write_splat(gaussians(degree=degree), tmp_path / "a.splat")
    assert ("holds no view-dependent color" in caplog.text) == (degree > 0)


@pytest.mark.parametrize("suffix", ["ply", "spz"])
@pytest.mark.parametrize("broken", ["quats", "means", "scales"])
def test_what_is_never_rendered_is_not_written_and_counted(tmp_path, caplog, suffix, broken):
    scene = gaussians()
    getattr(scene, broken)[2] = 0.0 if broken == "quats" else torch.nan
    scene = replace(scene)
    if suffix == "spz":
        assert write_spz(scene, tmp_path / "a.spz").tolist() == [0, 1, 3, 4, 5]
        assert "left out 1 of 6 Gaussians" in caplog.text
    else:
        write_ply(scene, tmp_path / "a.ply")  # which can hold anything
        assert PlyData.read(str(tmp_path / "a.ply"))["vertex"].count == 6


@pytest.mark.parametrize(("farthest", "bits"), [(1.0, 13), (10.0, 12), (2047.0, 12), (2049.0, 11), (5000.0, 10)])
def test_positions_of_spz_have_the_bits_they_need(tmp_path, caplog, farthest, bits):
    """Steps of 2e-4 of the farthest coordinate or finer where there are bits for it, and 24 bits in all."""
    scene = gaussians()
    scene.means[:] = torch.linspace(-farthest, farthest, 18).reshape(6, 3)
    kept = write_spz(scene, tmp_path / "a.spz", version=3)
    found = read_spz(tmp_path / "a.spz").means
    assert (found - scene.means[kept]).abs().max() <= 0.51 * 2.0**-bits
    steps = found.double() * 2.0**bits
    assert torch.equal(steps, steps.round())
    assert bool((steps.remainder(2) != 0).any())
    assert ("so positions are kept to" in caplog.text) == (bits < 12)


@pytest.mark.parametrize("label", [0, 255, 256, 300, 999, 1000, 1023])
def test_palettes_of_sog_have_two_bytes(tmp_path, label):
    """Label = low byte + 256 high ones; each of 64 palettes a row is three pixels of degree 1."""
    centroids = np.zeros((16, 64 * 3, 4), np.uint8)
    centroids[..., 3] = 255
    centroids[..., 0] = np.arange(16 * 64 * 3).reshape(16, -1) // 3 % 64 + 64 * (np.arange(16)[:, None] % 4)
    centroids[..., 1] = np.arange(16)[:, None]
    blank = np.full((1, 1, 4), 255, np.uint8)
    labels = np.array([[[label % 256, label // 256, 0, 255]]], np.uint8)
    files = {"c": centroids, "n": labels, "l": blank, "u": blank, "q": np.array([[[128, 128, 128, 252]]], np.uint8)}
    files |= {"s": blank, "d": blank}
    codebook = np.arange(256.0).tolist()
    meta = {
        "version": 2,
        "count": 1,
        "means": {"mins": [0, 0, 0], "maxs": [1, 1, 1], "files": ["l.webp", "u.webp"]},
        "scales": {"codebook": [-3.0] * 256, "files": ["s.webp"]},
        "quats": {"files": ["q.webp"]},
        "sh0": {"codebook": codebook, "files": ["d.webp"]},
        "shN": {"count": 1000, "bands": 1, "codebook": codebook, "files": ["c.webp", "n.webp"]},
    }
    with zipfile.ZipFile(tmp_path / "a.sog", "w") as archive:
        archive.writestr("meta.json", json.dumps(meta))
        for name, rgba in files.items():
            picture = cv2.imencode(".webp", rgba[..., [2, 1, 0, 3]].copy(), [cv2.IMWRITE_WEBP_QUALITY, 101])[1]
            archive.writestr(f"{name}.webp", picture.tobytes())
    if label >= 1000:
        with pytest.raises(InputError, match=f"a Gaussian has palette {label} of 1000; it is damaged"):
            read_sog(tmp_path / "a.sog")
        return
    sh = read_sog(tmp_path / "a.sog").sh[0]
    assert sh[1:, 0].tolist() == [label % 64 + 64 * (label // 64 % 4)] * 3
    assert sh[1:, 1].tolist() == [label // 64] * 3


@pytest.mark.parametrize(("body", "fits"), [(b"1 2\n3 4\n5 6", True), (b"1 2\n3 4\n5", False), (b"1 2\n3 4\n", False)])
def test_a_number_in_a_text_file_takes_two_bytes(tmp_path, body, fits):
    header = b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nend_header\n"
    (tmp_path / "a.ply").write_bytes(header + body)
    if fits:
        check_ply(tmp_path / "a.ply")
        return
    with pytest.raises(InputError, match="is cut short"):
        check_ply(tmp_path / "a.ply")


# Points and worlds.


def test_points_without_colors_are_grey_and_said_to_be(tmp_path, caplog):
    rows = np.zeros(5, dtype=[(axis, "<f4") for axis in "xyz"])
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(tmp_path / "a.ply"))
    assert (load_points(tmp_path / "a.ply")[1] == 0.5).all()
    assert "its points have no colors; they start grey" in caplog.text


@pytest.mark.parametrize("radius", [0.5, 30.0])
def test_cameras_are_far_from_a_thousand_radii_on(radius):
    around = radius * np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    assert far_origin(around + np.array([0, 0, 999 * radius])) is None
    found = far_origin(around + np.array([0, 0, 1001 * radius]))
    step = 10.0 if radius == 0.5 else 1000.0  # the power of ten from ten radii on
    np.testing.assert_array_equal(found, np.round(np.array([0, 0, 1001 * radius]) / step) * step)


def model_beside(folder: Path, size: float, off: float) -> dict:
    """A COLMAP model of three cameras, and transforms of the same ones, the second `off` [radii] beside."""
    folder.mkdir()
    places = size * np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 0.5, 0]])
    lines, frames = [], []
    for k, place in enumerate(places):
        lines.append(f"{k + 1} 1 0 0 0 {-place[0]} {-place[1]} {-place[2]} 1 {k}.png\n\n")
        pose = np.diag([1.0, -1, -1, 1])
        pose[:3, 3] = place + (k == 1) * off * size * np.array([0, 0, 1.0])
        frames.append({"file_path": f"{k}.png", "transform_matrix": pose.tolist()})
    (folder / "cameras.txt").write_text("1 PINHOLE 4 4 4 4 2 2\n")
    (folder / "images.txt").write_text("".join(lines))
    return {"frames": frames}


@pytest.mark.parametrize("size", [0.01, 1.0, 500.0])
@pytest.mark.parametrize(("off", "same"), [(0.005, True), (0.3, False)])
def test_cameras_are_compared_to_a_hundredth_of_their_radius_in_any_unit(tmp_path, size, off, same):
    meta = model_beside(tmp_path / "model", size, off)
    found = transform_of_points(tmp_path / "transforms.json", meta, tmp_path / "model")
    assert (found is not None) == same
    if same:
        np.testing.assert_array_equal(found, np.eye(4))


# Photographs and cameras.


@pytest.mark.parametrize(
    ("camera", "stored", "fits"),
    [
        ((400, 300), (400, 299), True),  # an encoder's missing row
        ((400, 300), (399, 300), True),
        ((400, 300), (400, 298), False),
        ((260, 200), (260, 199), False),  # of fewer than 200 a row matters
        ((40, 30), (40, 29), False),
        ((401, 300), (200, 150), True),  # rounded when it was made smaller
        ((400, 300), (200, 150), True),
        ((400, 300), (300, 400), False),
    ],
)
def test_photographs_that_nearly_fit(tmp_path, camera, stored, fits):
    write_rgb(tmp_path / "a.png", np.zeros((stored[1], stored[0], 3), np.uint8))
    lens = Lens(300.0, 300.0, camera[0] / 2, camera[1] / 2, *camera)
    if fits:
        found, _ = fit_photograph(lens, tmp_path / "a.png")
        assert (found.width, found.height) == stored
    else:
        with pytest.raises(InputError, match="which is another shape"):
            fit_photograph(lens, tmp_path / "a.png")


def frames_file(folder: Path, own: dict | None = None, **meta) -> Path:
    """Two frames; the second has entries of its own."""
    write_rgb(folder / "a.png", np.zeros((30, 40, 3), np.uint8))
    write_rgb(folder / "b.png", np.zeros((30, 40, 3), np.uint8))
    frames = [{"file_path": name, "transform_matrix": np.eye(4).tolist()} for name in ("a.png", "b.png")]
    frames[1] |= own or {}
    whole = {"w": 40, "h": 30, "fl_x": 50.0, "frames": frames} | meta
    (folder / "transforms.json").write_text(json.dumps({k: v for k, v in whole.items() if v is not None}))
    return folder / "transforms.json"


@pytest.mark.parametrize(
    ("key", "value", "of"),
    [
        ("fl_x", 60.0, lambda view: view.undistort.lens.fx),
        ("fl_y", 61.0, lambda view: view.undistort.lens.fy),
        ("cx", 19.0, lambda view: view.undistort.lens.cx),
        ("cy", 16.0, lambda view: view.undistort.lens.cy),
        ("k1", 0.02, lambda view: view.undistort.lens.distortion[0]),
        ("k2", 0.003, lambda view: view.undistort.lens.distortion[1]),
        ("p1", 0.001, lambda view: view.undistort.lens.distortion[2]),
        ("p2", 0.002, lambda view: view.undistort.lens.distortion[3]),
        ("is_fisheye", True, lambda view: view.undistort.lens.model == "fisheye"),
        ("camera_model", "OPENCV_FISHEYE", lambda view: {"fisheye": "OPENCV_FISHEYE"}.get(view.undistort.lens.model)),
        ("depth_unit_scale_factor", 0.25, lambda view: view.depth_unit),
    ],
)
def test_an_entry_of_a_frame_counts_for_it_alone_and_one_of_the_file_for_all(tmp_path, key, value, of):
    plain = {"k1": 0.01, "k2": 0.0, "p1": 0.0, "p2": 0.0}  # so that photographs are undistorted
    own = {name: {} for name in "ab"}
    for name, given, meta in (("a", {key: value}, {}), ("b", {}, {key: value})):
        (tmp_path / name).mkdir()
        own[name] = [of(view) for view in read_transforms(frames_file(tmp_path / name, given, **plain | meta))]
    assert own["a"][1] == own["b"][0] == own["b"][1] == value
    assert own["a"][0] != value


@pytest.mark.parametrize("key", ["k4", "k5", "k6"])
@pytest.mark.parametrize("value", [0.1, -0.1])
def test_coefficients_that_a_model_does_not_have_are_refused(tmp_path, key, value):
    with pytest.raises(InputError, match=f"'{key}' is not defined for camera_model OPENCV"):
        read_transforms(frames_file(tmp_path, **{key: value}))
    read_transforms(frames_file(tmp_path, **{key: 0.0}))


@pytest.mark.parametrize(
    ("meta", "own", "message"),
    [
        ({"fl_x": None, "camera_angle_x": 3.2}, {}, "'camera_angle_x' must be a field of view in radians"),
        ({"fl_x": None, "camera_angle_x": 60}, {}, "if these are degrees, name it 'x_fov'"),
        ({"fl_x": None, "x_fov": 180}, {}, "'x_fov' must be a field of view in degrees between 0 and 180"),
        ({"depth_unit_scale_factor": 0}, {}, "must be a positive number of meters"),
        ({"fl_x": None}, {}, "has no focal length"),
        ({"w": 40.5}, {}, "'w' must be a positive whole number of pixels"),
        ({"latlong": True}, {}, "'latlong' is not supported"),
        ({}, {"from_mitsuba": True}, "'from_mitsuba' is not supported"),
        ({"camera_model": "EQUIRECTANGULAR"}, {}, "camera_model 'EQUIRECTANGULAR' is not supported"),
    ],
)
def test_cameras_that_cannot_be_meant_are_named(tmp_path, meta, own, message):
    with pytest.raises(InputError, match=message):
        read_transforms(frames_file(tmp_path, own, **meta))


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        ([[1, 0], [0, 1]], "'transform_matrix' must be 4 x 4 numbers"),
        ("x", "'transform_matrix' must be 4 x 4 numbers"),
        (np.diag([1.01, 1.01, 1.01, 1]).tolist(), "its rotation is scaled by 1.01"),
        (np.diag([1.01, 1, 1, 1]).tolist(), "must be orthogonal unit vectors"),
        (np.diag([-1.0, 1, 1, 1]).tolist(), "mirrors the world"),
        (np.diag([1.0, 1, 1, 2]).tolist(), "the last row of 'transform_matrix'"),
        (np.diag([1.0, 1, 1, 1.001]).tolist(), "the last row of 'transform_matrix'"),
    ],
)
def test_poses_that_cannot_be_meant_are_said_and_cost_their_frame(tmp_path, caplog, matrix, message):
    assert len(read_transforms(frames_file(tmp_path, {"transform_matrix": matrix}))) == 1
    assert "left out 1 frames that cannot be used" in caplog.text
    assert message in caplog.text


@pytest.mark.parametrize(
    ("meta", "own", "level", "said"),
    [
        ({"train_filenames": ["a.png"]}, {}, "WARNING", "not used: train_filenames"),
        ({}, {"exposure": 2.0}, "WARNING", "not used: exposure of the frames"),
        ({"exposure": -1}, {"depth_path": ""}, "WARNING", None),  # which stand for nothing
        ({}, {"mask_path": "none.png"}, "WARNING", "1 of 1 files that its frames name as mask_path do not exist"),
        ({}, {"depth_file_path": "n.npy"}, "WARNING", "1 of 1 files that its frames name as depth_file_path do not"),
        ({}, {"file_path": "gone.png"}, "WARNING", "left out 1 frames without photograph"),
        ({}, {"file_path": "a.png"}, "WARNING", "left out 1 frames that are listed before"),
        ({}, {"transform_matrix": [[float("nan")] * 4] * 3}, "WARNING", "whose pose holds NaN or infinity"),
    ],
)
def test_what_a_file_declares_and_is_not_used_is_said(tmp_path, caplog, meta, own, level, said):
    with caplog.at_level(logging.INFO, "sgwarp"):
        read_transforms(frames_file(tmp_path, own, **meta))
    records = [record for record in caplog.records if record.levelname == level]
    assert ([said in record.getMessage() for record in records] == [True]) if said else not records


def test_the_other_splits_are_named(tmp_path, caplog):
    path = frames_file(tmp_path).rename(tmp_path / "transforms_train.json")
    (tmp_path / "transforms_val.json").write_text("{}")
    with caplog.at_level(logging.INFO, "sgwarp"):
        read_transforms(path)
    assert "is read alone; give transforms_val.json by name" in caplog.text


# Other folders and files.


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("traj.txt", "Replica"),
        ("bundle.out", "a Bundler file"),
        ("cameras.npz", "a list of DTU cameras"),
        ("IMG_1.HEIC", r"photographs that are not decoded \(1 HEIC files\)"),
        ("notes.txt", "holds no views"),
    ],
)
def test_folders_without_views_say_what_they_hold(tmp_path, name, message):
    place = tmp_path / ("results" if name == "traj.txt" else ".")
    place.mkdir(exist_ok=True)
    (tmp_path / name).write_bytes(b"")
    if name == "traj.txt":
        (place / "depth000000.png").write_bytes(b"")
    with pytest.raises(InputError, match=message):
        load_views(tmp_path)


def test_names_that_lead_outside_are_followed_only_where_that_is_allowed_and_said(tmp_path, monkeypatch, caplog):
    with pytest.raises(InputError, match="lies outside the data set"):
        inside("list", tmp_path, "../a.png")
    monkeypatch.setenv("SGWARP_OUTSIDE", "0")
    with pytest.raises(InputError, match="lies outside the data set"):
        inside("list", tmp_path, "../a.png")
    monkeypatch.setenv("SGWARP_OUTSIDE", "1")
    assert inside("list", tmp_path, "b/../a.png") == tmp_path / "b/../a.png"
    assert "lies outside" not in caplog.text
    assert inside("list", tmp_path, "../a.png") == tmp_path / "../a.png"
    assert "list: '../a.png' lies outside the data set, and is read" in caplog.text


def test_what_is_in_the_way_of_a_link_is_named(tmp_path):
    write_rgb(tmp_path / "a.png", np.zeros((4, 4, 3), np.uint8))
    camera = Camera(torch.tensor([[4.0, 0, 2], [0, 4, 2], [0, 0, 1]]), torch.eye(4), 4, 4)
    (tmp_path / "out" / "photographs").mkdir(parents=True)
    with pytest.raises(InputError, match="is in the way of a link to"):
        write_posed_photographs(tmp_path / "out", [View("a", camera, tmp_path / "a.png")])
    assert not (tmp_path / "out" / "transforms.json").exists()


@pytest.mark.parametrize("sizes", [[], [(4, 4), (4, 5)]])
def test_cameras_of_a_sequence_have_one_size(tmp_path, sizes):
    views = [SimpleNamespace(camera=SimpleNamespace(size=size)) for size in sizes]
    with pytest.raises(InputError, match="needs views, all of one size"):
        write_meta(tmp_path / "meta.json", views, 2)


@pytest.mark.parametrize(("ids", "fine"), [([5, 3, 8], True), ([5, 3, 5], False), ([5, 5, 5], False)])
def test_ids_name_one_gaussian_each(tmp_path, ids, fine):
    write_ply(gaussians(3), tmp_path / "a.ply")
    rows = PlyData.read(str(tmp_path / "a.ply"))["vertex"].data
    named = np.empty(3, dtype=[*rows.dtype.descr, ("id", "<i4")])
    for column in rows.dtype.names:
        named[column] = rows[column]
    named["id"] = ids
    PlyData([PlyElement.describe(named, "vertex")]).write(str(tmp_path / "b.ply"))
    if fine:
        assert load_sequence(tmp_path / "b.ply").frame(0).ids.tolist() == ids
        return
    with pytest.raises(InputError, match="names a Gaussian twice"):
        load_sequence(tmp_path / "b.ply").frame(0)


def test_arrays_in_the_order_of_fortran_are_refused(tmp_path):
    arrays = {
        "means3D": np.asfortranarray(np.ones((2, 3, 3), np.float32)),
        "rgb_colors": np.ones((2, 3, 3), np.float32),
        "unnorm_rotations": np.ones((2, 3, 4), np.float32),
        "logit_opacities": np.ones((3, 1), np.float32),
        "log_scales": np.ones((3, 3), np.float32),
    }
    np.savez(tmp_path / "params.npz", **arrays)
    with pytest.raises(InputError, match="array 'means3D' is in Fortran order"):
        ParamsSequence(tmp_path / "params.npz")


@pytest.mark.parametrize(("red", "moves"), [(0.49, False), (0.51, True)])
def test_what_moves_is_red(tmp_path, red, moves):
    arrays = {
        "means3D": np.ones((2, 3, 3), np.float32),
        "rgb_colors": np.full((2, 3, 3), 0.75, np.float32),
        "unnorm_rotations": np.ones((2, 3, 4), np.float32),
        "logit_opacities": np.full((3, 1), np.log(3.0), np.float32),
        "log_scales": np.full((3, 3), np.log(0.2), np.float32),
        "seg_colors": np.full((3, 3), red, np.float32),
    }
    np.savez(tmp_path / "params.npz", **arrays)
    frame = ParamsSequence(tmp_path / "params.npz").frame(1)
    assert frame.foreground.tolist() == [moves] * 3
    torch.testing.assert_close(frame.gaussians.opacities, torch.full((3,), 0.75))
    torch.testing.assert_close(frame.gaussians.scales, torch.full((3, 3), 0.2))
    torch.testing.assert_close(frame.gaussians.sh, torch.full((3, 1, 3), 0.25 * 2 * float(np.sqrt(np.pi))))
