"""What instances are called: the class whose text fits their mean feature best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from sgwarp.encoders.base import TextEncoder
from sgwarp.encoders.calibration import calibration_of
from sgwarp.encoders.prompts import CANONICAL
from sgwarp.errors import InputError
from sgwarp.querying.scores import certainty, class_shares, standardise
from sgwarp.scene import InstanceMap


def name_instances(found: InstanceMap, classes: Sequence[str], encoder: TextEncoder) -> InstanceMap:
    """Give every instance one of the class names, or none where the encoder's scoring knows "none of these".

    The scoring is the one that the encoder is calibrated for. With "evidence" the cosine of mean feature and text is
    compared with that of the other instances, so that a class that fits everything a little names nothing; a single
    instance has no others, and gets the name that fits it best.

    Args:
        found: Instances with features.
        classes: Names.
        encoder: Text encoder of their space.

    Raises:
        InputError: There are no features or classes, or they live in another space than the encoder.
    """
    if found.features is None or not classes:
        raise InputError("naming instances needs their features (from lifted semantics) and at least one class")
    if encoder.space != found.space:
        raise InputError(f"space '{encoder.space}' cannot be compared with instances in space '{found.space}'")
    calibration = calibration_of(encoder)
    known = found.features.norm(dim=1) > 0
    if calibration.scoring == "evidence" and int(known.sum()) < 2:
        calibration = calibration_of(encoder, "cosine")
    rivals = CANONICAL if calibration.scoring == "relevancy" else ()
    texts = encoder.encode_text([*classes, *rivals]).to(found.features)
    scores = torch.nn.functional.normalize(found.features, dim=1) @ texts.T
    scores, none = scores[:, : len(classes)], scores[:, len(classes) :].amax(dim=1, keepdim=True) if rivals else None
    if calibration.scoring == "evidence":
        certain = certainty(scores, calibration)
        scores = torch.maximum(standardise(scores, known, calibration.least_deviation), certain)
        none = torch.full_like(scores[:, :1], calibration.level)
    shares = class_shares(scores, none, calibration, calibration.known(classes))
    score, place = shares.max(dim=1)
    named = known & (score > 0) & (score >= 1 - shares.sum(dim=1))
    rows = [
        replace(row, label=classes[int(place[k])], label_score=float(score[k])) if named[k] else row
        for k, row in enumerate(found.table)
    ]
    return replace(found, table=tuple(rows))
