"""Squares of an image: around masks, cut out and resized for a network that sees one thing at a time."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

GREY = 127  # of what lies outside the image


def mask_boxes(masks: Tensor) -> Tensor:
    """Boxes of masks, none of them empty: x1, y1, x2, y2 with the far sides just beyond, int64 [M, 4]."""
    sides = []
    for axis in (1, 2):  # over y for the columns, over x for the rows
        there = masks.any(dim=axis).to(torch.int8)
        first, last = there.argmax(dim=1), there.shape[1] - there.flip(1).argmax(dim=1)
        sides.append((first, last))
    (x1, x2), (y1, y2) = sides
    return torch.stack([x1, y1, x2, y2], dim=1)


def box_squares(boxes: Tensor, margin: float) -> NDArray[np.float64]:
    """Squares around boxes [M, 4], `margin` times their longer side: x and y of the corner and the side, [M, 3].

    They are not cut at the edge of the image.
    """
    x1, y1, x2, y2 = boxes.cpu().to(torch.float64).numpy().T
    side = margin * np.maximum(x2 - x1, y2 - y1)
    return np.stack([(x1 + x2 - side) / 2, (y1 + y2 - side) / 2, side], axis=1)


def cut_squares(
    image: NDArray[np.uint8], squares: NDArray[np.float64], side: int, outside: int = GREY
) -> NDArray[np.uint8]:
    """Resized square crops of an image, uint8 [B, side, side, 3]; `outside` where they reach
    beyond it."""
    import cv2

    height, width = image.shape[:2]
    crops = np.empty((len(squares), side, side, 3), np.uint8)
    for crop, (x, y, length) in zip(crops, squares, strict=True):
        left, top, wide = round(x), round(y), max(1, round(length))
        inside = image[max(top, 0) : min(top + wide, height), max(left, 0) : min(left + wide, width)]
        above, before = max(-top, 0), max(-left, 0)
        below, after = wide - above - inside.shape[0], wide - before - inside.shape[1]
        whole = cv2.copyMakeBorder(inside, above, below, before, after, cv2.BORDER_CONSTANT, value=(outside,) * 3)
        crop[:] = cv2.resize(whole, (side, side), interpolation=cv2.INTER_AREA if wide > side else cv2.INTER_CUBIC)
    return crops
