"""Interfaces of all sources of 2D semantics, and their embedding spaces.

The paper (Sec. III-B) knows three kinds of networks, which `compose` turns into feature maps: image-level ones
(`ImageEncoder`), pixel-level ones (`PixelEncoder`) and instance-level ones (`InstanceEncoder`), each with a
`MaskGenerator` such as SAM. What comes out is a `MapSource`, which `sgwarp.lifting.lifter` asks for one map per view.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.scene import FeatureMap, View

LEVELS = ("default", "s", "m", "l")  # all masks; small, middle and large ones (subpart, part and whole of SAM)
UNRANKED = -1  # level of a mask whose generator knows no hierarchy


class MissingMap(InputError):
    """A view has no file in the folder; a caller with many views may skip it and count."""


@dataclass(frozen=True, eq=False)
class Masks:
    """Binary masks of one image, which may overlap.

    Attributes:
        masks: bool [M, h, w]; the map may be smaller than the image, with the same shape.
        scores: How good each is by its generator, float32 [M].
        ranks: 0, 1, 2 for small, middle, large in the generator's hierarchy, UNRANKED where it has none, int64 [M].

    Raises:
        InputError: A field has the wrong shape or type.
    """

    masks: Tensor
    scores: Tensor
    ranks: Tensor

    def __post_init__(self) -> None:
        count = self.masks.shape[:1]
        if self.masks.ndim != 3 or self.masks.dtype != torch.bool:
            raise InputError(f"masks: expected bool [M, h, w], got {self.masks.dtype} {list(self.masks.shape)}")
        if self.scores.shape != count or self.ranks.shape != count:
            shapes = f"scores {list(self.scores.shape)}, ranks {list(self.ranks.shape)}"
            raise InputError(f"masks: expected {len(self.masks)} scores and ranks, got {shapes}")

    def __len__(self) -> int:
        return len(self.masks)

    def at_level(self, level: str) -> Tensor:
        """Numbers of the masks of a level, one of LEVELS, int64 [m].

        Raises:
            InputError: There is no such level.
        """
        if level not in LEVELS:
            raise InputError(f"level '{level}' is not one of {', '.join(LEVELS)}")
        chosen = torch.ones_like(self.ranks, dtype=torch.bool)
        return (chosen if level == "default" else self.ranks == LEVELS.index(level) - 1).nonzero().flatten()


@dataclass(frozen=True, eq=False)
class Instances:
    """Instances found in one image.

    Attributes:
        boxes: x1, y1, x2, y2 [pixels of the image], float32 [K, 4].
        names: What each is, K phrases.
        scores: In [0, 1], float32 [K].
        masks: Their pixels, bool [K, h, w] in the shape of the image, or None: then boxes are all there is.
    """

    boxes: Tensor
    names: tuple[str, ...]
    scores: Tensor
    masks: Tensor | None = None

    def __post_init__(self) -> None:
        count = len(self.names)
        shapes = [list(self.boxes.shape), list(self.scores.shape)]
        if shapes != [[count, 4], [count]] or (self.masks is not None and len(self.masks) != count):
            raise InputError(f"instances: {count} names, but boxes and scores of shape {shapes[0]} and {shapes[1]}")


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


class Part(Protocol):
    """A network, or a file reader, with its settings and weights. `identity` names all that its output depends on."""

    @property
    def identity(self) -> str: ...


class ImageEncoder(Part, Protocol):
    """Knows what a whole image shows, such as CLIP; `side` is that of the squares it wants [pixels]."""

    @property
    def space(self) -> str: ...

    @property
    def side(self) -> int: ...

    def encode_images(self, crops: Tensor) -> Tensor:
        """Unit vectors, float32 [B, C], of square images, uint8 [B, side, side, 3]."""
        ...


class RegionEncoder(Part, Protocol):
    """Knows what the masks of an image show; `compose.Crops` makes one of every ImageEncoder."""

    @property
    def space(self) -> str: ...

    def encode_regions(self, image: Tensor, masks: Tensor) -> Tensor:
        """Unit vectors, float32 [M, C], of masks, bool [M, h, w], of an image, float32 [H, W, 3]."""
        ...


class PixelEncoder(Part, Protocol):
    """Knows what every pixel shows, such as LSeg or OpenSeg."""

    @property
    def space(self) -> str: ...

    def encode_pixels(self, image: Tensor) -> Tensor:
        """Features, float32 [h, w, C], of an image, float32 [H, W, 3]; h and w have the shape of the image."""
        ...


class InstanceEncoder(Part, Protocol):
    """Finds things and names them, such as GroundingDINO or VLPart."""

    def find(self, view: View, image: Tensor) -> Instances:
        """Find the instances of an image, float32 [H, W, 3]."""
        ...

    def identity_of(self, view: View) -> str:
        """Hash of what the map depends on besides `identity` and the image: the content of files, or nothing."""
        ...


class MaskGenerator(Part, Protocol):
    """Proposes masks, as SAM does."""

    def everything(self, view: View, image: Tensor) -> Masks:
        """All masks of an image, float32 [H, W, 3]."""
        ...

    def in_boxes(self, image: Tensor, boxes: Tensor) -> Tensor:
        """One mask, bool [K, h, w], for each box, float32 [K, 4] as in Instances.

        Raises:
            InputError: This generator takes no boxes.
        """
        ...

    def identity_of(self, view: View) -> str:
        """As of InstanceEncoder."""
        ...


def require_same_space(one: str, other: str, what: str) -> None:
    """Raise InputError, naming both, unless two spaces are the same."""
    if one != other:
        raise InputError(f"{what}: space '{one}' cannot be mixed with space '{other}'")
