"""Projection and prediction together, scene by scene and Gaussian by Gaussian."""

from dataclasses import replace

import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.network.quality import filled, projection_quality
from sgwarp.querying.ensembles import combine, seen_by
from sgwarp.querying.scores import class_votes, query
from sgwarp.querying.segmentation import segment
from sgwarp.scene import Semantics
from sgwarp.scene.semantics import require_together

# Rows: both know it, only the projection, only the network, nobody.
SEEN = torch.tensor([True, True, False, False]), torch.tensor([True, False, True, False])
PROJECTED = torch.tensor([[0.2, 0.6], [0.3, 0.1], [0.0, 0.0], [0.0, 0.0]])
PREDICTED = torch.tensor([[0.4, -0.2], [0.0, 0.0], [-0.5, -0.1], [0.0, 0.0]])


@pytest.mark.parametrize(
    ("how", "expected"),
    [
        ("2d", [[0.2, 0.6], [0.3, 0.1], [0, 0], [0, 0]]),
        ("3d", [[0.4, -0.2], [0, 0], [-0.5, -0.1], [0, 0]]),
        ("max", [[0.4, 0.6], [0.3, 0.1], [-0.5, -0.1], [0, 0]]),
        ("sum", [[0.6, 0.4], [0.6, 0.2], [-1.0, -0.2], [0, 0]]),
        ("mean", [[0.3, 0.2], [0.3, 0.1], [-0.5, -0.1], [0, 0]]),
    ],
)
def test_scores_become_one(how, expected):
    torch.testing.assert_close(combine(PROJECTED, PREDICTED, SEEN, how), torch.tensor(expected))


def test_an_unknown_ensemble_is_refused():
    with pytest.raises(InputError, match="2d, 3d, max, sum, mean"):
        combine(PROJECTED, PREDICTED, SEEN, "median")


def semantics(features, seen, labels=None, views=2.0):
    weight = seen.float()
    return Semantics(features, weight, weight * views, "toy", "0" * 16, labels)


class Axes:
    space = "toy"

    def encode_text(self, texts):
        return torch.eye(5)[[("a", "b", "c", "d", "e").index(text) for text in texts]]


@pytest.fixture
def pair():
    g = torch.Generator().manual_seed(0)
    projected = torch.randn(4, 5, generator=g) * SEEN[0][:, None]
    predicted = torch.randn(4, 5, generator=g) * SEEN[1][:, None]
    return semantics(projected, SEEN[0]), semantics(predicted, SEEN[1])


@pytest.mark.parametrize("how", ["2d", "3d", "max", "sum", "mean"])
def test_votes_are_the_softmax_of_the_ensembles_cosines(pair, how):
    """Paper, Sec. III-D: first the larger cosine of each class, then the softmax."""
    projected, predicted = pair
    votes = class_votes(projected, ["a", "b", "c"], Axes(), 0.1, predicted=predicted, ensemble=how)
    cosines = [query(one, ["a", "b", "c"], Axes()) for one in pair]
    expected = torch.softmax(combine(*cosines, SEEN, how) / 0.1, dim=1)
    seen = seen_by(projected, predicted, how)
    torch.testing.assert_close(votes, expected * seen[:, None])
    wanted = {"2d": [True, True, False, False], "3d": [True, False, True, False]}
    assert seen.tolist() == wanted.get(how, [True, True, True, False])


@pytest.mark.parametrize("scoring", ["cosine", "evidence"])
def test_one_semantics_alone_is_the_ensemble_of_it_with_itself(pair, scoring):
    projected, _ = pair
    alone = class_votes(projected, ["a", "b"], Axes(), scoring=scoring)
    for how in ("max", "mean"):
        twice = class_votes(projected, ["a", "b"], Axes(), scoring=scoring, predicted=projected, ensemble=how)
        torch.testing.assert_close(twice, alone)


def test_shares_of_labels_add_up_to_one_at_most():
    labels = ("1", "2", "3")
    projected = semantics(torch.tensor([[0.9, 0.1, 0.0], [0.2, 0.3, 0.1]]), torch.tensor([True, True]), labels)
    predicted = semantics(torch.tensor([[0.1, 0.8, 0.1], [0.1, 0.1, 0.1]]), torch.tensor([True, True]), labels)
    votes = class_votes(projected, None, predicted=predicted, ensemble="max")
    torch.testing.assert_close(votes[0], torch.tensor([0.9, 0.8, 0.1]) / 1.8)
    torch.testing.assert_close(votes[1], torch.tensor([0.2, 0.3, 0.1]))
    assert torch.equal(class_votes(projected, None), projected.features)


