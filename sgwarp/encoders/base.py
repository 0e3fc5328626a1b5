"""What every source of 2D semantics offers the rest of the package."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from torch import Tensor

from sgwarp.scene import FeatureMap, View


@runtime_checkable
class TextEncoder(Protocol):
    """Turns phrases into unit vectors of a joint image-text space."""

    space: str

    def encode_text(self, texts: Sequence[str]) -> Tensor:
        """Unit vectors, float32 [Q, C], one per phrase."""
        ...


@runtime_checkable
class MapSource(Protocol):
    """Produces the feature map of a view.

    `needs_image` says whether `encode` reads `image`; where it does not, no photograph is loaded or rendered.
    """

    space: str
    needs_image: bool

    def encode(self, view: View, image: Tensor | None) -> FeatureMap:
        """Feature map of one view; `image` is float32 [H, W, 3] in [0, 1]."""
        ...
