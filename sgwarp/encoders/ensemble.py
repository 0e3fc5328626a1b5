"""Several sources at once: "features from different types of models can be integrated as an ensemble" (Sec. III-B).

The vectors of the members are normalised, scaled by the square roots of their weights and put behind each other, and so
are those of a phrase. The scalar product of the two is then the weighted mean of the members' cosines.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import interpolate, normalize

from sgwarp.encoders.base import MapSource, TextEncoder
from sgwarp.encoders.maps.files import LABEL_SPACE
from sgwarp.errors import InputError
from sgwarp.scene import FeatureMap, View


class TextEnsemble:
    """The TextEncoder of an ensemble.

    Args:
        members: One text encoder per member, in their order.
        weights: Positive; only their ratios count.

    Raises:
        InputError: There are no members, or weights are missing or not positive.
    """

    def __init__(self, members: Sequence[TextEncoder], weights: Sequence[float]) -> None:
        self.members = tuple(members)
        self.weights = shares(weights, len(members))
        self.space = ensemble_space([member.space for member in members], self.weights)

    def encode_text(self, texts: Sequence[str]) -> Tensor:
        """Unit vectors, float32 [Q, sum of the members' C]."""
        parts = [member.encode_text(texts) for member in self.members]
        return torch.cat([math.sqrt(share) * part for share, part in zip(self.weights, parts, strict=True)], dim=1)


class Ensemble:
    """A MapSource out of several, and as far as they all are one, a TextEncoder.

    Args:
        members: Sources in embedding spaces, which may differ.
        weights: One per member, positive; only their ratios count.

    Raises:
        InputError: There are no members, one gives label maps, or weights are missing or not positive.
    """

    def __init__(self, members: Sequence[MapSource], weights: Sequence[float]) -> None:
        self.members = tuple(members)
        self.weights = shares(weights, len(members))
        for member in members:
            if member.space == LABEL_SPACE:
                raise InputError(f"ensemble: space '{LABEL_SPACE}' holds ids, not meanings; it cannot be mixed")
        self.space = ensemble_space([member.space for member in members], self.weights)
        self.needs_image = any(member.needs_image for member in members)

    def has_map(self, view: View) -> bool:
        """Whether all members have a map of the view; those that cannot tell are taken to have one."""
        return all(getattr(member, "has_map", lambda view: True)(view) for member in self.members)

    def cache_key(self, view: View) -> str | None:
        """None if a member's maps are not to be cached."""
        keys = [getattr(member, "cache_key", lambda view: None)(view) for member in self.members]
        return None if None in keys else f"{self.space}({'; '.join(map(str, keys))})"

    def encode(self, view: View, image: Tensor | None) -> FeatureMap:
        """The members' maps put together: an id map if all are id maps, else a dense one."""
        maps = []
        for member in self.members:
            found = member.encode(view, image)
            if found.space != member.space:
                raise InputError(f"ensemble: space '{member.space}' gave a map in space '{found.space}'")
            maps.append(found)
        return join_maps(self.space, maps, self.weights)

    def encode_text(self, texts: Sequence[str]) -> Tensor:
        """Unit vectors, float32 [Q, sum of the members' C].

        Raises:
            InputError: A member has no text side.
        """
        for member in self.members:
            if not isinstance(member, TextEncoder):
                raise InputError(f"ensemble: the member in space '{member.space}' has no text side")
        return TextEnsemble(self.members, self.weights).encode_text(texts)  # type: ignore[arg-type]


def shares(weights: Sequence[float], count: int) -> tuple[float, ...]:
    """Weights that add up to 1.

    Raises:
        InputError: There are not `count` of them, at least one, or one is not positive and finite.
    """
    if not count or len(weights) != count:
        raise InputError(f"ensemble: expected one weight for each of {count} members, got {len(weights)}")
    if not all(0.0 < weight < math.inf for weight in weights):
        raise InputError(f"ensemble: weights must be positive, got {', '.join(map(str, weights))}")
    return tuple(weight / sum(weights) for weight in weights)


def ensemble_space(spaces: Sequence[str], weights: Sequence[float]) -> str:
    """Name of the space that the members' spaces make together."""
    return " ++ ".join(f"{space}@{weight:.4g}" for space, weight in zip(spaces, weights, strict=True))


def join_maps(space: str, maps: Sequence[FeatureMap], weights: Sequence[float]) -> FeatureMap:
    """Maps of one view put together channel by channel; where one knows nothing, its channels are zero.

    Raises:
        InputError: They have several levels, but not equally many.
    """
    if any(found.dense is not None for found in maps):
        return _join_dense(space, maps, weights)
    size = max((found.size for found in maps), key=lambda size: size[0] * size[1])
    all_ids = [_ids_at(found, size) for found in maps]
    levels = max(len(ids) for ids in all_ids)
    joint = torch.zeros(levels, *size, dtype=torch.int64)
    vectors = torch.empty(1, 0)
    for found, ids, weight in zip(maps, all_ids, weights, strict=True):
        if ids.shape[0] not in (1, levels):
            raise InputError(f"ensemble: a map of {ids.shape[0]} levels cannot be put together with one of {levels}")
        assert found.vectors is not None
        own = torch.cat([torch.zeros(1, found.channels), normalize(found.vectors, dim=1)]) * math.sqrt(weight)
        pairs, joint = (joint * len(own) + ids + 1).unique(return_inverse=True)
        vectors = torch.cat([vectors[pairs // len(own)], own[pairs % len(own)]], dim=1)
    known = vectors.any(dim=1)
    numbers = torch.where(known, known.cumsum(0) - 1, -1)
    return FeatureMap(space, ids=numbers[joint], vectors=vectors[known])


def _ids_at(found: FeatureMap, size: tuple[int, int]) -> Tensor:
    """Ids at another size, read at the nearest pixel, int64 [L, h, w]."""
    assert found.ids is not None
    if found.size == size:
        return found.ids.long()
    (h, w), (height, width) = found.size, size
    row = ((2 * torch.arange(height) + 1) * h) // (2 * height)
    column = ((2 * torch.arange(width) + 1) * w) // (2 * width)
    return found.ids.long()[:, row[:, None], column]


def _join_dense(space: str, maps: Sequence[FeatureMap], weights: Sequence[float]) -> FeatureMap:
    """At the size of the finest dense map."""
    size = max((found.size for found in maps if found.dense is not None), key=lambda size: size[0] * size[1])
    parts, valid = [], torch.zeros(size, dtype=torch.bool)
    for found, weight in zip(maps, weights, strict=True):
        if found.dense is not None:
            dense = found.dense.to(torch.float32)
            known = torch.ones(found.size, dtype=torch.bool) if found.valid is None else found.valid
            dense = torch.where(known[..., None], normalize(dense, dim=2), 0.0)
            if found.size != size:
                dense = interpolate(dense.permute(2, 0, 1)[None], size, mode="bilinear", align_corners=False)
                dense = normalize(dense[0].permute(1, 2, 0), dim=2)
        else:
            ids = _ids_at(found, size)
            assert found.vectors is not None
            dense = torch.where(ids[..., None] >= 0, normalize(found.vectors, dim=1)[ids.clamp(min=0)], 0.0).sum(dim=0)
            dense = normalize(dense, dim=2)
        valid |= dense.any(dim=2)
        parts.append(math.sqrt(weight) * dense)
    return FeatureMap(space, dense=torch.cat(parts, dim=2), valid=None if bool(valid.all()) else valid)
