"""Average precision against areas computed by hand and by another formula."""

import itertools
import math

import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.metrics.detection import Detections, masks_of


def line(*spans, length=20):
    masks = torch.zeros(len(spans), length, dtype=torch.bool)
    for row, (first, last) in enumerate(spans):
        masks[row, first:last] = True
    return masks


def test_by_hand():
    """Three true instances; surest first: right, wrong, right. Precision 1, 1/2, 2/3 at recall 1/3, 1/3, 2/3."""
    found = Detections()
    found.add(line((0, 4), (16, 20), (5, 9)), line((0, 4), (5, 9), (10, 14)), torch.tensor([0.9, 0.8, 0.7]))
    assert found.average_precision(0.5) == pytest.approx(1 / 3 * 1 + 1 / 3 * 2 / 3)


def test_a_true_instance_is_found_once():
    """The second prediction of the same object is wrong, even though it fits better."""
    found = Detections()
    found.add(line((0, 3), (0, 4)), line((0, 4)), torch.tensor([0.9, 0.5]))
    assert found.average_precision(0.5) == 1.0
    twice = Detections()
    twice.add(line((0, 4), (0, 4)), line((0, 4), (10, 14)), torch.tensor([0.9, 0.5]))
    assert twice.average_precision(0.5) == pytest.approx(0.5)


def test_the_threshold_is_strict_and_sizes_stand_in_for_scores():
    found = Detections()
    found.add(line((0, 2)), line((0, 4)))  # IoU 0.5
    assert found.average_precision(0.5) == 0.0
    assert found.average_precision(0.49) == 1.0
    larger_first = Detections()
    larger_first.add(line((0, 2), (5, 15)), line((0, 2)))
    assert larger_first.average_precision(0.5) == pytest.approx(0.5)


def test_what_lies_where_nothing_is_scored_does_not_count():
    """The surest prediction matches nothing, three quarters of it unscored: wrong only where more may lie outside."""
    found = Detections()
    ignored = torch.zeros(20, dtype=torch.bool)
    ignored[10:13] = True
    found.add(line((10, 14), (0, 4)), line((0, 4)), torch.tensor([0.9, 0.5]), ignored)
    assert found.average_precision(0.5) == 1.0
    assert found.average_precision(0.75) == pytest.approx(0.5)


def test_ids_of_two_images_never_meet():
    found = Detections()
    found.add(line((0, 4)), line(), torch.tensor([0.9]))
    found.add(line(), line((0, 4)))
    assert found.average_precision(0.5) == 0.0
    assert math.isnan(Detections().average_precision(0.5))


def by_definition(ious, scores, threshold):
    """Greedy matching in Python, then the sum over true instances of the best precision at that recall or more."""
    free, right = set(range(len(ious[0]))), []
    for row in sorted(range(len(scores)), key=lambda i: -scores[i]):
        best = max(free, key=lambda t: ious[row][t], default=None)
        hit = best is not None and ious[row][best] > threshold
        free -= {best} if hit else set()
        right.append(hit)
    precisions = list(itertools.accumulate(right))
    points = [(count / (k + 1), count / len(ious[0])) for k, count in enumerate(precisions)]
    total = 0.0
    for k in range(1, len(ious[0]) + 1):
        reached = [p for p, recall in points if recall >= k / len(ious[0]) - 1e-12]
        total += max(reached, default=0.0)
    return total / len(ious[0])


def test_against_the_definition():
    rng = torch.Generator().manual_seed(4)
    for _ in range(20):
        predicted, truth = (torch.rand(n, 12, generator=rng) > 0.5 for n in (7, 4))
        truth[:, 0] = True
        scores = torch.rand(7, generator=rng)
        ious = [[int((p & t).sum()) / int((p | t).sum()) for t in truth] for p in predicted]
        found = Detections()
        found.add(predicted, truth, scores)
        for threshold in (0.25, 0.5):
            assert found.average_precision(threshold) == pytest.approx(by_definition(ious, scores.tolist(), threshold))


def test_summary_and_masks():
    ids = torch.tensor([[0, 3, 3], [7, 7, 0]])
    masks = masks_of(ids)
    assert masks.shape == (2, 2, 3)
    assert masks[0].tolist() == [[False, True, True], [False, False, False]]
    found = Detections()
    found.add(masks, masks)
    figures = found.precision()
    assert (figures.ap, figures.ap50, figures.ap25) == pytest.approx((1.0, 1.0, 1.0))
    assert masks_of(torch.zeros(2, 2, dtype=torch.int64)).shape == (0, 2, 2)
    with pytest.raises(InputError, match="differ"):
        found.add(masks, masks[:, :1])
    with pytest.raises(InputError, match="scores"):
        found.add(masks, masks, torch.ones(5))
