"""From masks with vectors to the pixels of a map: averaged where they overlap, or painted one over the other.

All of it gives id maps: pixels that the same masks cover share one vector, and a view has few of these.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import interpolate, normalize

MASKS_AT_ONCE = 64  # masks held as floating point numbers at a time


def cover_sets(masks: Tensor) -> tuple[Tensor, Tensor]:
    """Sets of masks that cover each pixel.

    Args:
        masks: bool [M, h, w].

    Returns:
        ids: Number of the set that covers each pixel, -1 where no mask does, int64 [h, w].
        members: Whether a mask belongs to a set, bool [S, M].
    """
    count, height, width = masks.shape
    pixels = np.zeros(height * width, np.int64)  # 0 is the empty set
    members = [np.zeros(count, bool)]
    flat = masks.flatten(1).cpu().numpy()
    for number in range(count):
        inside = np.flatnonzero(flat[number])
        # Every set that the mask meets is split: the part inside becomes a new set with the mask added.
        met, place = _met_sets(pixels[inside])
        pixels[inside] = len(members) + place
        for old in met:
            grown = members[old].copy()
            grown[number] = True
            members.append(grown)
    used, place = _met_sets(pixels)
    ids = place - int(0 in used)
    table = np.stack([members[k] for k in used if k != 0]) if (used != 0).any() else np.zeros((0, count), bool)
    return torch.from_numpy(ids.reshape(height, width)), torch.from_numpy(table)


def _met_sets(sets: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The numbers that occur, ascending, and for each entry its place among them; without sorting the pixels."""
    there = np.bincount(sets) > 0
    return np.flatnonzero(there), (np.cumsum(there) - 1)[sets]


def average(masks: Tensor, vectors: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Every pixel gets the mean of the unit vectors of the masks that cover it.

    Args:
        masks: bool [M, h, w].
        vectors: One per mask, normalised here before they are averaged, [M, C].
        weights: Weight of each mask in a mean, positive, [M]; 1 if None.

    Returns:
        ids: Row of the second result at each pixel, -1 where no mask is, int64 [h, w].
        means: float32 [S, C].
    """
    ids, members = cover_sets(masks)
    share = members.to(torch.float32)
    if weights is not None:
        share = share * weights.to(torch.float32)
    share = share / share.sum(dim=1, keepdim=True).clamp(min=1e-12)
    return ids, share @ normalize(vectors.to(torch.float32), dim=1)


def paint(masks: Tensor) -> Tensor:
    """Number of the mask at each pixel, the larger ones painted first and the smaller over them, int64 [h, w].

    -1 where there is none; of two masks of the same area the later one in the list lies on top.
    """
    areas = masks.flatten(1).sum(dim=1)
    ids = torch.full(masks.shape[1:], -1, dtype=torch.int64, device=masks.device)
    for number in torch.argsort(areas, descending=True, stable=True).tolist():
        ids[masks[number]] = number
    return ids


def mask_means(masks: Tensor, features: Tensor) -> Tensor:
    """Mean of a map inside each mask, read bilinearly where it is coarser than the masks, float32 [M, C].

    Args:
        masks: bool [M, H, W], none of them empty.
        features: [h, w, C].
    """
    rows = interpolation(masks.shape[1], features.shape[0])
    columns = interpolation(masks.shape[2], features.shape[1])
    sums = spread(masks, rows, columns).flatten(1) @ features.flatten(0, 1).to(torch.float32)
    return sums / masks.flatten(1).sum(dim=1)[:, None]


def spread(masks: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """Interpolation weights of each mask's pixels on a coarser map, float32 [M, h, w].

    The transpose of interpolation: features [h, w, C] read at the pixels of a mask add up to the sum over ij of this
    times features_ij, and no map at the size of the masks is ever made.

    Args:
        masks: bool [M, H, W].
        rows, columns: Interpolation weights, float32 [H, h] and [W, w].
    """
    parts = [torch.einsum("yi,myj->mij", rows, part.to(torch.float32) @ columns) for part in masks.split(MASKS_AT_ONCE)]
    return torch.cat(parts)


def interpolation(pixels: int, cells: int) -> Tensor:
    """Weights that read `cells` values bilinearly at `pixels` pixel centres, float32 [pixels, cells]."""
    position = (torch.arange(pixels, dtype=torch.float64) + 0.5) * cells / pixels - 0.5
    distance = (position.clamp(0, cells - 1)[:, None] - torch.arange(cells)).abs()
    return (1.0 - distance).clamp(min=0.0).to(torch.float32)


def rest_cells(uncovered: Tensor, cells: int) -> Tensor:
    """The uncovered pixels, bool [h, w], cut into masks by a grid of `cells` along the longer side, bool [K, h, w]."""
    height, width = uncovered.shape
    side = -(-max(height, width) // cells)
    row = torch.arange(height, device=uncovered.device) // side
    column = torch.arange(width, device=uncovered.device) // side
    number = row[:, None] * (int(column[-1]) + 1) + column
    wanted = number[uncovered].unique()
    return uncovered & (number == wanted[:, None, None])


def resize_masks(masks: Tensor, size: tuple[int, int]) -> Tensor:
    """Masks at another size, read at the nearest pixel, bool [M, h, w]."""
    if tuple(masks.shape[1:]) == size:
        return masks
    return interpolate(masks[None].to(torch.uint8), size, mode="nearest-exact")[0].to(torch.bool)
