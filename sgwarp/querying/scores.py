"""Answers from lifted semantics: a score per Gaussian and query."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from sgwarp.encoders.base import TextEncoder
from sgwarp.encoders.calibration import PLAIN, Calibration, Scoring, calibration_of
from sgwarp.encoders.prompts import CANONICAL
from sgwarp.errors import InputError
from sgwarp.querying.ensembles import Ensemble, score_together, seen_by
from sgwarp.runs.isolation import isolated
from sgwarp.scene import Semantics

CHUNK = 65536  # Gaussians scored at once: half precision features are widened chunk by chunk


@isolated
def query(semantics: Semantics, texts: Sequence[str], encoder: TextEncoder) -> Tensor:
    """Cosine of every Gaussian's feature with every text, float32 [N, Q]; 0 where nothing was seen.

    Raises:
        InputError: No text, an empty text, or the encoder speaks another space than the semantics.
    """
    return _cosines(semantics, _encode(semantics, texts, encoder))


@isolated
def relevancy(
    semantics: Semantics,
    texts: Sequence[str],
    encoder: TextEncoder,
    canonical: Sequence[str] = CANONICAL,
    scale: float = 10.0,
) -> Tensor:
    """Relevancy of texts against canonical phrases (Kerr et al., LERF, 2023), float32 [N, Q] in [0, 1].

    The smallest, over the canonical phrases, of the first entry of softmax(scale * [cosine of the text, cosine of the
    phrase]); above 0.5 the text beats all of them. 0 where nothing was seen.

    Raises:
        InputError: As `query`.
    """
    cosines = _cosines(semantics, _encode(semantics, [*texts, *canonical], encoder))
    wanted, rivals = cosines[:, : len(texts)], cosines[:, len(texts) :]
    better = torch.sigmoid(scale * (wanted - rivals.max(dim=1, keepdim=True).values))
    return torch.where(semantics.seen.to(better.device)[:, None], better, 0.0)


def standardise(scores: Tensor, seen: Tensor, least_deviation: float = 0.0) -> Tensor:
    """Scores [N, Q] with mean 0 and deviation 1 per query over the seen Gaussians, so that no query is louder than
    another; 0 where nothing was seen. A query whose scores deviate less than `least_deviation` is divided by that."""
    seen = seen.to(scores.device)
    known = scores[seen].double()
    if not len(known):
        return torch.zeros_like(scores)
    deviation, mean = torch.std_mean(known, dim=0, correction=0)
    deviation = deviation.clamp(min=least_deviation)
    scaled = (scores - mean) / torch.where(deviation > 0, deviation, 1.0)
    return torch.where(seen[:, None], scaled, 0.0).to(scores.dtype)


@isolated
def evidence(scores: Tensor, semantics: Semantics, least_deviation: float = 0.0) -> Tensor:
    """Scores [N, Q] standardized over the scene and weighted by how well each Gaussian was seen.

    `standardise`, times w / (w + median w) with w the weight behind a Gaussian's feature: one that a single grazing
    pixel saw says little. 0 is the scene's mean, 1 its deviation; 0 where nothing was seen.
    """
    weight = semantics.weight.to(scores.device)
    seen = semantics.seen.to(scores.device)
    if not bool(seen.any()):
        return torch.zeros_like(scores)
    return standardise(scores, seen, least_deviation) * (weight / (weight + weight[seen].median()))[:, None]


@isolated
def standing_out(cosines: Tensor, semantics: Semantics, calibration: Calibration) -> Tensor:
    """`evidence` of cosines [N, Q] as an encoder is calibrated; where a cosine is certain, at least its share of the
    level, weighted by nothing: what fills the scene does not stand out from its mean."""
    relative = evidence(cosines, semantics, calibration.least_deviation)
    return torch.maximum(relative, certainty(cosines, calibration)) if calibration.certain < math.inf else relative


def certainty(cosines: Tensor, calibration: Calibration) -> Tensor:
    """Evidence that a cosine is by itself: the level where it is `calibration.certain`; [..., Q]."""
    return calibration.level * cosines / calibration.certain


def rescale(scores: Tensor, seen: Tensor) -> Tensor:
    """Scores [N, Q] on a scale where 0 is the median over the seen Gaussians and 1 the best thousandth of them.

    A query then has one threshold for all views of the scene, unlike with a scale made per picture, on which something
    is always found. 0 where nothing was seen, and everywhere if all scores are equal.
    """
    seen = seen.to(scores.device)
    known = scores[seen].sort(dim=0).values
    if not len(known):
        return torch.zeros_like(scores)
    low, high = known[len(known) // 2], known[int(0.999 * (len(known) - 1))]
    scaled = (scores - low) / torch.where(high > low, high - low, torch.inf)
    return torch.where(seen[:, None], scaled, 0.0)


def confidence(scores: Tensor, temperature: float) -> Tensor:
    """Softmax of scores / temperature over the queries, [..., Q].

    Raises:
        InputError: The temperature is not positive and finite.
    """
    require_temperature(temperature)
    return torch.softmax(scores / temperature, dim=-1)


def require_temperature(temperature: float) -> None:
    """Raise InputError unless a softmax can be divided by it."""
    if not 1e-6 <= temperature < float("inf"):
        raise InputError(f"temperature: expected a number from 1e-6 on, got {temperature}")


@isolated
def class_votes(
    semantics: Semantics,
    classes: Sequence[str] | None,
    encoder: TextEncoder | None = None,
    temperature: float | None = None,
    scoring: Scoring | None = None,
    *,
    predicted: Semantics | None = None,
    ensemble: Ensemble = "max",
    canonical: Sequence[str] = CANONICAL,
) -> Tensor:
    """Per-Gaussian class scores, float32 [N, Q]; 0 where nothing was seen.

    For lifted label or id images the lifted shares themselves, of all labels if `classes` is None. In a text space:

    - "evidence": softmax over the classes' `evidence` and a level for none of them. No class wins everywhere by being
      loud, and what fits none of the names goes to none; for a list of what to look for.
    - "relevancy": softmax over the cosines of the classes and of the canonical phrase that fits best, which is none.
    - "cosine": softmax over the cosines (paper, Sec. III-D); for a list that names everything in the scene.

    Args:
        semantics: N Gaussians.
        classes: Q names.
        encoder: Text encoder of the semantics' space.
        temperature: Of the softmax; None for what the encoder states.
        scoring: See above; None for what the encoder states, see `sgwarp.encoders.calibration`.
        predicted: Semantics that the network predicts for the same Gaussians; the scores of the two become one before
            the softmax (paper, Sec. III-D), shares before they are made to add up to 1 again.
        ensemble: How, see `combine`.
        canonical: Phrases that a class has to beat with "relevancy".

    Raises:
        InputError: No classes, or an encoder missing, where one is needed; a class that is not among the lifted labels;
            a temperature that is not positive and finite; predicted semantics of another scene or space.
    """
    if temperature is not None:
        require_temperature(temperature)
    seen = seen_by(semantics, predicted, ensemble)
    if semantics.labels is not None:
        return _label_votes(semantics, classes, predicted, ensemble)
    if not classes:
        raise InputError(f"classes: semantics in space '{semantics.space}' need the names of the classes to look for")
    if encoder is None:
        raise InputError(f"encoder: classes need the text encoder of space '{semantics.space}'")
    if scoring is not None and scoring not in PLAIN:
        raise InputError(f"scoring: expected one of {', '.join(PLAIN)}, got '{scoring}'")
    calibration = calibration_of(encoder, scoring)
    rivals = tuple(canonical) if calibration.scoring == "relevancy" else ()

    def score(one: Semantics) -> Tensor:
        cosines = query(one, [*classes, *rivals], encoder)
        return standing_out(cosines, one, calibration) if calibration.scoring == "evidence" else cosines

    scores = score_together(score, semantics, predicted, ensemble)
    wanted = scores[:, : len(classes)]
    none = None
    if calibration.scoring == "evidence":
        none = torch.full_like(wanted[:, :1], none_level(predicted, ensemble, calibration))
    elif rivals:
        none = scores[:, len(classes) :].amax(dim=1, keepdim=True)
    votes = class_shares(wanted, none, calibration, calibration.known(classes), temperature)
    return torch.where(seen.to(votes.device)[:, None], votes, 0.0)


def class_shares(
    scores: Tensor, none: Tensor | None, calibration: Calibration, known: Tensor, temperature: float | None = None
) -> Tensor:
    """Shares of the classes, which add up to 1 together with that of "none of these", float32 [N, Q].

    Args:
        scores: Of the classes, [N, Q].
        none: Score of "none of these", [N, 1]; None without it.
        calibration: Temperature of the softmax.
        known: Classes that mean something to the encoder, bool [Q]; the others get nothing.
        temperature: In place of the calibration's.

    Raises:
        InputError: The temperature is not positive and finite.
    """
    known = known.to(scores.device)
    if not bool(known.any()):
        return torch.zeros_like(scores)
    rivals = scores if none is None else torch.cat([scores, none], dim=1)
    quiet = torch.nn.functional.pad(~known, (0, rivals.shape[1] - len(known)))
    shares = confidence(
        rivals.masked_fill(quiet, -torch.inf), calibration.temperature if temperature is None else temperature
    )
    return shares[:, : scores.shape[1]]


def none_level(predicted: Semantics | None, ensemble: Ensemble, calibration: Calibration) -> float:
    """Evidence of "none of these": a sum of two scores has to exceed twice the level."""
    return calibration.level * (2 if predicted is not None and ensemble == "sum" else 1)


def _label_votes(
    semantics: Semantics, classes: Sequence[str] | None, predicted: Semantics | None, ensemble: Ensemble
) -> Tensor:
    """Shares of the labels, which add up to 1 or less also in an ensemble, [N, Q]."""
    if predicted is None:
        return _label_shares(semantics, classes)
    # A sum of shares is twice their mean; the largest of both may add up to more than all there is.
    how: Ensemble = "mean" if ensemble == "sum" else ensemble
    total = score_together(lambda one: _label_shares(one, None), semantics, predicted, how).sum(dim=1, keepdim=True)
    shares = score_together(lambda one: _label_shares(one, classes), semantics, predicted, how)
    return shares / total.clamp(min=1.0)


def _label_shares(semantics: Semantics, classes: Sequence[str] | None) -> Tensor:
    """Lifted or predicted shares of the labels, [N, Q]."""
    assert semantics.labels is not None
    if classes is None:
        return semantics.features.to(torch.float32)
    missing = [name for name in classes if name not in semantics.labels]
    if missing:
        raise InputError(f"class '{missing[0]}' is not among the lifted labels: {', '.join(semantics.labels)}")
    return semantics.features[:, [semantics.labels.index(name) for name in classes]].to(torch.float32)


def select(scores: Tensor, threshold: float | None = None, top_share: float | None = None) -> Tensor:
    """Gaussians whose score [N] is above `threshold`, or the `top_share` of them with the best scores, bool [N].

    Raises:
        InputError: Not exactly one of the two is given, the share is outside (0, 1], or scores has another shape.
    """
    if scores.ndim != 1:
        raise InputError(f"scores: expected shape [N], one query at a time, got {list(scores.shape)}")
    if (threshold is None) == (top_share is None):
        raise InputError("give either threshold or top_share")
    if threshold is not None:
        return scores > threshold
    assert top_share is not None
    if not 0 < top_share <= 1:
        raise InputError(f"top_share: expected a share in (0, 1], got {top_share}")
    chosen = torch.zeros(len(scores), dtype=torch.bool, device=scores.device)
    chosen[scores.topk(round(top_share * len(scores))).indices] = True
    return chosen


def _encode(semantics: Semantics, texts: Sequence[str], encoder: TextEncoder) -> Tensor:
    """Unit vectors of the texts, float32 [Q, C]."""
    if not texts or not all(text.strip() for text in texts):
        raise InputError("texts: expected at least one phrase, and no empty one")
    semantics.require_space(encoder.space)
    vectors = encoder.encode_text(list(texts))
    if vectors.shape != (len(texts), semantics.features.shape[1]):
        channels = semantics.features.shape[1]
        raise InputError(f"text vectors of shape {list(vectors.shape)} cannot be compared with {channels} channels")
    return vectors.to(semantics.features.device, torch.float32)


def _cosines(semantics: Semantics, vectors: Tensor) -> Tensor:
    """Cosines [N, Q]; raises InputError for features with NaN or infinity, which files of semantics never hold."""
    scores = vectors.new_empty(len(semantics), len(vectors))
    for start in range(0, len(semantics), CHUNK):
        rows = semantics.features[start : start + CHUNK].to(torch.float32)
        norm = rows.norm(dim=1, keepdim=True)
        scores[start : start + CHUNK] = (rows @ vectors.T) / torch.where(norm > 0, norm, 1.0)
    if not scores.is_cuda and not bool(torch.isfinite(scores.sum())):  # on CUDA to look is to wait for the device
        row = int((~torch.isfinite(scores)).any(dim=1).nonzero()[0])
        raise InputError(f"features: of the semantics hold NaN or infinity, first in row {row}; lift the scene again")
    return scores
