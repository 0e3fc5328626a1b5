"""A rectangle of the picture selects whole pixels, both its corners included."""

import pytest
import torch

from sgwarp.apps.editing.picker import EditState
from sgwarp.scene import Camera, Gaussians
from sgwarp.viewer.clicks import in_rectangle

CAMERA = Camera(torch.tensor([[10.0, 0, 0], [0, 10.0, 0], [0, 0, 1]]), torch.eye(4), 20, 16)


def state_at(places, depth: float = 2.0, opacity: float = 0.9) -> EditState:
    """Small Gaussians that are seen at places of the picture [pixels]."""
    means = torch.tensor([(x * depth / 10, y * depth / 10, depth) for x, y in places])
    count = len(means)
    quats = torch.tensor([1.0, 0, 0, 0]).expand(count, 4)
    shapes = torch.full((count, 3), 0.01), torch.full((count,), opacity), torch.zeros(count, 1, 3)
    none = torch.zeros(count, dtype=torch.int32)
    return EditState(Gaussians(means, quats, *shapes), torch.arange(count), none, none.bool())


@pytest.mark.parametrize("corners", [((3, 4), (5, 6)), ((5, 6), (3, 4)), ((3, 6), (5, 4))])
def test_pixels_of_both_corners_count(corners):
    """Pixels 3 to 5 across reach from 3 to 6, and 4 to 6 down from 4 to 7."""
    across = {2.9: False, 3.1: True, 5.1: True, 5.9: True, 6.1: False}
    down = {3.9: False, 4.1: True, 6.1: True, 6.9: True, 7.1: False}
    places = [(x, y) for x in across for y in down]
    chosen = in_rectangle(state_at(places), CAMERA, corners, through=True)
    assert chosen.tolist() == [across[x] and down[y] for x, y in places]


def test_one_pixel_is_a_rectangle():
    chosen = in_rectangle(state_at([(7.5, 8.5), (8.5, 8.5), (7.5, 9.5)]), CAMERA, ((7, 8), (7, 8)), through=True)
    assert chosen.tolist() == [True, False, False]


@pytest.mark.parametrize("depth", [-2.0, 2.0])
def test_what_lies_behind_the_camera_is_not_in_the_picture(depth):
    chosen = in_rectangle(state_at([(7.5, 8.5)], depth), CAMERA, ((0, 0), (19, 15)), through=True)
    assert chosen.tolist() == [depth > 0]
