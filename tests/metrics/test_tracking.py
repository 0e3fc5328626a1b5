"""Figures of tracking against values worked out by hand."""

import math

import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.metrics.tracking import (
    called_frames,
    identity_switches,
    matches,
    normalized_pixels,
    point_tracking,
    query_accuracy,
    video_iou,
)


def along(*errors: float) -> torch.Tensor:
    """One trajectory [T, 1, 2] that misses the origin by these distances, along a 3-4-5 direction."""
    return torch.tensor(errors)[:, None, None] * torch.tensor([0.6, 0.8])


def test_point_tracking_by_hand():
    # Mean errors 1, 3 and 12; the median is 3.
    predicted = torch.cat([along(0.5, 1.5), along(3.0, 3.0), along(4.0, 20.0)], dim=1)
    found = point_tracking(predicted, torch.zeros(2, 3, 2))
    assert found.median_error == pytest.approx(3.0)
    # Within 1: 1 of 6; 2: 2; 4: 4 (4.0 itself is not); 8: 5; 16: 5.
    assert found.delta == pytest.approx((1 + 2 + 4 + 5 + 5) / 30)
    assert found.survival == 1.0


def test_points_that_are_lost_or_hidden():
    predicted = torch.cat(
        [along(0.0, 60.0, 0.0, 0.0), along(2.5, math.nan, 2.5, 2.5), along(9.0, 9.0, 9.0, 9.0)], dim=1
    )
    visible = torch.ones(4, 3, dtype=torch.bool)
    visible[1, 1] = False  # where the second is NaN
    visible[:, 2] = False  # the third is never seen
    found = point_tracking(predicted, torch.zeros(4, 3, 2), visible)
    assert found.median_error == pytest.approx((15.0 + 2.5) / 2)
    assert found.survival == pytest.approx((1 / 4 + 1) / 2)
    assert found.delta == pytest.approx((3 + 3 + 6 + 6 + 6) / (5 * 7))


def test_nan_is_infinitely_far():
    found = point_tracking(along(math.nan, 0.0), torch.zeros(2, 1, 2))
    assert found.median_error == math.inf
    assert found.delta == 0.5
    assert found.survival == 0.0


def test_two_dimensional_thresholds_are_those_of_a_256_image():
    assert normalized_pixels(torch.tensor([[640.0, 90.0]]), 640, 360).tolist() == [[256.0, 64.0]]


def test_trajectories_must_fit():
    with pytest.raises(InputError, match="shape"):
        point_tracking(torch.zeros(2, 3, 2), torch.zeros(2, 4, 2))
    with pytest.raises(InputError, match="nothing is visible"):
        point_tracking(torch.zeros(2, 3, 2), torch.zeros(2, 3, 2), torch.zeros(2, 3, dtype=torch.bool))


def test_matches_take_the_largest_overlap():
    truth = torch.tensor([[1, 1, 1, 1, 2, 2, 3, 0]])
    found = torch.tensor([[7, 7, 7, 8, 8, 0, 0, 3]])
    assert matches(found, truth) == {1: 7}  # 2 with 8: 1 of 3 pixels
    assert matches(found, truth, least=0.3) == {1: 7, 2: 8}


def test_identity_switches_are_counted_when_the_object_comes_back():
    assert identity_switches([{1: 5, 2: 6}, {1: 5}, {1: 5, 2: 6}]) == 0
    assert identity_switches([{1: 5, 2: 6}, {1: 6}, {2: 5}, {1: 6, 2: 5}, {1: 5}]) == 3


def test_accuracy_over_time():
    scores = torch.tensor([0.1, 0.2, 0.7, 0.8, 0.2])  # mean 0.4
    assert called_frames(scores).tolist() == [False, False, True, True, False]
    assert query_accuracy(scores, torch.tensor([False, True, True, True, False])) == pytest.approx(0.8)
    assert query_accuracy(scores, torch.tensor([False, True, True, True, True]), threshold=0.15) == 1.0
    with pytest.raises(InputError, match="differ in length"):
        query_accuracy(scores, torch.tensor([True]))


def test_video_iou_by_hand():
    def mask(*pixels: int) -> torch.Tensor:
        return torch.tensor(pixels, dtype=torch.bool)

    predicted = [mask(1, 1, 0, 0), mask(0, 0, 0, 0), mask(1, 0, 0, 0), mask(0, 0, 0, 0)]
    truth = [mask(0, 1, 1, 0), mask(1, 1, 0, 0), mask(0, 0, 0, 0), mask(0, 0, 0, 0)]
    assert video_iou(predicted, truth) == pytest.approx((1 / 3 + 0 + 0) / 3)
    assert math.isnan(video_iou(truth[3:], truth[3:]))
    with pytest.raises(InputError, match="length"):
        video_iou(predicted, truth[:2])
