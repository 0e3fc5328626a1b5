"""Every kind of map that encoders give goes through the lift: shares of labels, nothing at all, levels, ensembles."""

import pytest
import torch

from sgwarp.encoders.ensemble import Ensemble
from sgwarp.lifting.lifter import lift
from sgwarp.querying.scores import class_votes, query
from sgwarp.runs.log import RunLog
from sgwarp.scene import FeatureMap


def agreement(stage, scores) -> float:
    """Share of the seen Gaussians to which scores give the same class as lifted labels do."""
    one_hot = lift(stage.gaussians, stage.views, stage.one_hot)
    return float((scores.argmax(dim=1) == one_hot.features.argmax(dim=1))[one_hot.seen].float().mean())


def test_shares_of_labels(stage):
    """What CLIPSeg gives: a share for each name at each pixel, which need not add up to one."""
    names = ("wall", "door", "lamp", "book")

    def shares(view):
        labels = stage.labels(view)
        dense = torch.stack([(labels == k + 1).float() * 0.6 + 0.05 for k in range(4)], dim=2)
        return FeatureMap("labels", dense=dense, valid=labels > 0, labels=names)

    log = RunLog()
    semantics = lift(stage.gaussians, stage.views, shares, log=log)
    assert semantics.labels == names
    assert agreement(stage, class_votes(semantics, None)) > 0.99
    assert 0 <= log.error["residual"] < 0.2


def test_views_in_which_nothing_was_found(stage):
    """Detectors that find nothing give a map without vectors; the other views count."""
    vectors = torch.eye(4)

    def found(view):
        labels = stage.labels(view)
        if view is stage.views[0]:
            return FeatureMap("toy-4", ids=torch.full_like(labels, -1), vectors=torch.zeros(0, 4))
        return FeatureMap("toy-4", ids=labels - 1, vectors=vectors)

    semantics = lift(stage.gaussians, stage.views, found)
    without = lift(stage.gaussians, stage.views[1:], found)
    torch.testing.assert_close(semantics.features, without.features, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("mode", ["weighted", "center"])
def test_levels_are_averaged(stage, mode):
    """Two levels that name different things give each Gaussian the mean of both."""
    vectors = torch.eye(5)

    def found(view):
        labels = stage.labels(view)
        whole = torch.where(labels > 0, 4, -1)
        return FeatureMap("toy-5", ids=torch.stack([labels - 1, whole]), vectors=vectors)

    semantics = lift(stage.gaussians, stage.views, found, mode)
    seen = semantics.seen
    assert (semantics.features[seen, 4] - 0.5).abs().max() < 1e-3
    if mode == "weighted":
        assert agreement(stage, semantics.features[:, :4]) > 0.99


class Member:
    needs_image = False

    def __init__(self, space, stage, turn):
        self.space, self.stage, self.turn = space, stage, turn

    def vectors(self):
        return torch.eye(4).roll(self.turn, dims=0)

    def encode(self, view, image):
        return FeatureMap(self.space, ids=self.stage.labels(view) - 1, vectors=self.vectors())

    def encode_text(self, texts):
        return self.vectors()[[int(text) for text in texts]]


def test_an_ensemble_answers(stage):
    ensemble = Ensemble([Member("one", stage, 0), Member("two", stage, 1)], (2.0, 1.0))
    semantics = lift(stage.gaussians, stage.views, ensemble)
    assert semantics.space == ensemble.space
    scores = query(semantics, ["0", "1", "2", "3"], ensemble)
    assert agreement(stage, scores) > 0.99
