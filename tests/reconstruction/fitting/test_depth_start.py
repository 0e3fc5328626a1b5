"""Depth to start from: the unit that fits the poses, and views without any."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.reconstruction.depth import gaussians_from_depth
from sgwarp.reconstruction.depth_unit import measure_depth_unit, shrink_depth
from sgwarp.reconstruction.fitting.belongings import depth_from_folder, depth_of_views
from sgwarp.reconstruction.fitting.depth_start import usable_depth
from sgwarp.scene import Camera, View
from sgwarp.scene.extent import camera_extent


@pytest.fixture(scope="module")
def views():
    """Twelve cameras on a ring, that look across a room of 4 x 4 x 4 m, turned so that no wall faces one."""
    made = []
    for index, angle in enumerate(np.arange(12) * 2 * math.pi / 12 + 0.2):
        place = np.array([1.2 * math.cos(angle), 1.2 * math.sin(angle), 0.3 * math.sin(3 * angle)])
        forward = -place + np.array([0.3 * math.sin(angle), 0.0, 0.2])
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
        pose[:3, 3] = -pose[:3, :3] @ place
        K = torch.tensor([[40.0, 0.0, 32.0], [0.0, 40.0, 24.0], [0.0, 0.0, 1.0]])
        made.append(View(f"{index:04d}", Camera(K, torch.from_numpy(pose), 64, 48)))
    return made


def depth(view):
    """Along the optical axis, from where the ray of a pixel meets the nearest wall [m], [H, W]."""
    x, y = np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5)
    pose = view.camera.world_to_camera.numpy()
    rays = np.stack([(x - 32) / 40, (y - 24) / 40, np.ones_like(x)], axis=-1) @ pose[:3, :3]
    place = view.camera.position.numpy()
    return (np.where(rays > 0, 2 - place, -2 - place) / rays).min(axis=-1)


def grey(view):
    return np.full((*view.camera.size, 3), 0.5, np.float32)


@pytest.mark.parametrize("unit", [1.0, 1000.0, 0.001, 1 / 6553.5, 3.28084])
def test_the_unit_is_measured(views, unit):
    small = [shrink_depth(depth(view) / unit, view.camera) for view in views]
    found = measure_depth_unit(*zip(*small, strict=True), camera_extent(views))
    assert found.factor == pytest.approx(unit, rel=0.01)
    assert found.agreement > 0.9
    if unit in (1.0, 1000.0, 0.001):
        assert found.factor == unit  # a round number is meant to be just that


def test_where_another_unit_is_as_good_the_one_given_counts(boards):
    """Boards that face the cameras look alike at 0.95 times their depth."""
    of_view = depth_from_folder(boards.folder / "depth", boards.views)
    small = [shrink_depth(of_view(view), view.camera) for view in boards.views]
    assert measure_depth_unit(*zip(*small, strict=True), camera_extent(boards.views)).factor == 1


def test_no_other_unit_is_believed_that_is_hardly_better(views):
    """The same depth in every pixel is wrong in all views; far away, without parallax, it agrees a little more."""
    small = [shrink_depth(np.full(view.camera.size, 3.0), view.camera) for view in views]
    found = measure_depth_unit(*zip(*small, strict=True), camera_extent(views))
    assert found.factor == 1
    assert found.agreement == found.as_given < 0.2


def test_views_that_share_nothing_say_nothing_of_the_unit(views, caplog):
    found = usable_depth("depth", depth, views[:1])
    assert "depth: too little of one view shows in others to check the unit" in caplog.text
    np.testing.assert_array_equal(found(views[0]), depth(views[0]).astype(np.float32))


def test_depth_in_another_unit_starts_the_same_scene(views, caplog):
    same, other = (
        gaussians_from_depth(views, usable_depth("depth", of_view, views), grey, count=900)
        for of_view in (depth, lambda view: depth(view) * 1000)
    )
    assert "depth: depth and poses are in different units: at 0.001 times the depth" in caplog.text
    assert len(same) == len(other)
    np.testing.assert_allclose(same.means, other.means, atol=1e-5)


def test_depth_that_no_unit_makes_right_is_refused(views):
    """Of a network that guesses, each view at a scale of its own."""
    scales = dict(zip((view.stem for view in views), np.geomspace(0.3, 3, len(views)), strict=True))
    with pytest.raises(InputError, match="depth: the views contradict each other: in no unit more than"):
        usable_depth("depth", lambda view: depth(view) * scales[view.stem], views)


def test_views_without_depth_have_none(views, tmp_path, caplog):
    (tmp_path / "0000.npy").write_bytes(b"no array")
    for view in views[2:]:
        np.save(tmp_path / f"{view.stem}.npy", depth(view))
    found = usable_depth("depth", depth_from_folder(tmp_path, views), views)
    assert "depth: 2 of 12 views have no depth, first: " in caplog.text
    assert not found(views[1]).any()
    np.testing.assert_array_equal(found(views[2]), depth(views[2]).astype(np.float32))
    assert len(gaussians_from_depth(views, found, grey, count=900)) > 100
    with pytest.raises(InputError, match=r"0000\.npy: is not "):
        usable_depth("depth", depth_from_folder(tmp_path, views), views[:2])


def test_a_data_set_may_name_depth_of_some_views(boards):
    named = boards.folder / "depth/0003.npy"
    views = [replace(view, depth_path=named if view.stem == "0003" else None) for view in boards.views]
    of_view = depth_of_views(views)
    assert of_view is not None
    assert (of_view(views[3]) > 0).any()
    with pytest.raises(InputError, match="view 0000: the data set names no depth of it"):
        of_view(views[0])
    assert depth_of_views(boards.views) is None


def test_depth_that_is_roughly_right_stays_as_it_is_given():
    """One depth for all of a view fits better still from afar, where there is no parallax to contradict it."""
    cameras = []
    for x in np.linspace(-0.8, 0.8, 6):
        pose = torch.eye(4, dtype=torch.float64)
        pose[0, 3] = -x
        turned = torch.eye(4, dtype=torch.float64)
        angle = math.atan2(x, 3.3)
        turned[0, 0] = turned[2, 2] = math.cos(angle)
        turned[0, 2], turned[2, 0] = math.sin(angle), -math.sin(angle)
        cameras.append(Camera(torch.tensor([[40.0, 0, 32], [0, 40, 24], [0, 0, 1]]), turned @ pose, 64, 48))
    views = [View(str(index), camera) for index, camera in enumerate(cameras)]
    found = measure_depth_unit([np.full((48, 64), 3.0)] * 6, cameras, camera_extent(views))
    assert found.factor == 1
