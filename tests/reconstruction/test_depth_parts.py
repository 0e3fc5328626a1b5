"""Windows, slopes and cells of depth images, each at the values where it changes."""

import inspect

import numpy as np
import pytest
import torch

from sgwarp.reconstruction.depth import _Grid, gaussians_from_depth
from sgwarp.reconstruction.rgbd import observe
from sgwarp.scene import Camera, View


def camera(width: int, height: int, focal: float = 100.0) -> Camera:
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Camera(K, torch.eye(4, dtype=torch.float64), width, height)


@pytest.mark.parametrize("upright", [True, False])
def test_windows_end_at_edges_of_color_in_either_direction(upright):
    rgb = np.full((40, 40, 3), 0.5, np.float32)
    rgb[:, 20:] = 0.8
    if upright:
        rgb = rgb.transpose(1, 0, 2).copy()
    uniform = observe(camera(40, 40), np.full((40, 40), 2.0, np.float32), rgb).uniform.reshape(40, 40)
    line = uniform.T if upright else uniform
    expected = [1, 2, 4, 4, 8, 8, 8, 8, 16, 16]  # by the distance from the edge: windows of 2, 4, 8 and 16
    assert line[:, 19:9:-1].tolist() == [expected] * 40


@pytest.mark.parametrize(("side", "largest"), [(3, 2), (8, 4), (9, 8), (16, 8), (17, 16), (33, 32)])
def test_windows_are_smaller_than_the_image(side, largest):
    rgb = np.full((side, 40, 3), 0.5, np.float32)
    assert (observe(camera(40, side), np.full((side, 40), 2.0, np.float32), rgb).uniform == largest).all()


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(("footprints", "followed"), [(19.0, True), (21.0, False)])
def test_straight_slopes_are_followed_up_to_twenty_footprints(axis, footprints, followed):
    """Inverse depth that is linear in the pixels: in the middle, at a depth of 3, by so many footprints a pixel."""
    inverse = 1 / 3 + footprints / 300 * (np.arange(5.0) - 2)
    depth = np.tile(1 / inverse, (5, 1)).astype(np.float32)
    pixels = observe(camera(5, 5), depth if axis else depth.T.copy(), np.zeros((5, 5, 3), np.float32))
    change = (pixels.right if axis else pixels.down).reshape(5, 5, 3)[2, 2, 2]
    assert change == pytest.approx(-footprints * 3 / 100 if followed else 0, rel=1e-3)


def test_both_ways_to_a_scene_have_the_same_windows():
    ours, theirs = (inspect.signature(function).parameters for function in (observe, gaussians_from_depth))
    assert [ours[name].default for name in ("planarity", "contrast")] == [0.5, 0.12]
    assert [theirs[name].default for name in ("planarity", "contrast")] == [0.5, 0.12]


def test_cells_are_around_what_the_views_see():
    """From the corners of the images at the nearest and the farthest depth; as small as a 2^20th of the extent."""
    depth = np.full((20, 40), 2.0, np.float32)
    grid = _Grid.around([View("a", camera(40, 20))], lambda view: depth)
    np.testing.assert_allclose(grid.low, [-0.4, -0.2, 2.0])
    assert grid.cell == pytest.approx(0.02)
    depth[0, 0] = 5e6
    grid = _Grid.around([View("a", camera(40, 20))], lambda view: depth)
    np.testing.assert_allclose(grid.low, [-1e6, -5e5, 2.0])
    assert grid.cell == pytest.approx((5e6 - 2) / (2**20 - 1))  # along z; 2e6 along x


def test_levels_are_of_cells_that_are_not_smaller():
    grid = _Grid(np.zeros(3), 0.5)
    sizes = np.array([0.2, 0.5, 0.51, 1.0, 1.01, 2.0, 63.0, 64.0, 1e6])
    assert grid.level(sizes).tolist() == [0, 0, 1, 1, 2, 2, 7, 7, 7]
