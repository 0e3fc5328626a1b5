"""The paper's three rules (Sec. III-B): how networks that see pixels, instances or images give one kind of map.

| network sees | rule | here |
|---|---|---|
| pixels | the mean of the features inside each mask of "everything", the larger painted first | `RefinedPixels` |
| instances | each box prompts SAM; the pixels of the mask get the text embedding of the instance | `PaintedInstances` |
| images | each mask is padded, cropped and resized to 224; its pixels get the embedding | `MaskedImages` |

Overlapping masks of the last two are averaged, after normalisation. The result is an id map wherever it can be: a few
dozen vectors per view, whose lifting does not depend on the number of channels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgwarp.encoders.base import (
    LEVELS,
    ImageEncoder,
    InstanceEncoder,
    MaskGenerator,
    Masks,
    PixelEncoder,
    RegionEncoder,
    TextEncoder,
)
from sgwarp.encoders.painting import average, mask_means, paint, resize_masks, rest_cells
from sgwarp.encoders.regions import box_squares, cut_squares, mask_boxes
from sgwarp.errors import InputError
from sgwarp.scene import FeatureMap, View

Rest = Literal["cells", "own", "none"]
REST_CELLS = 16  # cells along the longer side into which uncovered pixels are pooled


def as_pixels(image: Tensor) -> NDArray[np.uint8]:
    """An image, float [H, W, 3] in [0, 1], as uint8 on the CPU."""
    return (image.detach().clamp(0, 1) * 255).round().to("cpu", torch.uint8).numpy()


class Composed:
    """Base of the maps of all three rules: they need the image, and embed texts with their network."""

    needs_image = True
    space: str

    def __init__(self, speaker: Any) -> None:
        self._speaker = speaker

    def encode_text(self, texts: Sequence[str]) -> Tensor:
        """Unit vectors, float32 [Q, C], by the network's own text side.

        Raises:
            InputError: It has none.
        """
        if not isinstance(self._speaker, TextEncoder):
            raise InputError(f"space '{self.space}' has no text side here; add one: +text:clip:PATH, for instance")
        return self._speaker.encode_text(texts)

    @staticmethod
    def _image(view: View, image: Tensor | None) -> Tensor:
        if image is None:
            raise InputError(f"view {view.stem}: this encoder needs an image")
        return image


@dataclass(frozen=True)
class Crops:
    """A RegionEncoder out of an ImageEncoder: the square around each mask, cut out and resized.

    Attributes:
        encoder: Sees the squares.
        margin: Side of the square over the longer side of the mask.
        background: Whether what surrounds the mask stays visible, or is painted grey.
        batch: Squares encoded at once.
    """

    encoder: ImageEncoder
    margin: float = 1.2
    background: bool = True
    batch: int = 32

    @property
    def space(self) -> str:
        return self.encoder.space

    @property
    def identity(self) -> str:
        return f"crops({self.encoder.identity}, {self.margin}, {self.background})"

    def encode_regions(self, image: Tensor, masks: Tensor) -> Tensor:
        """Unit vectors, float32 [M, C]; the masks must not be empty."""
        pixels = as_pixels(image)
        squares = box_squares(mask_boxes(masks), self.margin) * (max(image.shape[:2]) / max(masks.shape[1:]))
        parts = []
        for start in range(0, len(masks), self.batch):
            chosen = slice(start, start + self.batch)
            crops = cut_squares(pixels, squares[chosen], self.encoder.side)
            if not self.background:
                crops = self._cut_out(crops, masks[chosen], squares[chosen], image.shape[0] / masks.shape[1])
            parts.append(self.encoder.encode_images(torch.from_numpy(crops)))
        return torch.cat(parts)

    def _cut_out(
        self, crops: NDArray[np.uint8], masks: Tensor, squares: NDArray[np.float64], scale: float
    ) -> NDArray[np.uint8]:
        """Crops with everything outside their masks in grey."""
        from sgwarp.encoders.regions import GREY

        for crop, mask, square in zip(crops, masks, squares, strict=True):
            white = np.repeat(mask.cpu().numpy()[..., None].astype(np.uint8) * 255, 3, axis=2)
            inside = cut_squares(white, square[None] / scale, self.encoder.side, outside=0)[0, :, :, 0] >= 128
            crop[~inside] = GREY
        return crops


class MaskedImages(Composed):
    """Image-level rule: the vector of every region at its pixels.

    Args:
        encoder: Gives one vector per mask.
        generator: Proposes the masks.
        levels: Levels of the id map, of LEVELS: "default" takes all masks, the others those of one rank.
    """

    def __init__(self, encoder: RegionEncoder, generator: MaskGenerator, levels: Sequence[str] = LEVELS[:1]) -> None:
        super().__init__(encoder.encoder if isinstance(encoder, Crops) else encoder)
        self.encoder, self.generator, self.levels = encoder, generator, tuple(levels)
        self.space = encoder.space

    def cache_key(self, view: View) -> str:
        parts = (self.encoder.identity, self.generator.identity, self.generator.identity_of(view))
        return f"images({', '.join(parts)}, {self.levels})"

    def encode(self, view: View, image: Tensor | None) -> FeatureMap:
        """Id map, one level for each of `levels`."""
        image = self._image(view, image)
        found = without_empty(self.generator.everything(view, image))
        chosen = [found.at_level(level) for level in self.levels]
        needed = torch.cat(chosen).unique()
        if not len(needed):
            raise InputError(f"view {view.stem}: the mask generator found no mask of level {', '.join(self.levels)}")
        vectors = self.encoder.encode_regions(image, found.masks[needed])
        return stack_levels(
            self.space,
            [average(found.masks[numbers], vectors[torch.searchsorted(needed, numbers)]) for numbers in chosen],
        )


class PlainPixels(Composed):
    """A pixel-level network as it is, without masks."""

    def __init__(self, encoder: PixelEncoder) -> None:
        super().__init__(encoder)
        self.encoder, self.space = encoder, encoder.space

    def cache_key(self, view: View) -> str:
        return f"pixels({self.encoder.identity})"

    def encode(self, view: View, image: Tensor | None) -> FeatureMap:
        """Dense map at the network's own resolution."""
        dense = self.encoder.encode_pixels(self._image(view, image)).cpu()
        return FeatureMap(self.space, dense=dense, labels=getattr(self.encoder, "labels", None))


