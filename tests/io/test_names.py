"""Names that a data set lists lead into it, or nowhere."""

import json
import logging

import cv2
import numpy as np
import pytest

from sgwarp.errors import InputError
from sgwarp.io.moving_views import load_moving_views
from sgwarp.io.names import inside
from sgwarp.io.points import load_points
from sgwarp.io.views import load_views


@pytest.mark.parametrize("name", ["a.png", "images/a.png", "./a.png", "images/../a.png", "x\\a.png", "..a/b.png"])
def test_names_inside_are_followed(tmp_path, name):
    assert inside("list", tmp_path, name) == tmp_path / name.replace("\\", "/")


@pytest.mark.parametrize("name", ["/etc/a.png", "../a.png", "images/../../a.png", "..\\a.png", "a/../../b/../../c.png"])
def test_names_outside_are_followed_only_when_allowed(tmp_path, monkeypatch, caplog, name):
    with pytest.raises(InputError, match="lies outside the data set; move it, or set SGWARP_OUTSIDE=1"):
        inside("list", tmp_path, name)
    monkeypatch.setenv("SGWARP_OUTSIDE", "1")
    with caplog.at_level(logging.WARNING, logger="sgwarp"):
        assert inside("list", tmp_path, name) == tmp_path / name.replace("\\", "/")
    assert "lies outside the data set, and is read" in caplog.text


def nerfstudio(folder, name: str, **more) -> None:
    folder.mkdir(exist_ok=True)
    frame = {"file_path": name, "transform_matrix": np.eye(4).tolist()}
    meta = {"fl_x": 20, "w": 16, "h": 12, "frames": [frame], **more}
    (folder / "transforms.json").write_text(json.dumps(meta))


def test_a_photograph_outside(tmp_path, monkeypatch):
    cv2.imwrite(str(tmp_path / "secret.png"), np.zeros((12, 16, 3), np.uint8))
    nerfstudio(tmp_path / "data", "../secret.png")
    with pytest.raises(InputError, match=r"'\.\./secret\.png' lies outside"):
        load_views(tmp_path / "data")
    assert load_views(tmp_path / "data", photographs=False)[0].image_path is None
    monkeypatch.setenv("SGWARP_OUTSIDE", "1")
    assert load_views(tmp_path / "data")[0].image().shape == (12, 16, 3)


def test_a_photograph_of_colmap_outside(tmp_path):
    (tmp_path / "data" / "images").mkdir(parents=True)
    (tmp_path / "data" / "cameras.txt").write_text("1 PINHOLE 16 12 20 20 8 6\n")
    (tmp_path / "data" / "images.txt").write_text("1 1 0 0 0 0 0 1 1 ../../secret.png\n\n")
    cv2.imwrite(str(tmp_path / "secret.png"), np.zeros((12, 16, 3), np.uint8))
    with pytest.raises(InputError, match=r"'\.\./\.\./secret\.png' lies outside"):
        load_views(tmp_path / "data")


def test_points_outside(tmp_path):
    nerfstudio(tmp_path / "data", "a.png", ply_file_path="/etc/passwd")
    with pytest.raises(InputError, match="'/etc/passwd' lies outside"):
        load_points(tmp_path / "data")


def test_a_name_that_would_clear_a_terminal(tmp_path):
    nerfstudio(tmp_path / "data", "\x1b[2J\nsgwarp: done.png")
    with pytest.raises(InputError) as caught:
        load_views(tmp_path / "data")
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("size", ["1099511627776 1099511627776", "9223372036854775807 1", "65536 65536"])
def test_sizes_that_no_kernel_counts(tmp_path, size):
    (tmp_path / "cameras.txt").write_text(f"1 PINHOLE {size} 20 20 8 6\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 1 1 a.png\n\n")
    with pytest.raises(InputError, match=r"camera 1: image size: .* is more than 2147483647 pixels"):
        load_views(tmp_path, photographs=False)


@pytest.mark.parametrize("name", ["../secret.png", "/etc/secret.png", "0/../../secret.png"])
def test_a_photograph_of_a_moving_scene_outside(tmp_path, monkeypatch, name):
    """Whether the photographs are read or not: label images are looked for under the same name."""
    pose = np.eye(4).tolist()
    meta = {"w": 16, "h": 12, "k": [[np.diag([20.0, 20.0, 1.0]).tolist()]], "w2c": [[pose]], "fn": [[name]]}
    (tmp_path / "ims").mkdir()
    (tmp_path / "train_meta.json").write_text(json.dumps(meta | {"cam_id": [[0]]}))
    cv2.imwrite(str(tmp_path / "secret.png"), np.zeros((12, 16, 3), np.uint8))
    for photographs in (True, False):
        with pytest.raises(InputError, match="lies outside the data set"):
            load_moving_views(tmp_path, photographs=photographs).at(0)
    monkeypatch.setenv("SGWARP_OUTSIDE", "1")
    assert load_moving_views(tmp_path).at(0)[0].file == name
