"""The one path from semantics to scores of texts: each of its stages changes the answer, in the stated order."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sgwarp.commands.query import Query
from sgwarp.errors import InputError
from sgwarp.lifting.lifter import lift
from sgwarp.querying.scores import class_votes
from sgwarp.querying.scoring import best_texts, score_texts
from sgwarp.querying.segmentation import BOX, segment
from sgwarp.scene import Camera, Gaussians, Semantics

TEXTS = ["a", "b"]
COUNT = 300


class Axes:
    space = "toy"

    def encode_text(self, texts):
        return torch.eye(6)[["abcdef".index(text) for text in texts]]


@pytest.fixture
def pair():
    """Projected and predicted semantics with weights from 0.001 to 1,000; either misses some Gaussians."""
    g = torch.Generator().manual_seed(4)

    def one(missing: int) -> Semantics:
        weight = 10 ** (6 * torch.rand(COUNT, generator=g) - 3)
        weight[torch.randperm(COUNT, generator=g)[:missing]] = 0.0
        features = torch.randn(COUNT, 6, generator=g) * (weight > 0)[:, None]
        return Semantics(features, weight, weight, "toy", "0" * 16)

    return one(60), one(30)


def evidence_of(semantics: Semantics, measure: str, rivals: str) -> np.ndarray:
    """Float64, from the definitions."""
    features, weight = semantics.features.double().numpy(), semantics.weight.double().numpy()
    seen = weight > 0
    norm = np.linalg.norm(features, axis=1, keepdims=True)
    cosines = np.divide(features, norm, out=np.zeros_like(features), where=norm > 0)
    scores = cosines[:, :2]
    if measure == "relevancy":
        strongest = cosines[:, ["abcdef".index(rival) for rival in rivals]].max(axis=1, keepdims=True)
        scores = 1 / (1 + np.exp(-10 * (scores - strongest)))
    known = scores[seen]
    trust = weight / (weight + np.sort(weight[seen])[(seen.sum() - 1) // 2])
    return np.where(seen[:, None], (scores - known.mean(axis=0)) / known.std(axis=0) * trust[:, None], 0.0)


def together(one: np.ndarray, other: np.ndarray, seen: list[np.ndarray], how: str) -> np.ndarray:
    first, second = np.where(seen[0][:, None], one, other), np.where(seen[1][:, None], other, one)
    if how == "2d":
        return one
    if how == "3d":
        return other
    return {"max": np.maximum(first, second), "sum": first + second, "mean": (first + second) / 2}[how]


@pytest.mark.parametrize(
    ("measure", "how"),
    [("cosine", None), ("relevancy", None), *(("cosine", how) for how in ("2d", "3d", "max", "sum", "mean"))],
)
def test_evidence_then_ensemble_then_rescale(pair, measure, how):
    projected, predicted = pair
    options = {} if how is None else {"predicted": predicted, "ensemble": how}
    scores = score_texts(projected, TEXTS, Axes(), measure=measure, canonical=("d", "f"), **options)
    seen = [one.seen.numpy() for one in pair]
    expected = evidence_of(projected, measure, "df")
    known = seen[0]
    if how is not None:
        expected = together(expected, evidence_of(predicted, measure, "df"), seen, how)
        known = {"2d": seen[0], "3d": seen[1]}.get(how, seen[0] | seen[1])
    np.testing.assert_allclose(scores.evidence, expected, atol=2e-5)
    assert np.array_equal(scores.seen, known)
    ordered = np.sort(expected[known], axis=0)
    low, high = ordered[len(ordered) // 2], ordered[int(0.999 * (len(ordered) - 1))]
    np.testing.assert_allclose(scores.values, np.where(known[:, None], (expected - low) / (high - low), 0.0), atol=2e-5)
    assert scores.level == (2.0 if how == "sum" else 1.0)


def test_lifted_labels_keep_their_shares(pair):
    projected, predicted = (
        replace(one, features=torch.softmax(one.features, dim=1) * one.seen[:, None], labels=tuple("abcdef"))
        for one in pair
    )
    scores = score_texts(projected, ["c", "a"])
    assert torch.equal(scores.values, projected.features[:, [2, 0]])
    assert scores.evidence is None
    both = score_texts(projected, ["c", "a"], predicted=predicted, ensemble="mean")
    assert torch.equal(both.values, class_votes(projected, ["c", "a"], predicted=predicted, ensemble="mean"))
    assert torch.equal(both.seen, projected.seen | predicted.seen)


def test_what_cannot_be_scored_is_refused(pair):
    with pytest.raises(InputError, match="measure: expected one of cosine, relevancy, got 'dot'"):
        score_texts(pair[0], TEXTS, Axes(), measure="dot")
    with pytest.raises(InputError, match="text encoder of space 'toy'"):
        score_texts(pair[0], TEXTS)
    with pytest.raises(InputError, match="they must agree"):
        score_texts(pair[0], TEXTS, Axes(), predicted=replace(pair[1], fingerprint="1" * 16))


def test_pixels_show_the_text_that_stands_out(stage, toy_text):
    """Asked for two of four panels: those are found, the others show none of the texts."""
    semantics = lift(stage.gaussians, stage.views, stage.dense)
    view = stage.views[2]
    found = best_texts(stage.gaussians, view.camera, score_texts(semantics, ["lamp", "left door"], toy_text))
    expected = torch.tensor([-1, -1, 1, 0, -1])[stage.labels(view)]  # void, wall, left door, lamp, book
    assert (found == expected).float().mean() > 0.95
    labels = lift(stage.gaussians, stage.views, stage.one_hot)
    by_label = best_texts(stage.gaussians, view.camera, score_texts(labels, ["3", "2"]))
    assert torch.equal(by_label, segment(stage.gaussians, labels, ["3", "2"], view.camera)[0].where(by_label >= 0, -1))
    assert (by_label == expected).float().mean() > 0.95


def test_a_text_has_to_exceed_the_level():
    """One Gaussian fills the view; its evidence decides alone."""
    camera = Camera(torch.tensor([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]), torch.eye(4), 16, 16)
    wall = Gaussians(
        torch.tensor([[0.0, 0, 2]]),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.full((1, 3), 5.0),
        torch.tensor([0.9]),
        torch.zeros(1, 1, 3),
    )
    semantics = Semantics(torch.eye(6)[:1], torch.ones(1), torch.ones(1), "toy", wall.fingerprint)
    scores = score_texts(semantics, TEXTS, Axes())
    for evidence, level, expected in ((1.1, 1.0, 1), (0.9, 1.0, -1), (1.1, 2.0, -1)):
        given = replace(scores, evidence=torch.tensor([[0.2, evidence]]), level=level)
        assert (best_texts(wall, camera, given) == expected).all()


def test_the_command_and_the_demo_average_over_the_same_box():
    assert Query.__dataclass_fields__["box"].default == BOX
