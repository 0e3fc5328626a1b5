"""Scores per Gaussian: cosine, relevancy, standardisation, votes, selection."""

import math

import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.querying.scores import class_votes, confidence, query, relevancy, rescale, select, standardise
from sgwarp.scene import Semantics


class Phrases:
    """Random but fixed unit vectors."""

    space = "toy"

    def __init__(self, channels):
        self.channels = channels

    def encode_text(self, texts):
        def vector(text):
            seed = sum(ord(letter) * 31**k for k, letter in enumerate(text)) % 2**31
            return torch.randn(self.channels, generator=torch.Generator().manual_seed(seed))

        return torch.nn.functional.normalize(torch.stack([vector(text) for text in texts]), dim=1)


def semantics_of(features, weight=None, space="toy", labels=None):
    weight = torch.ones(len(features)) if weight is None else weight
    return Semantics(features, weight, weight, space, "0" * 16, labels)


@pytest.fixture
def random_semantics():
    rng = torch.Generator().manual_seed(3)
    features = torch.randn(200, 24, generator=rng)
    features[7] = 0
    weight = torch.ones(200)
    weight[7] = 0
    return semantics_of(features, weight)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-6), (torch.float16, 1e-3)])
def test_query_is_the_cosine(random_semantics, dtype, tolerance, monkeypatch):
    import sys

    monkeypatch.setattr(sys.modules["sgwarp.querying.scores"], "CHUNK", 64)  # 200 rows: three chunks and a rest
    encoder = Phrases(24)
    halved = semantics_of(random_semantics.features.to(dtype), random_semantics.weight)
    scores = query(halved, ["cup", "sofa", "lamp"], encoder)
    features, vectors = random_semantics.features.double(), encoder.encode_text(["cup", "sofa", "lamp"]).double()
    expected = torch.nn.functional.cosine_similarity(features[:, None], vectors[None], dim=2)
    assert scores.dtype == torch.float32
    torch.testing.assert_close(scores.double(), expected, atol=tolerance, rtol=0)
    assert not scores[7].any()


def test_relevancy_is_the_smallest_pairwise_softmax(random_semantics):
    encoder = Phrases(24)
    negatives = ["object", "things", "stuff", "texture"]
    result = relevancy(random_semantics, ["cup", "sofa"], encoder)
    unit = torch.nn.functional.normalize(random_semantics.features.double(), dim=1)
    for column, text in enumerate(["cup", "sofa"]):
        positive = unit @ encoder.encode_text([text]).double()[0]
        pairs = []
        for negative in negatives:
            other = unit @ encoder.encode_text([negative]).double()[0]
            pairs.append(torch.softmax(10 * torch.stack([positive, other], dim=1), dim=1)[:, 0])
        expected = torch.stack(pairs, dim=1).min(dim=1).values
        expected[7] = 0
        torch.testing.assert_close(result[:, column].double(), expected, atol=1e-6, rtol=0)


def test_standardise_ignores_what_was_not_seen():
    scores = torch.tensor([[1.0, 5.0], [3.0, 5.0], [100.0, -100.0]])
    result = standardise(scores, torch.tensor([True, True, False]))
    assert result.tolist() == [[-1.0, 0.0], [1.0, 0.0], [0.0, 0.0]]
    assert not standardise(scores, torch.zeros(3, dtype=torch.bool)).any()


def test_rescale_puts_median_at_zero_and_the_best_at_one():
    seen = torch.ones(2002, dtype=torch.bool)
    seen[2001] = False
    scores = torch.cat([torch.arange(2001.0), torch.tensor([1e9])])[:, None]
    result = rescale(scores, seen)[:, 0]
    assert result[1000] == 0
    assert result[1998] == 1
    assert result[0] == pytest.approx(-1000 / 998)
    assert result[2001] == 0
    assert not rescale(torch.ones(5, 1), torch.ones(5, dtype=torch.bool)).any()


def test_confidence_is_a_softmax():
    scores = torch.tensor([[0.1, 0.3], [-0.2, -0.2]])
    first = 1 / (1 + math.exp(2.0))
    torch.testing.assert_close(confidence(scores, 0.1), torch.tensor([[first, 1 - first], [0.5, 0.5]]))
    for temperature in (0.0, -1.0, math.nan):
        with pytest.raises(InputError, match="temperature"):
            confidence(scores, temperature)


