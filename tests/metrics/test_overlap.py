"""Masks against masks counted by hand, and against OpenCV's erosion, which the published script uses."""

import math

import cv2
import numpy as np
import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.metrics.overlap import accuracy_at, boundary, boundary_iou, macro, mask_iou, mean, micro


def rectangle(height, width, top, bottom, left, right):
    mask = torch.zeros(height, width, dtype=torch.bool)
    mask[top:bottom, left:right] = True
    return mask


def test_iou_by_hand():
    one, other = rectangle(6, 8, 1, 4, 1, 5), rectangle(6, 8, 2, 5, 3, 7)  # 12 pixels each, 4 in common
    assert mask_iou(one, other) == 4 / 20
    assert mask_iou(one, one) == 1.0
    assert mask_iou(one, torch.zeros_like(one)) == 0.0
    assert math.isnan(mask_iou(torch.zeros_like(one), torch.zeros_like(one)))
    with pytest.raises(InputError, match="nearest"):
        mask_iou(one, rectangle(8, 6, 0, 1, 0, 1))


def test_boundary_is_a_frame_of_one_pixel_in_a_small_image():
    """The diagonal of 10 x 10 times 0.02 rounds to 0, and a boundary is at least one pixel wide."""
    mask = rectangle(10, 10, 2, 8, 2, 8)
    assert torch.equal(boundary(mask), mask & ~rectangle(10, 10, 3, 7, 3, 7))
    # Frames of 20 and 20 pixels; the second is shifted by one column: 2 rows of 5 columns and no column agree.
    assert boundary_iou(rectangle(10, 10, 2, 8, 3, 9), mask) == 10 / 30


def test_the_edge_of_the_image_is_a_boundary():
    mask = torch.ones(10, 10, dtype=torch.bool)
    assert torch.equal(boundary(mask), mask & ~rectangle(10, 10, 1, 9, 1, 9))


@pytest.mark.parametrize(("height", "width"), [(120, 160), (75, 50), (10, 10), (400, 30)])
def test_boundary_against_repeated_erosion(height, width):
    """The published script erodes by 3 x 3 as many times as the boundary is wide, with a frame of zeros around."""
    blobs = torch.nn.functional.interpolate(
        torch.rand(1, 1, 6, 6, generator=torch.Generator().manual_seed(height)), (height, width), mode="bilinear"
    )
    mask = blobs[0, 0] > 0.45
    steps = max(1, round(0.02 * math.hypot(height, width)))
    framed = cv2.copyMakeBorder(mask.numpy().astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    eroded = cv2.erode(framed, np.ones((3, 3), np.uint8), iterations=steps)[1:-1, 1:-1]
    assert 0 < int(mask.sum()) < mask.numel()
    assert np.array_equal(boundary(mask).numpy(), mask.numpy() & (eroded == 0))


def test_accuracy_at_a_threshold_is_strict():
    assert accuracy_at([0.25, 0.26, 0.1, math.nan], 0.25) == 0.25
    assert math.isnan(accuracy_at([], 0.5))


def test_macro_and_micro_differ_when_scenes_have_different_numbers_of_queries():
    """The headline of LERF-OVS is the mean of the scenes, not of the queries."""
    hits = {"figurines": [1.0] * 42 + [0.0] * 14, "waldo_kitchen": [1.0] * 20 + [0.0] * 2}
    assert macro(hits) == pytest.approx((42 / 56 + 20 / 22) / 2)
    assert micro(hits) == pytest.approx(62 / 78)
    assert mean([1.0, math.nan, 3.0]) == 2.0
    assert math.isnan(mean([math.nan]))
