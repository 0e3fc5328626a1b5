"""Structure from motion through pycolmap, against cameras and surfaces that are known."""

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from sgwarp.cli import main
from sgwarp.errors import InputError
from sgwarp.files.images import write_rgb
from sgwarp.io.points import load_points
from sgwarp.io.views import load_views
from sgwarp.io.world import similarity_between
from sgwarp.reconstruction.sfm import features
from sgwarp.reconstruction.sfm.features import SfmSettings
from sgwarp.reconstruction.sfm.poses import estimate_poses
from sgwarp.reconstruction.sfm.triangulation import triangulate
from sgwarp.reconstruction.sfm.video import extract_frames

pytest.importorskip("pycolmap")


@pytest.fixture(scope="module")
def found(corner, tmp_path_factory):
    """What structure from motion makes of the corner and one photograph that shows nothing."""
    folder = tmp_path_factory.mktemp("photos")
    for path in corner[0].glob("*.png"):
        shutil.copy(path, folder / f"photo {path.name}")  # with a space, as cameras and people write them
    write_rgb(folder / "blank.png", np.full((192, 256, 3), 0.5))
    out = tmp_path_factory.mktemp("sfm")
    # With one thread COLMAP gives the same model each time.
    return folder, out, estimate_poses(folder, out, SfmSettings(threads=1))


def test_a_disk_without_room_is_said_before_the_library_ends_the_process(corner, tmp_path, monkeypatch):
    """COLMAP aborts where its database cannot grow."""
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=40 * 2**20))
    with pytest.raises(InputError, match=r"database\.db: the disk has 40 MB left and structure from motion needs 4\d"):
        estimate_poses(corner[0], tmp_path / "out")
    assert not (tmp_path / "out" / "sparse").exists()


@pytest.mark.slow
def test_poses_are_those_of_the_cameras_up_to_a_similarity(corner, found):
    _, out, registration = found
    assert len(registration.registered) == 8
    assert registration.error < 1
    views = load_views(out)
    assert [view.stem for view in views] == [f"photo {view.stem}" for view in corner[1]]
    ours, truth = (np.stack([v.camera.position.numpy() for v in group]) for group in (views, corner[1]))
    matrix = similarity_between(ours, truth)
    assert np.linalg.norm(ours @ matrix[:3, :3].T + matrix[:3, 3] - truth, axis=1).max() < 0.05
    x, _, z = (load_points(out)[0] @ matrix[:3, :3].T + matrix[:3, 3]).T
    assert np.median(np.abs(z - 3 - np.abs(x))) < 0.04  # a hundredth of the distance, some 4 m


def test_a_photograph_without_pose_is_named_with_the_reason(found):
    _, out, registration = found
    assert registration.left_out == {"blank.png": "only 0 features: blurred, dark, or of something even"}
    assert "8 of 9 photographs have poses" in registration.summary()
    assert json.loads((out / "sfm.json").read_text())["left_out"] == registration.left_out
    assert not (out / "database.db").exists()


def test_a_model_of_the_same_photographs_is_kept(found):
    folder, out, registration = found
    before = (out / "sparse/0/points3D.bin").stat().st_mtime_ns
    assert estimate_poses(folder, out, SfmSettings(threads=1)) == registration
    assert (out / "sparse/0/points3D.bin").stat().st_mtime_ns == before


def test_too_few_photographs_are_refused(tmp_path, capsys):
    write_rgb(tmp_path / "a.png", np.zeros((8, 8, 3)))
    assert main(["poses", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert "holds 1 photographs; structure from motion needs at least 3" in capsys.readouterr().err


def test_photographs_that_colmap_cannot_read_are_named(tmp_path):
    for index in range(4):
        (tmp_path / "in").mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / f"in/{index}.webp"), np.full((24, 32, 3), index, np.uint8))
    with pytest.raises(InputError, match=r"0\.webp: needs another format: COLMAP reads no webp, .* \(4 of 4 photog"):
        estimate_poses(tmp_path / "in", tmp_path / "out")


def test_photographs_that_do_not_overlap_are_refused(tmp_path):
    for index in range(3):
        write_rgb(tmp_path / "in" / f"{index}.png", np.random.default_rng(index).random((96, 128, 3)))
    with pytest.raises(InputError, match="no two photographs overlap enough to place them"):
        estimate_poses(tmp_path / "in", tmp_path / "out")


