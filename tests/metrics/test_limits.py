"""Scores have the thresholds of the papers that they come from, and count what lies on them as these do."""

import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.metrics.detection import THRESHOLDS, Detections
from sgwarp.metrics.overlap import DILATION, boundary
from sgwarp.metrics.relevancy_maps import LEVEL, MAJORITY, SIDE
from sgwarp.metrics.segmentation import ConfusionMatrix
from sgwarp.metrics.tracking import THRESHOLDS as DISTANCES
from sgwarp.metrics.tracking import matches, point_tracking


def test_thresholds_are_the_published_ones():
    assert pytest.approx((0.5, 0.55, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9)) == THRESHOLDS  # ScanNet's script
    assert DILATION == 0.02  # Cheng et al. 2021
    assert (SIDE, LEVEL, MAJORITY) == (30, 0.4, 3)  # LangSplat's release
    assert DISTANCES == (1, 2, 4, 8, 16)  # TAP-Vid


@pytest.mark.parametrize(("error", "survival"), [(49.9, 1.0), (50.0, 1.0), (50.1, 0.5)])
def test_a_point_is_lost_beyond_fifty(error, survival):
    predicted = torch.tensor([[0.0, 0.0], [error, 0.0]])[:, None]
    assert point_tracking(predicted, torch.zeros(2, 1, 2)).survival == survival


@pytest.mark.parametrize(("shared", "found"), [(5, {1: 7}), (4, {})])
def test_half_an_overlap_is_a_match(shared, found):
    truth, predicted = torch.zeros(12, dtype=torch.int64), torch.zeros(12, dtype=torch.int64)
    truth[:10] = 1
    predicted[:shared] = 7
    assert matches(predicted, truth) == found


@pytest.mark.parametrize(("diagonal", "steps"), [((30, 40), 1), ((60, 80), 2), ((300, 400), 10)])
def test_a_boundary_is_a_fiftieth_of_the_diagonal_wide(diagonal, steps):
    mask = torch.ones(diagonal, dtype=torch.bool)
    inner = boundary(mask)[diagonal[0] // 2]
    assert inner.nonzero().flatten().tolist() == [*range(steps), *range(diagonal[1] - steps, diagonal[1])]


@pytest.mark.parametrize(("one", "other"), [(torch.float32, torch.int64), (torch.int64, torch.float32)])
def test_labels_are_whole_numbers(one, other):
    with pytest.raises(InputError, match="expected integer labels"):
        ConfusionMatrix.empty(2).add(torch.zeros(2, 2, dtype=one), torch.zeros(2, 2, dtype=other))


def test_counts_are_copied_and_added():
    counts = torch.tensor([[3, 1, 0], [0, 2, 5]])
    one, two = ConfusionMatrix.of_counts(counts), ConfusionMatrix.of_counts(counts)
    one.merge(two)
    assert counts.tolist() == [[3, 1, 0], [0, 2, 5]]
    assert one.counts.tolist() == [[6, 2, 0], [0, 4, 10]]
    assert (one.unknown, one.pixel_accuracy) == (10 / 22, 10 / 22)
    assert one.iou.tolist() == pytest.approx([6 / 8, 4 / 16])
    assert one.frequency_weighted_iou == pytest.approx((8 * 6 / 8 + 14 * 4 / 16) / 22)
    for bad in (torch.zeros(2, 2), torch.zeros(2, 4), torch.zeros(3)):
        with pytest.raises(InputError, match=r"counts: expected shape \[Q, Q \+ 1\]"):
            ConfusionMatrix.of_counts(bad)


def test_a_prediction_where_nothing_is_scored_costs_nothing():
    detections = Detections()
    predicted = torch.tensor([[1, 1, 0, 0], [0, 0, 1, 1]]).bool()
    truth = torch.tensor([[1, 1, 0, 0]]).bool()
    detections.add(predicted, truth, torch.tensor([0.5, 0.9]), torch.tensor([0, 0, 1, 1]).bool())
    assert detections.precision().ap == 1.0
    other = Detections()
    other.add(predicted, truth, torch.tensor([0.5, 0.9]))
    assert other.precision().ap50 == pytest.approx(0.5)
