"""What instances are called: the class whose text fits their mean feature best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from sgwarp.encoders.base import TextEncoder
from sgwarp.errors import InputError
from sgwarp.querying.scores import TEMPERATURES
from sgwarp.scene import InstanceMap


def name_instances(found: InstanceMap, classes: Sequence[str], encoder: TextEncoder) -> InstanceMap:
    """Give every instance one of the class names.

    The cosine of mean feature and text is compared with that of the other instances before the softmax over the
    classes, so that a class that fits everything a little names nothing.

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
    texts = encoder.encode_text(list(classes)).to(found.features)
    known = found.features.norm(dim=1) > 0
    cosines = torch.nn.functional.normalize(found.features, dim=1) @ texts.T
    if int(known.sum()) > 1:
        spread, mean = torch.std_mean(cosines[known].double(), dim=0, correction=0)
        cosines = ((cosines - mean) / spread.clamp(min=1e-9)).to(torch.float32)
        shares = torch.softmax(cosines / TEMPERATURES["evidence"], dim=1)
    else:
        shares = torch.softmax(cosines / TEMPERATURES["cosine"], dim=1)
    score, place = shares.max(dim=1)
    rows = [
        replace(row, label=classes[int(place[k])], label_score=float(score[k])) if known[k] else row
        for k, row in enumerate(found.table)
    ]
    return replace(found, table=tuple(rows))