class RefinedPixels(Composed):
    """Pixel-level rule: every mask gets the mean of the features inside it, the larger painted first.

    Args:
        encoder: Gives features per pixel.
        generator: Proposes the masks.
        rest: What becomes of pixels outside all masks: "cells" pools them within a grid, as if its cells were masks (so
            the map stays an id map), "own" keeps their features (the paper's way; the map is dense), "none" leaves
            them without semantics.
    """

    def __init__(self, encoder: PixelEncoder, generator: MaskGenerator, rest: Rest = "cells") -> None:
        if rest not in get_args(Rest):
            raise InputError(f"rest: '{rest}' is not one of {', '.join(get_args(Rest))}")
        super().__init__(encoder)
        self.encoder, self.generator, self.rest = encoder, generator, rest
        self.space = encoder.space

    def cache_key(self, view: View) -> str:
        parts = (self.encoder.identity, self.generator.identity, self.generator.identity_of(view))
        return f"refined({', '.join(parts)}, {self.rest})"

    def encode(self, view: View, image: Tensor | None) -> FeatureMap:
        """Id map; dense only if `rest` is "own" and some pixel lies outside all masks."""
        image = self._image(view, image)
        dense = self.encoder.encode_pixels(image).cpu()
        masks = without_empty(self.generator.everything(view, image)).masks.cpu()
        uncovered = ~masks.any(dim=0)
        if self.rest == "cells" and bool(uncovered.any()):
            masks = torch.cat([masks, rest_cells(uncovered, REST_CELLS)])
        if not len(masks):
            raise InputError(f"view {view.stem}: the mask generator found no mask")
        ids, means = paint(masks), mask_means(masks, dense)
        labels = getattr(self.encoder, "labels", None)
        if labels is not None or (self.rest == "own" and bool((ids < 0).any())):
            return FeatureMap(self.space, dense=self._dense(ids, means, dense), labels=labels)
        kept, places = ids[ids >= 0].unique(return_inverse=True)
        painted = torch.full_like(ids, -1)
        painted[ids >= 0] = places
        return FeatureMap(self.space, ids=painted, vectors=means[kept])

    def _dense(self, ids: Tensor, means: Tensor, dense: Tensor) -> Tensor:
        """At the resolution of the network: what the masks painted, and beside them its own features."""
        height, width = dense.shape[:2]
        row = ((2 * torch.arange(height) + 1) * ids.shape[0]) // (2 * height)
        column = ((2 * torch.arange(width) + 1) * ids.shape[1]) // (2 * width)
        at_cells = ids[row[:, None], column]
        rest = torch.zeros_like(dense) if self.rest == "none" else dense
        return torch.where((at_cells >= 0)[..., None], means[at_cells.clamp(min=0)], rest)


