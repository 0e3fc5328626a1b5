"""2D semantics of one view."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sgwarp.scene.checks import as_tensor, float32, require


@dataclass(frozen=True, eq=False)
class FeatureMap:
    """2D semantics of one view: dense vectors, or an id map with one vector per id.

    Attributes:
        space: Name of the embedding space (model and dimension); two spaces never mix.
        dense: Features, floating point [h, w, C], or None.
        valid: Pixels of `dense` that carry semantics, bool [h, w], or None for all.
        ids: Row of `vectors` seen at each pixel, per level, int32 [L, h, w], -1 where there is none; or None.
        vectors: One feature per id, float32 [M, C]. None means one-hot: id k is channel k of `labels`.
        labels: Names of the one-hot channels, length C; the same for every view of a scene.

    The map may be smaller than the image; it is then read at the nearest (ids) or bilinear (dense) position.
    """

    space: str
    dense: Tensor | None = None
    valid: Tensor | None = None
    ids: Tensor | None = None
    vectors: Tensor | None = None
    labels: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        put = object.__setattr__
        require(bool(self.space), "space: a feature map must name its embedding space")
        require((self.dense is None) != (self.ids is None), "give either dense features or ids, not both or none")
        if self.dense is not None:
            dense = as_tensor(self.dense)
            ok = dense.ndim == 3 and dense.is_floating_point() and dense.numel() > 0
            require(ok, f"dense: expected floating point [h, w, C], got {dense.dtype} {list(dense.shape)}")
            put(self, "dense", dense)
            if self.valid is not None:
                valid = as_tensor(self.valid, torch.bool)
                fits = valid.shape == dense.shape[:2]
                require(fits, f"valid: expected {list(dense.shape[:2])}, got {list(valid.shape)}")
                put(self, "valid", valid)
            return
        ids = as_tensor(self.ids)
        require(not ids.is_floating_point(), f"ids: expected integers, got {ids.dtype}")
        ids = ids[None] if ids.ndim == 2 else ids
        require(ids.ndim == 3 and ids.numel() > 0, f"ids: expected shape [L, h, w], got {list(ids.shape)}")
        put(self, "ids", ids.to(torch.int32).contiguous())
        require((self.vectors is None) != (self.labels is None), "ids: give either vectors or labels")
        if self.vectors is not None:
            put(self, "vectors", float32("vectors", self.vectors, (None, None)))
        count = len(self.vectors) if self.vectors is not None else len(self.labels or ())
        top, low = int(self.ids.max()), int(self.ids.min())  # type: ignore[union-attr]
        require(low >= -1 and top < count, f"ids: expected -1 to {count - 1}, got {low} to {top}")

    @property
    def channels(self) -> int:
        if self.dense is not None:
            return self.dense.shape[2]
        return self.vectors.shape[1] if self.vectors is not None else len(self.labels or ())

    @property
    def size(self) -> tuple[int, int]:
        """(h, w) of the map."""
        shape = self.dense.shape[:2] if self.dense is not None else self.ids.shape[1:]  # type: ignore[union-attr]
        return int(shape[0]), int(shape[1])
