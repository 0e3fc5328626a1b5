"""Localisation: does the best pixel of a query lie on its object?"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from sgwarp.errors import InputError

Box = tuple[float, float, float, float]  # x1, y1, x2, y2 [pixels], corners included


def hits_mask(pixel: tuple[int, int], mask: Tensor) -> bool:
    """Whether pixel (x, y) lies on the object's mask, bool [H, W].

    Raises:
        InputError: The pixel lies outside the mask's image.
    """
    x, y = pixel
    height, width = mask.shape
    if not (0 <= x < width and 0 <= y < height):
        raise InputError(f"pixel ({x}, {y}) lies outside the {width} x {height} mask")
    return bool(mask[y, x])


def hits_box(score_map: Tensor, boxes: Sequence[Box]) -> bool:
    """Whether any pixel with the largest score lies in any of the object's boxes (the LERF protocol).

    Args:
        score_map: float [H, W]; -inf where nothing is known.
        boxes: The object's boxes, one per occurrence.
    """
    if not bool(torch.isfinite(score_map).any()):
        return False
    rows, columns = (score_map == score_map.max()).nonzero(as_tuple=True)
    return any(
        bool(((columns >= x1) & (columns <= x2) & (rows >= y1) & (rows <= y2)).any()) for x1, y1, x2, y2 in boxes
    )
