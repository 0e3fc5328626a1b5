"""Photographs with poses, written and read back."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.io.posed_photographs import write_posed_photographs
from sgwarp.io.views import load_views

WIDTH, HEIGHT = 32, 24
LENSES = [
    {},
    {"k1": -0.1, "k2": 0.02, "p1": 0.001, "p2": -0.002},
    {"camera_model": "FULL_OPENCV", "k1": 0.1, "k4": 0.2, "k5": -0.01, "k6": 0.003},
    {"camera_model": "OPENCV_FISHEYE", "k1": 0.02, "k2": -0.01, "k3": 0.003, "k4": -0.001},
    {"camera_model": "FOV", "omega": 0.4},
    {"camera_model": "THIN_PRISM_FISHEYE", "k1": 0.02, "sx1": 0.001, "sy1": -0.001},
]


@pytest.fixture
def photographs(tmp_path) -> Path:
    """Two photographs in folders, one with a mask and depth."""
    folder = tmp_path / "taken"
    rng = np.random.default_rng(0)
    for name in ("images/left/a.png", "images/right/b.png", "masks/a.png", "depth/a.png"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / name), rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8))
    return folder


def write(folder: Path, lens: dict) -> None:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(np.array([0.3, -0.2, 0.9]))[0], (1000.25, -2, 3)
    frames = [
        {"file_path": "images/left/a.png", "mask_path": "masks/a.png", "depth_file_path": "depth/a.png"},
        {"file_path": "images/right/b.png"},
    ]
    size = {"w": WIDTH, "h": HEIGHT, "fl_x": 30.0, "fl_y": 31.0, "cx": 15.0, "cy": 12.5}
    frames = [frame | {"transform_matrix": pose.tolist()} for frame in frames]
    meta = size | lens | {"frames": frames, "depth_unit_scale_factor": 0.002}
    (folder / "transforms.json").write_text(json.dumps(meta))


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: lens.get("camera_model", "OPENCV"))
def test_what_is_written_is_read_back(photographs, tmp_path, lens):
    write(photographs, lens)
    views = load_views(photographs)
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = torch.from_numpy(cv2.Rodrigues(np.array([0.0, 0.1, 0.0]))[0])
    moved = [replace(v, camera=replace(v.camera, world_to_camera=turn @ v.camera.world_to_camera)) for v in views]
    write_posed_photographs(tmp_path / "refined", moved)
    found = load_views(tmp_path / "refined")
    for view, back in zip(moved, found, strict=True):
        assert back.stem == view.stem
        torch.testing.assert_close(back.camera.K, view.camera.K, rtol=1e-12, atol=0)
        torch.testing.assert_close(back.camera.world_to_camera, view.camera.world_to_camera, rtol=0, atol=1e-10)
        assert torch.equal(back.image(), view.image())
        assert (back.mask_path is None) == (view.mask_path is None)
        assert (back.depth_path is None) == (view.depth_path is None)
    assert found[0].mask_path.samefile(views[0].mask_path)
    assert found[0].depth_path.samefile(views[0].depth_path)
    assert found[0].depth_unit == 0.002


def test_it_is_written_again(photographs, tmp_path):
    write(photographs, {})
    views = load_views(photographs)
    for some in (views, views[:1]):
        write_posed_photographs(tmp_path / "refined", some)
    assert len(load_views(tmp_path / "refined")) == 1


def test_what_cannot_be_written(photographs, tmp_path):
    write(photographs, {})
    views = load_views(photographs)
    with pytest.raises(InputError, match="view a has no photograph"):
        write_posed_photographs(tmp_path / "refined", [replace(views[0], image_path=None)])
    (tmp_path / "full" / "photographs").mkdir(parents=True)
    with pytest.raises(InputError, match="is in the way of a link"):
        write_posed_photographs(tmp_path / "full", views)
    assert not (tmp_path / "full" / "transforms.json").exists()
