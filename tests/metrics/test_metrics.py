"""Segmentation and localisation scores against sets of pixels counted by hand."""

import math

import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.metrics.localization import hits_box, hits_mask
from sgwarp.metrics.segmentation import ConfusionMatrix


def by_sets(predicted, truth, classes):
    """IoU and accuracy per class from Python sets, None where the class is not in the truth."""
    result = []
    scored = {i for i, t in enumerate(truth) if 0 <= t < classes}
    for k in range(classes):
        is_k = {i for i in scored if truth[i] == k}
        said_k = {i for i in scored if predicted[i] == k}
        result.append((len(is_k & said_k) / len(is_k | said_k), len(is_k & said_k) / len(is_k)) if is_k else None)
    return result


def test_against_sets_over_two_images():
    rng = torch.Generator().manual_seed(5)
    matrix = ConfusionMatrix.empty(4)
    predicted, truth = [], []
    for _ in range(2):
        p = torch.randint(-1, 6, (9, 11), generator=rng)
        t = torch.randint(0, 5, (9, 11), generator=rng)
        t[t == 2] = 255  # class 2 is not in the truth, though it is predicted
        matrix.add(p, t.to(torch.uint8))
        predicted += p.flatten().tolist()
        truth += t.flatten().tolist()
    expected = by_sets(predicted, truth, 4)
    present = [k for k in range(4) if expected[k] is not None]
    assert present == [0, 1, 3]
    assert matrix.present.tolist() == [True, True, False, True]
    for k in present:
        assert float(matrix.iou[k]) == pytest.approx(expected[k][0])
        assert float(matrix.accuracy[k]) == pytest.approx(expected[k][1])
    assert matrix.miou == pytest.approx(sum(expected[k][0] for k in present) / 3)
    assert matrix.macc == pytest.approx(sum(expected[k][1] for k in present) / 3)
    scored = [(p, t) for p, t in zip(predicted, truth, strict=True) if 0 <= t < 4]
    assert matrix.pixel_accuracy == pytest.approx(sum(p == t for p, t in scored) / len(scored))
    assert matrix.unknown == pytest.approx(sum(not 0 <= p < 4 for p, _ in scored) / len(scored))


def test_perfect_and_unknown():
    truth = torch.tensor([[0, 1], [1, 255]])
    perfect, blank = ConfusionMatrix.empty(2), ConfusionMatrix.empty(2)
    perfect.add(truth, truth)
    blank.add(torch.full_like(truth, 255), truth)
    assert (perfect.miou, perfect.macc, perfect.pixel_accuracy, perfect.unknown) == (1, 1, 1, 0)
    assert (blank.miou, blank.macc, blank.pixel_accuracy, blank.unknown) == (0, 0, 0, 1)


def test_nothing_scored_is_not_a_number():
    matrix = ConfusionMatrix.empty(2)
    matrix.add(torch.zeros(2, 2, dtype=torch.int64), torch.full((2, 2), 255))
    assert all(math.isnan(x) for x in (matrix.miou, matrix.macc, matrix.pixel_accuracy, matrix.unknown))


def test_refusals():
    matrix = ConfusionMatrix.empty(2)
    with pytest.raises(InputError, match="differ in size"):
        matrix.add(torch.zeros(2, 3, dtype=torch.int64), torch.zeros(3, 2, dtype=torch.int64))
    with pytest.raises(InputError, match="integer labels"):
        matrix.add(torch.zeros(2, 2), torch.zeros(2, 2, dtype=torch.int64))
    with pytest.raises(InputError, match="at least one"):
        ConfusionMatrix.empty(0)


def test_hits():
    mask = torch.zeros(4, 6, dtype=torch.bool)
    mask[1, 4] = True
    assert hits_mask((4, 1), mask)
    assert not hits_mask((1, 3), mask)
    with pytest.raises(InputError, match="outside the 6 x 4 mask"):
        hits_mask((4, 4), mask)

    scores = torch.zeros(4, 6)
    scores[1, 4] = scores[3, 0] = 1.0  # two best pixels: either may hit
    assert hits_box(scores, [(4, 1, 5, 2)])
    assert hits_box(scores, [(2, 2, 3, 3), (0, 3, 0, 3)])
    assert not hits_box(scores, [(1, 0, 3, 3)])
    assert not hits_box(torch.full((4, 6), -torch.inf), [(0, 0, 6, 4)])


def test_against_torchmetrics():
    """The same labels through another library; a label outside the classes is what it calls ignored."""
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        segmentation = pytest.importorskip("torchmetrics.functional.classification")
    rng = torch.Generator().manual_seed(9)
    truth = torch.randint(0, 5, (3, 40, 50), generator=rng)
    predicted = torch.where(
        torch.rand(3, 40, 50, generator=rng) < 0.6, truth, torch.randint(0, 5, (3, 40, 50), generator=rng)
    )
    truth[torch.rand(3, 40, 50, generator=rng) < 0.1] = 255
    matrix = ConfusionMatrix.empty(5)
    for one, other in zip(predicted, truth, strict=True):
        matrix.add(one, other)
    options = {"num_classes": 5, "ignore_index": 255}
    jaccard = segmentation.multiclass_jaccard_index(predicted, truth, average=None, **options)
    weighted = segmentation.multiclass_jaccard_index(predicted, truth, average="weighted", **options)
    recall = segmentation.multiclass_recall(predicted, truth, average=None, **options)
    precision = segmentation.multiclass_precision(predicted, truth, average=None, **options)
    assert torch.allclose(matrix.iou.float(), jaccard)
    assert torch.allclose(matrix.accuracy.float(), recall)
    assert torch.allclose(matrix.precision.float(), precision)
    assert matrix.miou == pytest.approx(float(jaccard.mean()))
    assert matrix.macc == pytest.approx(float(recall.mean()))
    assert matrix.frequency_weighted_iou == pytest.approx(float(weighted))


def test_scenes_add_up_and_counts_come_back():
    rng = torch.Generator().manual_seed(2)
    whole, parts = ConfusionMatrix.empty(3), [ConfusionMatrix.empty(3), ConfusionMatrix.empty(3)]
    for part in parts:
        p, t = torch.randint(-1, 3, (2, 8, 8), generator=rng)
        part.add(p, t)
        whole.add(p, t)
    total = ConfusionMatrix.of_counts(parts[0].counts.tolist())
    total.merge(parts[1])
    assert torch.equal(total.counts, whole.counts)
    with pytest.raises(InputError, match="cannot be added"):
        total.merge(ConfusionMatrix.empty(4))
    with pytest.raises(InputError, match="shape"):
        ConfusionMatrix.of_counts([[1, 2], [3, 4]])


def test_a_class_that_is_not_present_does_not_count_and_an_ignored_one_costs_nothing():
    """Truth: class 0 and the ignored 2. Calling ignored pixels class 1 is free; class 1 is not present."""
    matrix = ConfusionMatrix.empty(2)
    matrix.add(torch.tensor([[0, 0, 1, 1]]), torch.tensor([[0, 0, 2, 2]]))
    assert (matrix.miou, matrix.macc) == (1.0, 1.0)
    matrix.add(torch.tensor([[1, 1]]), torch.tensor([[0, 0]]))  # now half of class 0 is called 1
    assert matrix.miou == pytest.approx(0.5)  # and class 1, predicted but absent, is not averaged in
