"""How texts are asked: the one path from semantics to scores that commands, demo, viewer and applications take."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from torch import Tensor

from sgwarp.encoders.base import TextEncoder
from sgwarp.encoders.calibration import calibration_of
from sgwarp.encoders.prompts import CANONICAL
from sgwarp.errors import InputError
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.querying.ensembles import Ensemble, score_together, seen_by
from sgwarp.querying.scores import class_votes, evidence, none_level, query, relevancy, rescale, standing_out
from sgwarp.querying.segmentation import segment_votes, splat_scores
from sgwarp.scene import Camera, Gaussians, Semantics

Measure = Literal["cosine", "relevancy"]


@dataclass(frozen=True, eq=False)
class TextScores:
    """Scores of texts in a scene, 0 where nothing is known.

    Attributes:
        values: 0 at the scene's median and 1 at its best thousandth, so that one threshold serves all texts and views;
            for lifted label images the shares of the labels. float32 [N, Q].
        evidence: The same before `rescale`, 0 at the scene's mean and 1 at its deviation, as the encoder is calibrated
            (see `standing_out`), float32 [N, Q]; None for lifted label images.
        level: Evidence that a text has to exceed to be worth more than "none of these".
        seen: Gaussians that have a score, bool [N].
        known: Texts that mean something to the encoder, bool [Q]; the evidence of the others is 0.
    """

    values: Tensor
    evidence: Tensor | None
    level: float
    seen: Tensor
    known: Tensor


def score_texts(
    semantics: Semantics,
    texts: Sequence[str],
    encoder: TextEncoder | None = None,
    *,
    measure: Measure | None = None,
    canonical: Sequence[str] = CANONICAL,
    predicted: Semantics | None = None,
    ensemble: Ensemble = "max",
) -> TextScores:
    """Score every Gaussian for every text: measure, `evidence`, ensemble, `rescale`.

    Args:
        semantics: N Gaussians.
        texts: Q phrases; for lifted label images, their labels.
        encoder: Text encoder of the semantics' space; not needed for lifted label images.
        measure: "cosine", or "relevancy": how much better a text fits than any canonical phrase; None for what the
            encoder is calibrated for.
        canonical: Phrases that a text has to beat with "relevancy".
        predicted: Semantics that the network predicts for the same Gaussians.
        ensemble: How the scores of the two become one, see `combine`.

    Raises:
        InputError: No text or an empty one, a label that was not lifted, an unknown measure, a missing encoder or one
            of another space, or semantics that do not belong together.
    """
    if measure is not None and measure not in get_args(Measure):
        raise InputError(f"measure: expected one of {', '.join(get_args(Measure))}, got '{measure}'")
    seen = seen_by(semantics, predicted, ensemble)
    if semantics.labels is not None:
        shares = class_votes(semantics, texts, predicted=predicted, ensemble=ensemble)
        return TextScores(shares, None, 0.0, seen, torch.ones(len(texts), dtype=torch.bool))
    if encoder is None:
        raise InputError(f"encoder: texts need the text encoder of space '{semantics.space}'")
    calibration = calibration_of(encoder)
    if measure is None:
        measure = "relevancy" if calibration.scoring == "relevancy" else "cosine"

    def score(one: Semantics) -> Tensor:
        if measure == "cosine":
            cosines = query(one, texts, encoder)
            return torch.cat([evidence(cosines, one), standing_out(cosines, one, calibration)], dim=1)
        scores = evidence(relevancy(one, texts, encoder, canonical), one)
        return torch.cat([scores, scores], dim=1)

    both = score_together(score, semantics, predicted, ensemble)
    scores, proof = both[:, : len(texts)], both[:, len(texts) :]
    known = calibration.known(texts)
    proof = torch.where(known.to(proof.device), proof, 0.0)
    level = none_level(predicted, ensemble, calibration)
    return TextScores(rescale(scores, seen), proof, level, seen, known)


def without_counterpart(texts: Sequence[str], encoder: TextEncoder) -> list[str]:
    """Texts that mean nothing to an encoder: what they name stays unknown."""
    known = calibration_of(encoder).known(texts)
    return [text for text, means in zip(texts, known.tolist(), strict=True) if not means]


def best_texts(
    gaussians: Gaussians, camera: Camera, scores: TextScores, settings: RasterSettings | None = None
) -> Tensor:
    """Which text every pixel of a view shows, -1 where none of them, int64 [H, W].

    The text with the largest mean evidence at the pixel, if that exceeds `scores.level`; for lifted label images the
    label with the largest share, as in `segment_votes`.

    Args:
        gaussians: The scene.
        camera: The view.
        scores: Of its Gaussians.
        settings: Thresholds of the rasterizer.
    """
    if scores.evidence is None:
        return segment_votes(gaussians, camera, scores.values, scores.seen, settings=settings)[0]
    mean, known = splat_scores(gaussians, camera, scores.evidence, scores.seen, settings)
    height, best = mean.max(dim=2)
    return torch.where(known & (height > scores.level), best, -1)
