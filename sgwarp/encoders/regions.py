"""Regions of an image that may be things: proposals, the squares around them, and means over them.

Image-level encoders need regions to look at. Where no mask model is at hand, the graph segmentation of Felzenszwalb and
Huttenlocher (Efficient Graph-Based Image Segmentation, 2004) gives them in under a tenth of a second; on plain surfaces
its regions follow objects more closely than superpixels of equal size do, so it is the default.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgwarp.errors import InputError

SMOOTHING = 0.5  # standard deviation of the blur before segmentation [pixels]
GREY = 127  # of what lies outside the image


Proposals = Literal["graph", "slic", "seeds", "selective"]


def propose_regions(image: NDArray[np.uint8], method: Proposals, scale: float, smallest: int = 1) -> NDArray[np.int32]:
    """Partition an image, uint8 [H, W, 3] RGB, into regions: their numbers from 0 on, int32 [H, W].

    Args:
        image: The image.
        method: "graph" (`segment_regions`), superpixels "slic" or "seeds" (Achanta et al. 2012; Van den Bergh et al.
            2012), or "selective" (Uijlings et al. 2013): the boxes of a fast selective search, painted from the
            largest to the smallest.
        scale: k of the graph segmentation, else the side of a superpixel or of the smallest box [pixels].
        smallest: Least area of a region of the graph segmentation [pixels].

    Raises:
        InputError: The method is unknown, or OpenCV comes without its contributed modules.
    """
    if method not in get_args(Proposals):
        raise InputError(f"proposals: '{method}' is not one of {', '.join(get_args(Proposals))}")
    if method == "graph":
        return segment_regions(image, scale, smallest)
    if method == "selective":
        return _paint_boxes(image, round(scale))
    return _superpixels(image, method, max(4, round(scale)))


def _superpixels(image: NDArray[np.uint8], method: str, side: int) -> NDArray[np.int32]:
    import cv2

    _segmentation()
    lab = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2LAB)
    height, width = image.shape[:2]
    if method == "slic":
        slic = cv2.ximgproc.createSuperpixelSLIC(lab, cv2.ximgproc.SLICO, side)
        slic.iterate(10)
        slic.enforceLabelConnectivity()
        return _numbered(np.asarray(slic.getLabels()))
    count = max(1, height * width // side**2)
    seeds = cv2.ximgproc.createSuperpixelSEEDS(width, height, 3, count, 4)
    seeds.iterate(lab, 10)
    return _numbered(np.asarray(seeds.getLabels()))


def _paint_boxes(image: NDArray[np.uint8], least: int) -> NDArray[np.int32]:
    search = _segmentation().createSelectiveSearchSegmentation()
    search.setBaseImage(np.ascontiguousarray(image[:, :, ::-1]))
    search.switchToSelectiveSearchFast()
    boxes = np.asarray(search.process())
    boxes = boxes[boxes[:, 2:].min(axis=1) >= least]
    painted = np.zeros(image.shape[:2], np.int32)
    order = np.argsort(-boxes[:, 2].astype(np.int64) * boxes[:, 3], kind="stable")
    for number, (x, y, wide, high) in enumerate(boxes[order], start=1):
        painted[y : y + high, x : x + wide] = number
    return _numbered(painted)


def _numbered(labels: NDArray[Any]) -> NDArray[np.int32]:
    """The same partition with numbers from 0 on without gaps."""
    return np.unique(labels, return_inverse=True)[1].reshape(labels.shape).astype(np.int32)


def segment_regions(image: NDArray[np.uint8], scale: float, smallest: int) -> NDArray[np.int32]:
    """Partition an image, uint8 [H, W, 3] RGB, into regions: their numbers from 0 on, int32 [H, W].

    Args:
        image: The image.
        scale: k of the paper: the larger, the larger the regions.
        smallest: Regions of fewer pixels are merged with a neighbour.

    Raises:
        InputError: OpenCV comes without its contributed modules.
    """
    segmenter = _segmentation().createGraphSegmentation(SMOOTHING, scale, smallest)
    regions: NDArray[np.int32] = segmenter.processImage(np.ascontiguousarray(image[:, :, ::-1]))
    return regions


def region_areas(regions: NDArray[np.int32]) -> NDArray[np.int64]:
    """Pixels of each region, [M]."""
    return np.bincount(regions.ravel())


def bounding_squares(regions: NDArray[np.int32], margin: float) -> NDArray[np.float64]:
    """Squares around the regions, `margin` times a region's longer side: x and y of the corner and the side, [M, 3].

    They are not cut at the edge of the image.
    """
    count = int(regions.max()) + 1
    low = np.full((2, count), np.iinfo(np.int64).max)
    high = np.full((2, count), -1)
    for axis, place in enumerate(np.indices(regions.shape)):
        np.minimum.at(low[axis], regions.ravel(), place.ravel())
        np.maximum.at(high[axis], regions.ravel(), place.ravel())
    side = margin * (high - low + 1).max(axis=0)
    middle_y, middle_x = (low + high + 1) / 2
    return np.stack([middle_x - side / 2, middle_y - side / 2, side], axis=1)


def cut_squares(image: NDArray[np.uint8], squares: NDArray[np.float64], side: int) -> NDArray[np.uint8]:
    """What an image shows in some squares, resized, uint8 [B, side, side, 3]; grey where they reach beyond it."""
    import cv2

    height, width = image.shape[:2]
    crops = np.empty((len(squares), side, side, 3), np.uint8)
    for crop, (x, y, length) in zip(crops, squares, strict=True):
        left, top, wide = round(x), round(y), max(1, round(length))
        inside = image[max(top, 0) : min(top + wide, height), max(left, 0) : min(left + wide, width)]
        above, before = max(-top, 0), max(-left, 0)
        below, after = wide - above - inside.shape[0], wide - before - inside.shape[1]
        whole = cv2.copyMakeBorder(inside, above, below, before, after, cv2.BORDER_CONSTANT, value=(GREY,) * 3)
        crop[:] = cv2.resize(whole, (side, side), interpolation=cv2.INTER_AREA if wide > side else cv2.INTER_CUBIC)
    return crops


def region_means(regions: NDArray[np.int32], rows: Tensor, columns: Tensor, values: Tensor) -> Tensor:
    """Mean over each region of a map that is read between its locations.

    Args:
        regions: Partition of an image, [H, W].
        rows, columns: Interpolation weights, float32 [H, h] and [W, w].
        values: The map, float32 [h, w, K].

    Returns:
        float32 [M, K].
    """
    h, w = values.shape[:2]
    count = int(regions.max()) + 1
    weights = np.zeros(count * h * w)
    for i, row_weight in _two_nearest(rows):
        for j, column_weight in _two_nearest(columns):
            cell = (regions.astype(np.int64) * h + i[:, None]) * w + j
            weights += np.bincount(cell.ravel(), np.outer(row_weight, column_weight).ravel(), len(weights))
    per_region = torch.from_numpy(weights.reshape(count, h * w)).to(torch.float32)
    return (per_region @ values.reshape(h * w, -1)) / torch.from_numpy(region_areas(regions))[:, None]


def _two_nearest(weights: Tensor) -> Sequence[tuple[NDArray[np.int64], NDArray[np.float32]]]:
    """The (at most) two locations that each pixel reads, and how much of each: two pairs of [pixels] arrays."""
    values, places = weights.topk(min(2, weights.shape[1]), dim=1)
    return [(places[:, n].numpy(), values[:, n].numpy()) for n in range(values.shape[1])]


def _segmentation() -> Any:
    import cv2

    if not hasattr(cv2, "ximgproc"):
        raise InputError("this OpenCV lacks ximgproc; replace it: pip install opencv-contrib-python-headless")
    return cv2.ximgproc.segmentation