class PaintedInstances(Composed):
    """Instance-level rule: the pixels of every instance get the text embedding of its name.

    Args:
        detector: Finds instances.
        text: Embeds their names; the maps live in its space.
        generator: Turns boxes into masks; without one, instances that have no mask of their own are painted as boxes.
    """

    def __init__(self, detector: InstanceEncoder, text: TextEncoder, generator: MaskGenerator | None = None) -> None:
        super().__init__(text)
        self.detector, self.text, self.generator = detector, text, generator
        self.space = text.space

    def cache_key(self, view: View) -> str:
        masks = self.generator.identity if self.generator else "boxes"
        parts = (self.detector.identity, self.detector.identity_of(view), self.space, masks)
        return f"instances({', '.join(parts)})"

    def encode(self, view: View, image: Tensor | None) -> FeatureMap:
        """Id map; a view in which nothing was found has no id anywhere."""
        image = self._image(view, image)
        found = self.detector.find(view, image)
        if not found.names:
            empty = torch.zeros(0, self.text.encode_text(["object"]).shape[1])
            return FeatureMap(self.space, ids=torch.full(image.shape[:2], -1), vectors=empty)
        if found.masks is not None:
            masks = found.masks
        elif self.generator is not None:
            masks = self.generator.in_boxes(image, found.boxes)
        else:
            masks = box_masks(found.boxes, (image.shape[0], image.shape[1]))
        vectors = self.text.encode_text(found.names)
        ids, means = average(masks.cpu(), vectors.cpu(), found.scores.cpu())
        return FeatureMap(self.space, ids=ids, vectors=means)


def without_empty(masks: Masks) -> Masks:
    """Only the masks that cover at least one pixel."""
    kept = masks.masks.flatten(1).any(dim=1)
    return masks if bool(kept.all()) else Masks(masks.masks[kept], masks.scores[kept], masks.ranks[kept])


def box_masks(boxes: Tensor, size: tuple[int, int]) -> Tensor:
    """Boxes, [K, 4] as in Instances, as masks of an image: the pixels whose centre lies inside, bool [K, H, W]."""
    y = torch.arange(size[0], device=boxes.device) + 0.5
    x = torch.arange(size[1], device=boxes.device) + 0.5
    x1, y1, x2, y2 = boxes[:, :, None].unbind(dim=1)
    return ((y >= y1) & (y < y2))[:, :, None] & ((x >= x1) & (x < x2))[:, None, :]


def stack_levels(space: str, levels: Sequence[tuple[Tensor, Tensor]]) -> FeatureMap:
    """One id map of several levels, each with ids and vectors of its own."""
    ids, count = [], 0
    for level, vectors in levels:
        ids.append(torch.where(level >= 0, level + count, -1))
        count += len(vectors)
    return FeatureMap(space, ids=torch.stack(ids), vectors=torch.cat([vectors for _, vectors in levels]))


def combine_masks(parts: Sequence[Masks]) -> Masks:
    """The masks of several generators or scales, at the size of the first."""
    size = (parts[0].masks.shape[1], parts[0].masks.shape[2])
    return Masks(
        torch.cat([resize_masks(part.masks, size) for part in parts]),
        torch.cat([part.scores for part in parts]),
        torch.cat([part.ranks for part in parts]),
    )
