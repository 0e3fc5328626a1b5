"""Masks of a view under one roof, whatever makes them: generators, id images, detectors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from sgwarp.encoders.base import UNRANKED, InstanceEncoder, MapSource, MaskGenerator
from sgwarp.errors import InputError
from sgwarp.scene import View


@dataclass(frozen=True, eq=False)
class ViewMasks:
    """Masks of one view, which may overlap.

    Attributes:
        masks: bool [M, h, w], none of them empty.
        ranks: 0, 1, 2 for small, middle, large; -1 where there is no hierarchy, int64 [M].
        names: What the source calls each; empty where it gives no names.
    """

    masks: Tensor
    ranks: Tensor
    names: tuple[str, ...] = ()

    @classmethod
    def without_empty(cls, masks: Tensor, ranks: Tensor, names: tuple[str, ...] = ()) -> ViewMasks:
        """The masks that hold a pixel."""
        kept = masks.flatten(1).any(dim=1).nonzero().flatten()
        return cls(masks[kept], ranks[kept], tuple(names[k] for k in kept.tolist()) if names else ())

    def __len__(self) -> int:
        return len(self.masks)


class MaskSource(Protocol):
    """Gives the masks of a view; `needs_image` says whether it looks at the photograph."""

    @property
    def needs_image(self) -> bool: ...

    def read(self, view: View, image: Tensor | None) -> ViewMasks:
        """Masks of a view; `image` is float32 [H, W, 3].

        Raises:
            MissingMap: There are none for this view.
        """
        ...


def blank(view: View) -> Tensor:
    """An image in the shape of the view, for sources that only look at its size."""
    return torch.zeros(()).expand(*view.camera.size, 3)


@dataclass(frozen=True)
class GeneratedMasks:
    """All masks of a MaskGenerator, such as SAM or OpenCV's proposals; or of files that hold them."""

    generator: MaskGenerator
    needs_image: bool = True

    def read(self, view: View, image: Tensor | None) -> ViewMasks:
        found = self.generator.everything(view, blank(view) if image is None else image)
        return ViewMasks.without_empty(found.masks.cpu(), found.ranks)


@dataclass(frozen=True)
class MappedMasks:
    """The ids of an id map, such as label images or DEVA's: one mask for each id of a level.

    Of several levels the first holds all masks and the others are ranked, as LangSplat stores them.
    """

    source: MapSource
    what: str

    @property
    def needs_image(self) -> bool:
        return self.source.needs_image

    def read(self, view: View, image: Tensor | None) -> ViewMasks:
        """
        Raises:
            InputError: The map is dense.
        """
        found = self.source.encode(view, image)
        if found.ids is None:
            raise InputError(f"{self.what}: view {view.stem} holds dense features, which are no masks; give id images")
        masks, ranks, names = [], [], []
        for level, ids in enumerate(found.ids):
            present = ids.unique()
            present = present[present >= 0]
            masks.append(ids == present[:, None, None])
            ranks += [level - 1] * len(present)  # of the first level: UNRANKED
            names += [found.labels[k] for k in present.tolist()] if found.labels is not None else []
        return ViewMasks.without_empty(torch.cat(masks), torch.tensor(ranks, dtype=torch.int64), tuple(names))


class NoText:
    """A text side that is not asked: whoever wants masks needs no vectors of their names."""

    space = "names"

    def encode_text(self, texts: Sequence[str]) -> Tensor:
        """
        Raises:
            InputError: Always.
        """
        raise InputError("masks with names have no text side")


@dataclass(frozen=True)
class DetectedMasks:
    """What an instance-level network finds, with its names; boxes become masks by a generator such as SAM."""

    detector: InstanceEncoder
    generator: MaskGenerator | None
    what: str
    needs_image: bool = True

    def read(self, view: View, image: Tensor | None) -> ViewMasks:
        """
        Raises:
            InputError: There are boxes without masks, and nothing that turns one into the other.
        """
        image = blank(view) if image is None else image
        found = self.detector.find(view, image)
        masks: Any = found.masks
        if masks is None and self.generator is not None:
            masks = self.generator.in_boxes(image, found.boxes)
        if masks is None:
            raise InputError(f"{self.what}: view {view.stem} has boxes without masks; add +sam:PATH to get them")
        ranks = torch.full((len(masks),), UNRANKED)
        return ViewMasks.without_empty(masks.cpu(), ranks, found.names)