def test_votes_of_unseen_gaussians_are_zero(random_semantics):
    votes = class_votes(random_semantics, ["cup", "sofa"], Phrases(24), temperature=0.05)
    assert not votes[7].any()
    seen = torch.arange(200) != 7
    torch.testing.assert_close(votes[seen].sum(dim=1), torch.ones(199))


@pytest.mark.parametrize(("scoring", "temperature"), [("cosine", 0.1), ("evidence", 0.3)])
def test_temperatures_of_the_two_scorings(random_semantics, scoring, temperature):
    """The softmax in closed form; "evidence" has one more column, of 1 deviation, for none of the names."""
    names, encoder = ["cup", "sofa", "lamp"], Phrases(24)
    scores = query(random_semantics, names, encoder).double()
    seen = random_semantics.seen
    if scoring == "evidence":
        scores = (scores - scores[seen].mean(dim=0)) / scores[seen].std(dim=0, correction=0) / 2  # all weights are 1
        scores = torch.cat([scores, torch.ones(len(scores), 1)], dim=1)
    expected = torch.softmax(scores / temperature, dim=1)[:, :3] * seen[:, None]
    votes = class_votes(random_semantics, names, encoder, scoring=scoring)
    torch.testing.assert_close(votes.double(), expected, atol=1e-5, rtol=0)
    softer = class_votes(random_semantics, names, encoder, 2.0, scoring)
    assert softer[seen].std() < 0.5 * votes[seen].std()


def test_standardised_votes_silence_a_loud_class():
    """All features lean towards the first class, half of them less: those go to the second one."""
    features = torch.tensor([[0.9, 0.1], [0.8, 0.3]]).repeat(10, 1)
    semantics = semantics_of(features)

    class Axes:
        space = "toy"

        def encode_text(self, texts):
            return torch.eye(2)[: len(texts)]

    plain = class_votes(semantics, ["a", "b"], Axes()).argmax(dim=1)
    fair = class_votes(semantics, ["a", "b"], Axes(), scoring="evidence").argmax(dim=1)
    assert plain.tolist() == [0, 0] * 10
    assert fair.tolist() == [0, 1] * 10


def test_votes_of_lifted_labels_are_their_shares():
    shares = torch.tensor([[0.2, 0.8, 0.0], [1.0, 0.0, 0.0]])
    lifted = semantics_of(shares.half(), space="labels", labels=("sofa", "cup", "lamp"))
    torch.testing.assert_close(class_votes(lifted, None), shares, atol=1e-3, rtol=0)
    torch.testing.assert_close(class_votes(lifted, ["lamp", "sofa"]), shares[:, [2, 0]], atol=1e-3, rtol=0)
    with pytest.raises(InputError, match="class 'dog' is not among the lifted labels: sofa, cup, lamp"):
        class_votes(lifted, ["cup", "dog"])


def test_select():
    scores = torch.tensor([0.1, 0.9, 0.5, 0.7])
    assert select(scores, threshold=0.5).tolist() == [False, True, False, True]
    assert select(scores, top_share=0.25).tolist() == [False, True, False, False]
    assert select(scores, top_share=1.0).all()
    for arguments in ({}, {"threshold": 0.1, "top_share": 0.1}, {"top_share": 0.0}, {"top_share": 1.1}):
        with pytest.raises(InputError):
            select(scores, **arguments)
    with pytest.raises(InputError, match=r"shape \[N\]"):
        select(scores[:, None], threshold=0.5)


def test_bad_queries(random_semantics):
    encoder = Phrases(24)
    for texts in ([], ["cup", " "]):
        with pytest.raises(InputError, match="texts"):
            query(random_semantics, texts, encoder)
    with pytest.raises(InputError, match="space 'toy' cannot be compared with semantics in space 'other'"):
        query(semantics_of(random_semantics.features, space="other"), ["cup"], encoder)
    with pytest.raises(InputError, match="24 channels"):
        query(random_semantics, ["cup"], Phrases(25))
    with pytest.raises(InputError, match="names of the classes"):
        class_votes(random_semantics, None, encoder)
    with pytest.raises(InputError, match="text encoder of space 'toy'"):
        class_votes(random_semantics, ["cup"])


@pytest.mark.parametrize(
    ("count", "share", "chosen"), [(9, 0.3, 3), (9, 0.25, 2), (8, 0.2, 2), (7, 0.5, 4), (3, 0.9, 3)]
)
def test_a_share_of_the_best_is_rounded_to_the_nearest_count(count, share, chosen):
    scores = torch.arange(count).float().flip(0)
    assert select(scores, top_share=share).tolist() == [k < chosen for k in range(count)]
