"""The traps of the LERF-OVS scripts: even box, border, levels, equal maxima, stretch, majority near the edge."""

import cv2
import numpy as np
import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.metrics.relevancy_maps import box_filter, hits_any_box, locate, majority, to_mask


def test_the_box_is_the_one_of_opencv():
    """LangSplat calls filter2D with ones(30, 30) / 900 and the default border."""
    maps = torch.rand(3, 61, 83, generator=torch.Generator().manual_seed(1))
    kernel = np.ones((30, 30)) / 900
    for mine, one in zip(box_filter(maps), maps, strict=True):
        assert np.allclose(mine.numpy(), cv2.filter2D(one.numpy(), -1, kernel), atol=1e-6)


def test_an_even_box_reaches_further_left_and_up():
    one = torch.zeros(1, 90, 90)
    one[0, 45, 45] = 900.0
    spread = box_filter(one)[0]
    rows, columns = spread.nonzero(as_tuple=True)
    # A pixel sees 15 to the left and 14 to the right: a bright one is seen from 14 to its left and 15 to its right.
    assert (int(rows.min()), int(rows.max()), int(columns.min()), int(columns.max())) == (31, 60, 31, 60)
    assert torch.allclose(spread[31:61, 31:61], torch.ones(30, 30))


def test_the_border_is_mirrored_without_the_edge_pixel():
    """Side 4 at column 0 of 0, 1, 2, 3, ... takes columns -2 to 1, which are 2, 1, 0, 1."""
    ramp = torch.arange(8.0).repeat(5, 1)[None]
    assert float(box_filter(ramp, 4)[0, 2, 0]) == pytest.approx((2 + 1 + 0 + 1) / 4)
    assert float(box_filter(ramp, 4)[0, 2, 7]) == pytest.approx((5 + 6 + 7 + 6) / 4)
    narrow = torch.rand(1, 3, 1)
    assert np.allclose(box_filter(narrow, 4)[0], cv2.filter2D(narrow[0].numpy(), -1, np.ones((4, 4)) / 16), atol=1e-6)
    with pytest.raises(InputError, match="levels"):
        box_filter(ramp[0])


def test_the_level_with_the_highest_averaged_maximum_is_chosen():
    """A lone bright pixel has the highest value, but a patch has the higher mean."""
    maps = torch.zeros(2, 100, 100)
    maps[0, 20, 20] = 1.0
    maps[1, 60:80, 60:80] = 0.5
    found = locate(maps)
    assert found.level == 1
    x, y = found.pixels[0].tolist()
    assert 60 <= x <= 80
    assert 60 <= y <= 80
    assert locate(torch.stack([maps[1], maps[1]])).level == 0  # the first of equals


def test_several_best_pixels_and_any_of_them_may_hit():
    """Two equal patches far apart: the published script takes every pixel with the maximum."""
    maps = torch.zeros(1, 100, 120)
    maps[0, 5:35, 5:35] = 1.0
    maps[0, 60:90, 80:110] = 1.0
    found = locate(maps)
    # A window of 30 is filled at one place of each patch: from 15 before the pixel to 14 after.
    assert sorted(map(tuple, found.pixels.tolist())) == [(20, 20), (95, 75)]
    assert hits_any_box(found.pixels, torch.tensor([[90.0, 70.0, 100.0, 80.0]]))
    assert hits_any_box(found.pixels, torch.tensor([[0.0, 0.0, 1.0, 1.0], [20.0, 20.0, 20.0, 20.0]]))
    assert not hits_any_box(found.pixels, torch.tensor([[40.0, 0.0, 70.0, 99.0]]))


def test_corners_of_a_box_may_come_in_any_order():
    pixel = torch.tensor([[4, 7]])
    assert hits_any_box(pixel, torch.tensor([[9.0, 8.0, 4.0, 7.0]]))
    assert not hits_any_box(pixel, torch.tensor([[9.0, 8.0, 4.1, 7.0]]))


def slow_majority(mask, reach=3):
    """The published loops, window by window."""
    height, width = mask.shape
    result = np.zeros_like(mask)
    for i in range(height):
        for j in range(width):
            square = mask[
                max(0, i - reach) : min(i + reach + 1, height - 1), max(0, j - reach) : min(j + reach + 1, width - 1)
            ]
            result[i, j] = np.argmax(np.bincount(square.reshape(-1)))
    return result


@pytest.mark.parametrize("size", [(20, 31), (9, 6), (2, 5)])
def test_majority_against_loops(size):
    mask = (torch.rand(size, generator=torch.Generator().manual_seed(3)) > 0.5).numpy().astype(np.uint8)
    assert np.array_equal(majority(torch.from_numpy(mask).bool()).numpy(), slow_majority(mask).astype(bool))


def test_majority_ignores_the_last_row_and_column_and_ties_are_nothing():
    mask = torch.zeros(8, 8, dtype=torch.bool)
    mask[7] = True  # seen from nowhere
    assert not majority(mask).any()
    half = torch.zeros(4, 8, dtype=torch.bool)
    half[:, :2] = True  # at (0, 0): columns 0 to 3 of rows 0 to 2, half of them
    assert not majority(half)[0, 0]


def test_a_mask_is_what_exceeds_seven_tenths_of_the_range():
    """clip(2 m - 1) > 0.4 is m > 0.7, and a square blended with its box mean is that where 0.4 of the box is filled."""
    maps = torch.full((1, 90, 100), 0.2)
    maps[0, 20:60, 30:80] = 0.8
    columns = [sum(30 <= place < 80 for place in range(x - 15, x + 15)) / 30 for x in range(100)]
    rows = [sum(20 <= place < 60 for place in range(y - 15, y + 15)) / 30 for y in range(90)]
    square = [[20 <= y < 60 and 30 <= x < 80 for x in range(100)] for y in range(90)]
    above = [[square[y][x] and rows[y] * columns[x] > 0.4 for x in range(100)] for y in range(90)]
    mask, level = to_mask(maps)
    assert level == 0
    assert np.array_equal(mask.numpy(), slow_majority(np.array(above, dtype=np.uint8)).astype(bool))


def test_a_flat_map_has_an_empty_mask():
    mask, _ = to_mask(torch.full((2, 40, 40), 0.5))
    assert not mask.any()
