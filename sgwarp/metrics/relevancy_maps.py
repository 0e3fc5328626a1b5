"""Score maps of several levels into one pixel or one mask, as LERF and LangSplat do on the LERF-OVS annotations.

Read in `eval/evaluate_iou_loc.py` of LangSplat's release. Its traps are kept on purpose: published numbers depend on
them. The box has an even side, so it reaches 15 pixels to the left and up and 14 to the right and down; the border is
mirrored without repeating the edge pixel; the majority filter leaves out the last row and column near them.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sgwarp.errors import InputError

SIDE = 30  # of the box [pixels]
LEVEL = 0.4  # of a stretched map, above which a pixel belongs to the mask
MAJORITY = 3  # pixels to each side


@dataclass(frozen=True, eq=False)
class Located:
    """Where a query is.

    Attributes:
        level: The level whose averaged map has the highest maximum; the first of equals.
        pixels: All pixels with that maximum, (x, y), int64 [K, 2].
    """

    level: int
    pixels: Tensor


def box_filter(maps: Tensor, side: int = SIDE) -> Tensor:
    """Mean over the `side` x `side` box at each pixel, the border mirrored without its edge (OpenCV's filter2D).

    Args:
        maps: float [L, H, W].
        side: Of the box; an even one reaches one pixel further left and up.

    Returns:
        float32 [L, H, W].

    Raises:
        InputError: The maps have another shape.
    """
    if maps.ndim != 3:
        raise InputError(f"maps: expected [levels, H, W], got {list(maps.shape)}")
    before = side // 2
    smooth = maps.double()
    for axis in (1, 2):
        size = smooth.shape[axis]
        place = _mirrored(torch.arange(-before, size + side - 1 - before, device=maps.device), size)
        running = torch.cat([torch.zeros_like(smooth.narrow(axis, 0, 1)), smooth.index_select(axis, place)], dim=axis)
        running = running.cumsum(axis)
        smooth = (running.narrow(axis, side, size) - running.narrow(axis, 0, size)) / side
    return smooth.to(torch.float32)


def _mirrored(place: Tensor, size: int) -> Tensor:
    """Indices outside 0 to size - 1 as their mirror images, the edge itself not repeated: -1 is 1."""
    if size == 1:
        return torch.zeros_like(place)
    place = place.remainder(2 * size - 2)
    return torch.minimum(place, 2 * size - 2 - place)


def locate(maps: Tensor, side: int = SIDE) -> Located:
    """The level and the pixels of a query.

    Args:
        maps: Relevancy of one query by level, float [L, H, W].
        side: Of the box that each map is averaged over first.
    """
    smooth = box_filter(maps, side)
    level = int(smooth.flatten(1).amax(dim=1).argmax())
    rows, columns = (smooth[level] == smooth[level].max()).nonzero(as_tuple=True)
    return Located(level, torch.stack([columns, rows], dim=1).cpu())


def hits_any_box(pixels: Tensor, boxes: Tensor) -> bool:
    """Whether any pixel lies in any box; corners may be in any order and belong to the box.

    Args:
        pixels: (x, y), [K, 2].
        boxes: x1, y1, x2, y2, [B, 4].
    """
    low, high = torch.minimum(boxes[:, :2], boxes[:, 2:]), torch.maximum(boxes[:, :2], boxes[:, 2:])
    inside = (pixels[:, None] >= low[None]) & (pixels[:, None] <= high[None])
    return bool(inside.all(dim=2).any())


def to_mask(maps: Tensor, threshold: float = LEVEL, side: int = SIDE) -> tuple[Tensor, int]:
    """The mask of a query.

    The map and its box mean are averaged, the level with the highest maximum of that is chosen, stretched to 0 to 1,
    of which the lower half becomes 0, compared with the threshold, and a majority filter runs over the result.

    Args:
        maps: Relevancy of one query by level, float [L, H, W].
        threshold: Of the stretched map.
        side: Of the box.

    Returns:
        mask: bool [H, W].
        level: The chosen level.
    """
    blended = 0.5 * (box_filter(maps, side) + maps.to(torch.float32))
    level = int(blended.flatten(1).amax(dim=1).argmax())
    stretched = blended[level] - blended[level].min()
    stretched = (2.0 * stretched / (stretched.max() + 1e-9) - 1.0).clamp(0.0, 1.0)
    return majority(stretched > threshold), level


def majority(mask: Tensor, reach: int = MAJORITY) -> Tensor:
    """What most pixels of the square around each pixel are, bool [H, W]; nothing where half are.

    Near the lower and right edge the square ends before the last row and column, as in LangSplat's release.
    """
    height, width = mask.shape
    if height < 2 or width < 2:
        return mask.bool()
    sums = torch.zeros(height + 1, width + 1, dtype=torch.int64)
    sums[1:, 1:] = mask.cpu().long().cumsum(0).cumsum(1)
    top, bottom = _window(height, reach)
    left, right = _window(width, reach)
    inside = sums[bottom][:, right] - sums[top][:, right] - sums[bottom][:, left] + sums[top][:, left]
    area = (bottom - top)[:, None] * (right - left)[None]
    return (2 * inside > area).to(mask.device)


def _window(size: int, reach: int) -> tuple[Tensor, Tensor]:
    """First and one past the last index of the square at each place."""
    place = torch.arange(size)
    return (place - reach).clamp(min=0), (place + reach + 1).clamp(max=size - 1)
