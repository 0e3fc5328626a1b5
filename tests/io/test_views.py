import json

import cv2
import numpy as np
import pytest

from sgwarp.errors import InputError
from sgwarp.io.views import load_views

POSE = [[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


def photograph(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.zeros((24, 32, 3), np.uint8))


def transforms(folder, stem, name="transforms.json"):
    photograph(folder / "images" / f"{stem}.png")
    frame = {"file_path": f"images/{stem}.png", "transform_matrix": POSE}
    (folder / name).write_text(json.dumps({"fl_x": 40.0, "w": 32, "h": 24, "frames": [frame]}))


def colmap(folder, stem, where="sparse/0"):
    photograph(folder / "images" / f"{stem}.png")
    (folder / where).mkdir(parents=True, exist_ok=True)
    (folder / where / "cameras.txt").write_text("1 PINHOLE 32 24 40 40 16 12\n")
    (folder / where / "images.txt").write_text(f"1 1 0 0 0 0 0 0 1 {stem}.png\n\n")


def stems(*args, **options):
    return [view.stem for view in load_views(*args, **options)]


def test_finds_every_layout(tmp_path):
    transforms(tmp_path / "a", "json")
    transforms(tmp_path / "b", "train", "transforms_train.json")
    transforms(tmp_path / "c", "other", "transforms_test.json")
    colmap(tmp_path / "d", "sparse0")
    colmap(tmp_path / "e", "sparse", "sparse")
    colmap(tmp_path / "f", "flat", ".")
    assert stems(tmp_path / "a") == stems(tmp_path / "a" / "transforms.json") == ["json"]
    assert stems(tmp_path / "b") == ["train"]
    assert stems(tmp_path / "c" / "transforms_test.json") == ["other"]
    assert stems(str(tmp_path / "d")) == stems(tmp_path / "d" / "sparse" / "0") == ["sparse0"]
    assert stems(tmp_path / "e") == ["sparse"]
    assert stems(tmp_path / "f") == ["flat"]


def test_transforms_come_before_colmap(tmp_path):
    colmap(tmp_path, "colmap")
    transforms(tmp_path, "train", "transforms_train.json")
    assert stems(tmp_path) == ["train"]
    transforms(tmp_path, "json")
    assert stems(tmp_path) == ["json"]


def test_the_same_camera_either_way(tmp_path):
    transforms(tmp_path / "a", "x")
    colmap(tmp_path / "b", "x")
    (a,), (b,) = load_views(tmp_path / "a"), load_views(tmp_path / "b")
    assert a.camera.K.tolist() == b.camera.K.tolist()
    assert a.camera.world_to_camera[2].tolist() == [0, 0, -1, 0]  # OpenGL looks along -z, OpenCV along z
    assert b.camera.world_to_camera[2].tolist() == [0, 0, 1, 0]


def test_image_folder(tmp_path):
    colmap(tmp_path, "x")
    (tmp_path / "images").rename(tmp_path / "photos")
    assert stems(tmp_path, image_folder="photos") == ["x"]
    assert stems(tmp_path) == ["x"]  # the only folder that holds them
    (tmp_path / "photos").rename(tmp_path / "emptied")
    for file in (tmp_path / "emptied").iterdir():
        file.unlink()
    with pytest.raises(InputError, match="no folder 'images' of photographs"):
        load_views(tmp_path)
    transforms(tmp_path, "x")
    with pytest.raises(InputError, match=r"transforms\.json: lists its photographs by path; --images is for COLMAP"):
        load_views(tmp_path, image_folder="photos")


def test_cameras_alone(tmp_path):
    for write, name in ((transforms, "a"), (colmap, "b")):
        write(tmp_path / name, "x")
        (tmp_path / name / "images" / "x.png").unlink()
        (view,) = load_views(tmp_path / name, photographs=False)
        assert view.image_path is None
        with pytest.raises(InputError, match="view x: has no photograph"):
            view.image()


def test_nothing_there(tmp_path):
    with pytest.raises(InputError, match=r"gone: no such file or folder"):
        load_views(tmp_path / "gone")
    with pytest.raises(
        InputError, match=r"holds no views; looked for transforms\.json, transforms_train\.json and .*sparse/0"
    ):
        load_views(tmp_path)
    (tmp_path / "scene.ply").write_bytes(b"ply\n\xff")
    with pytest.raises(InputError, match=r"scene\.ply: is no data set of posed photographs; give its folder"):
        load_views(tmp_path / "scene.ply")
