"""What was made of photographs as stored is turned and undistorted with them, unless it is straight already."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from sgwarp.encoders.maps.files import FileMaps
from sgwarp.encoders.masks.files import FileMasks
from sgwarp.encoders.registry import make_encoder
from sgwarp.errors import InputError
from sgwarp.io.undistort import Lens, Undistortion
from sgwarp.scene import Camera, View

HEIGHT, WIDTH = 48, 64


def make_view(undistort) -> View:
    K = torch.tensor([[50.0, 0, WIDTH / 2], [0, 50.0, HEIGHT / 2], [0, 0, 1]])
    return View("a", Camera(K, torch.eye(4), WIDTH, HEIGHT), undistort=undistort)


@pytest.fixture
def turned() -> View:
    """Of a camera held upright: to be seen as it was taken, the stored photograph is turned clockwise (EXIF's 6)."""
    lens = Lens(50.0, 50.0, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)
    return make_view(Undistortion(lens, Path("a.jpg"), 6))


def lying(upright: np.ndarray) -> np.ndarray:
    """As the camera stored it."""
    return np.ascontiguousarray(np.rot90(upright, 1))


class Shift:
    """Stands for an undistortion: moves everything one pixel to the right, and remembers how it was asked."""

    def __init__(self) -> None:
        self.nearest: list[bool] = []

    def __call__(self, pixels):
        raise AssertionError("for photographs")

    def carry(self, array, nearest):
        self.nearest.append(nearest)
        return np.roll(array, 1, axis=1)


def write_labels(folder: Path) -> np.ndarray:
    ids = np.random.default_rng(0).choice([0, 3, 7], size=(HEIGHT, WIDTH)).astype(np.uint8)
    cv2.imwrite(str(folder / "a.png"), ids)
    return ids


def test_label_images(tmp_path, turned):
    ids = write_labels(tmp_path)
    cv2.imwrite(str(tmp_path / "a.png"), lying(ids))
    found = FileMaps(tmp_path, [turned]).encode(turned)
    assert found.ids[0].tolist() == np.select([ids == 3, ids == 7], [0, 1], -1).tolist()
    with pytest.raises(InputError, match="is 48 x 64, not the shape of view a"):
        make_encoder(f"files:{tmp_path}?straight=yes", [turned]).encode(turned, None)


@pytest.mark.parametrize("layout", [None, "chw", "hwc"])
def test_features(tmp_path, turned, layout):
    features = np.random.default_rng(1).normal(size=(12, 16, 5)).astype(np.float16)
    valid = np.random.default_rng(2).random((12, 16)) < 0.5
    stored = lying(features)
    stored = stored.transpose(2, 0, 1) if layout == "chw" else stored
    np.savez(tmp_path / "a.npz", features=stored, valid=lying(valid))
    found = FileMaps(tmp_path, [turned], layout=layout).encode(turned)
    assert found.dense.tolist() == features.tolist()
    assert found.dense.dtype == torch.float16
    assert found.valid.tolist() == valid.tolist()
    with pytest.raises(InputError, match=r"does not have the shape of the view, 48 x 64"):
        FileMaps(tmp_path, [turned], layout=layout, straight=True)


@pytest.mark.parametrize("layout", ["chw", "hwc"])
def test_features_that_are_upright_already(tmp_path, turned, layout):
    features = np.random.default_rng(1).normal(size=(12, 16, 5)).astype(np.float32)
    np.save(tmp_path / "a.npy", features.transpose(2, 0, 1) if layout == "chw" else features)
    for straight in (False, True):
        found = FileMaps(tmp_path, [turned], straight=straight).encode(turned)
        assert found.dense.tolist() == features.tolist()
        assert found.valid is None


def test_features_of_feature_3dgs_have_their_channels_first(tmp_path, turned):
    features = np.random.default_rng(1).normal(size=(48, 64, 48)).astype(np.float32)
    stored = torch.from_numpy(np.ascontiguousarray(lying(features).transpose(2, 0, 1)))
    torch.save(stored, tmp_path / "a_fmap_CxHxW.pt")  # 48 x 64 x 48: the shape would fit both ways
    assert FileMaps(tmp_path, [turned]).encode(turned).dense.tolist() == features.tolist()


def test_levels(tmp_path, turned):
    ids = np.random.default_rng(3).integers(-1, 6, size=(2, HEIGHT, WIDTH)).astype(np.int32)
    np.save(tmp_path / "a_s.npy", np.stack([lying(level) for level in ids]))
    np.save(tmp_path / "a_f.npy", np.eye(6, dtype=np.float32))
    assert FileMaps(tmp_path, [turned]).encode(turned).ids.tolist() == ids.tolist()


@pytest.mark.parametrize("kind", ["labels", "dense", "levels"])
@pytest.mark.parametrize("straight", ["", "?straight=no", "?straight=yes"])
def test_features_are_interpolated_and_ids_are_not(tmp_path, kind, straight):
    view = make_view(Shift())
    features, valid = np.random.default_rng(1).normal(size=(12, 16, 5)), np.arange(192).reshape(12, 16) % 3 > 0
    ids = np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH) % 3
    if kind == "labels":
        ids = write_labels(tmp_path) // 4  # 0, 3, 7: none, first, second
        cv2.imwrite(str(tmp_path / "a.png"), (ids + 1).astype(np.uint8))
    elif kind == "dense":
        np.savez(tmp_path / "a.npz", features=features.astype(np.float32), valid=valid)
    else:
        np.save(tmp_path / "a_s.npy", ids[None])
        np.save(tmp_path / "a_f.npy", np.eye(3))
    source = make_encoder(f"files:{tmp_path}{straight}", [view])
    view.undistort.nearest.clear()
    found = source.encode(view, None)
    shift = 0 if straight == "?straight=yes" else 1
    if kind == "dense":
        assert found.dense.tolist() == np.roll(features.astype(np.float32), shift, axis=1).tolist()
        assert found.valid.tolist() == np.roll(valid, shift, axis=1).tolist()
    else:
        assert found.ids[0].tolist() == np.roll(ids, shift, axis=1).tolist()
    wanted = {"dense": [False, True]}.get(kind, [True])
    assert view.undistort.nearest == (wanted if shift else [])


class Refusing(Shift):
    def carry(self, array, nearest):
        raise InputError("not the shape of the photograph")


def test_refusals_name_the_file(tmp_path):
    view = make_view(Refusing())
    write_labels(tmp_path)
    with pytest.raises(InputError, match=r"a\.png: not the shape of the photograph"):
        FileMaps(tmp_path, [view]).encode(view)
    with pytest.raises(InputError, match=r"a\.png: not the shape of the photograph"):
        FileMasks(tmp_path, [view]).everything(view, torch.zeros(HEIGHT, WIDTH, 3))


@pytest.mark.parametrize("suffix", [".png", ".npz"])
def test_masks(tmp_path, turned, suffix):
    ids = np.random.default_rng(0).choice([0, 3, 7], size=(HEIGHT // 2, WIDTH // 2)).astype(np.uint8)
    masks = np.stack([ids == 3, ids == 7])
    if suffix == ".png":
        cv2.imwrite(str(tmp_path / "a.png"), lying(ids))
    else:
        np.savez(tmp_path / "a.npz", masks=np.stack([lying(mask) for mask in masks]).astype(np.uint8))
    found = FileMasks(tmp_path, [turned]).everything(turned, torch.zeros(HEIGHT, WIDTH, 3))
    assert found.masks.tolist() == masks.tolist()
    assert (found.scores.tolist(), found.ranks.tolist()) == ([1.0, 1.0], [-1, -1])