@pytest.mark.parametrize(("one_camera", "cameras"), [(True, [0, 0, 0, 1]), (False, [0, 1, 2, 3])])
def test_photographs_of_one_size_share_a_camera_however_few_are_read_at_once(
    tmp_path, monkeypatch, one_camera, cameras
):
    import pycolmap

    monkeypatch.setattr(features, "PHOTOGRAPHS_AT_ONCE", 1)
    for index, width in enumerate((64, 64, 64, 80)):
        write_rgb(tmp_path / f"{index}.png", np.random.default_rng(index).random((48, width, 3)))
    names = [f"{index}.png" for index in range(4)]
    database = tmp_path / "d.db"
    features.extract_features(
        database, tmp_path, names, SfmSettings(one_camera=one_camera, threads=1), lambda *progress: None
    )
    data = pycolmap.Database.open(database)
    camera_of = {image.name: image.camera_id for image in data.read_all_images()}
    data.close()
    found = [camera_of[name] for name in names]
    assert [sorted(set(found)).index(camera) for camera in found] == cameras


@pytest.mark.slow
def test_points_are_triangulated_with_the_given_poses_far_from_the_origin(corner):
    shift = torch.tensor([5e6, 0.0, 5e6], dtype=torch.float64)
    views = []
    for view in corner[1]:
        pose = view.camera.world_to_camera.clone()
        pose[:3, 3] -= pose[:3, :3] @ shift
        views.append(replace(view, camera=replace(view.camera, world_to_camera=pose)))
    positions, colors = triangulate(views)
    x, _, z = (positions - shift.numpy()).T
    assert len(positions) > 300
    assert np.median(np.abs(z - 3 - np.abs(x))) < 0.01
    assert colors.min() >= 0
    assert colors.std() > 0.05


@pytest.mark.slow
def test_wrong_poses_leave_no_points_and_are_named(corner, caplog):
    order = (3, 0, 6, 1, 7, 4, 2, 5)
    wrong = [replace(view, camera=corner[1][other].camera) for view, other in zip(corner[1], order, strict=True)]
    assert len(triangulate(wrong)[0]) == 0
    assert "the poses contradict the photographs" in caplog.text


def test_the_sharpest_of_every_few_frames_is_kept(corner, tmp_path):
    video = tmp_path / "walk.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*"MJPG"), 10, (256, 192))
    assert writer.isOpened()
    for view in corner[1]:
        frame = cv2.imread(str(view.image_path))
        for blurred in (True, False, True):
            writer.write(cv2.GaussianBlur(frame, (15, 15), 5) if blurred else frame)
    writer.release()
    assert extract_frames(video, tmp_path / "frames", every=3) == 8
    for view in corner[1]:
        kept = cv2.imread(str(tmp_path / "frames" / f"{int(view.stem):05d}.jpg")).astype(float)
        sharp = cv2.imread(str(view.image_path))
        blurred = cv2.GaussianBlur(sharp, (15, 15), 5)
        assert np.abs(kept - sharp).mean() < 0.7 * np.abs(kept - blurred).mean()
    (tmp_path / "no.mp4").write_bytes(b"no video")
    with pytest.raises(InputError, match=r"no\.mp4: 0 frames can be read"):
        extract_frames(tmp_path / "no.mp4", tmp_path / "none")
    assert not (tmp_path / "none").exists()


@pytest.mark.slow
def test_photographs_become_a_scene_in_one_command(found, tmp_path, capsys):
    folder, made, _ = found
    shutil.copytree(made, tmp_path / "scene.ply.sfm", symlinks=True)
    out = tmp_path / "scene.ply"
    assert main(["fit", str(folder), "--out", str(out), "--steps", "2", "--cap", "800", "--downscale", "2"]) == 0
    log = json.loads((tmp_path / "run.json").read_text())
    assert {"held_out_psnr", "fitted_psnr", "overfitting_gap", "reprojection_error"} <= set(log["error"])
    assert (tmp_path / "scene.ply.sfm/sparse/0/images.bin").is_file()
    assert "8 of 9 photographs have poses" in capsys.readouterr().err


def test_panoramas_are_left_out_with_the_remedy(tmp_path):
    """COLMAP would take them for what one lens sees."""
    xmp = b"http://ns.adobe.com/xap/1.0/\0<GPano:ProjectionType>equirectangular</GPano:ProjectionType>"
    for index in range(3):
        path = tmp_path / f"in/{index}.jpg"
        path.parent.mkdir(exist_ok=True)
        cv2.imwrite(str(path), np.full((32, 64, 3), index, np.uint8))
        plain = path.read_bytes()
        path.write_bytes(plain[:2] + b"\xff\xe1" + (len(xmp) + 2).to_bytes(2, "big") + xmp + plain[2:])
    with pytest.raises(
        InputError, match=r"0\.jpg: is a panorama \(equirect.*; cut the panoramas into .* \(3 of 3 photog"
    ):
        estimate_poses(tmp_path / "in", tmp_path / "out")