def test_a_sum_of_shares_is_on_the_scale_of_shares():
    """Fixed thresholds, such as one half, mean the same whichever ensemble asks."""
    labels = ("1", "2", "3")
    projected = semantics(torch.tensor([[0.6, 0.4, 0.0], [0.0, 0.0, 0.0]]), torch.tensor([True, False]), labels)
    predicted = semantics(torch.tensor([[0.6, 0.2, 0.2], [0.3, 0.5, 0.2]]), torch.tensor([True, True]), labels)
    for how in ("sum", "mean"):
        one = class_votes(projected, ["1"], predicted=predicted, ensemble=how)
        torch.testing.assert_close(one, torch.tensor([[0.6], [0.3]]))
        every = class_votes(projected, None, predicted=predicted, ensemble=how)
        torch.testing.assert_close(every[:, :1], one)


def test_a_sum_of_evidence_has_twice_the_level_of_none(pair):
    projected, _ = pair
    alone = class_votes(projected, ["a", "b"], Axes(), 1.0, "evidence")
    twice = class_votes(projected, ["a", "b"], Axes(), 2.0, "evidence", predicted=projected, ensemble="sum")
    torch.testing.assert_close(twice, alone)


def test_the_network_fills_in_what_no_view_saw(pair):
    projected, predicted = pair
    projected = replace(projected, weight=torch.tensor([4.0, 10.0, 0.0, 0.0]))
    result = filled(projected, predicted)
    assert torch.equal(result.features[:2], projected.features[:2])
    assert torch.equal(result.features[2], predicted.features[2])
    assert result.weight.tolist() == [4.0, 10.0, 4.0, 0.0]
    assert result.effective_views[2] == 0


@pytest.mark.parametrize(
    ("change", "word"),
    [({"space": "other"}, "space"), ({"fingerprint": "1" * 16}, "fingerprint"), ({"labels": tuple("abcde")}, "labels")],
)
def test_semantics_that_do_not_belong_together_are_refused(pair, change, word):
    projected, predicted = pair
    with pytest.raises(InputError, match=word):
        require_together(projected, replace(predicted, **change))
    with pytest.raises(InputError, match="shape"):
        require_together(projected, replace(predicted, features=predicted.features[:, :4]))


def test_quality_of_a_projection():
    weight = torch.tensor([1.0, 1.0, 1.0, 0.0])
    views = torch.tensor([3.0, 1.6, 1.0, 0.0])
    quality = projection_quality(Semantics(torch.ones(4, 2), weight, views, "toy", "0" * 16))
    assert quality.coverage == pytest.approx(0.75)
    assert quality.reliability == pytest.approx(2 / 3)
    assert not quality.suffices()
    assert quality.suffices(coverage=0.7, reliability=0.6)
    nothing = projection_quality(Semantics(torch.zeros(2, 2), torch.zeros(2), torch.zeros(2), "toy", "0" * 16))
    assert nothing == (0.0, 0.0)


def test_segmentation_sees_what_only_the_network_knows(stage, toy_text):
    """The projection knows nothing of the wall; the prediction knows it alone."""
    names = ("wall", "left door", "lamp", "book")
    axes = torch.eye(5)[stage.classes - 1]
    wall = stage.classes == 1
    one = stage.gaussians.fingerprint

    def known(mask):
        return Semantics(axes * mask[:, None], mask.float(), mask.float(), "toy", one)

    projected, predicted = known(~wall), known(wall)
    view = stage.views[2]
    truth = stage.labels(view)
    alone, _ = segment(stage.gaussians, projected, names, view.camera, toy_text)
    both, _ = segment(stage.gaussians, projected, names, view.camera, toy_text, predicted=predicted)
    on_wall = truth == 1
    assert float((alone[on_wall] == 255).float().mean()) > 0.9
    assert float((both == truth - 1)[truth > 0].float().mean()) > 0.95
