"""Tile lists as sorted 64-bit keys (image, tile, depth): the interchange form of CUDA rasterizers.

Rendering here never sorts intersections (`kernels/binning.py`); these lists are for callers that build their own.
"""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.ops.launcher import sort_pairs

DEPTH_BITS = 32
MAX_INTERSECTIONS = 2**30 - 1  # the sort takes twice the room, and Warp counts in int32


def tile_bits(tile_columns: int, tile_rows: int) -> int:
    """Bits of a key that hold the tile."""
    return (tile_columns * tile_rows).bit_length()


def intersection_keys(images: Tensor, tile: Tensor, depths: Tensor, bits: int) -> Tensor:
    """image << (32 + bits) | tile << 32 | bits of the depth as float32, int64 [n]."""
    depth_bits = depths.to(torch.float32).contiguous().view(torch.int32).to(torch.int64) & 0xFFFFFFFF
    return (images.to(torch.int64) << (DEPTH_BITS + bits)) | (tile.to(torch.int64) << DEPTH_BITS) | depth_bits


def intersect_boxes(
    means2d: Tensor,
    radii: Tensor,
    depths: Tensor,
    images: Tensor,
    image_count: int,
    tile_size: int,
    tile_columns: int,
    tile_rows: int,
    sort: bool = True,
) -> tuple[Tensor, Tensor, Tensor]:
    """Tiles that the bounding box of each splat touches.

    Args:
        means2d: Centres [pixels], [M, 2].
        radii: Half sizes of the boxes [pixels], [M, 2]; zero hides a splat.
        depths: Order within a tile, [M], not negative; ties keep the order of the rows.
        images: Image of each splat, int64 [M].

    Returns:
        Tiles of each splat, int32 [M]; keys, int64 [n]; rows of the splats, int32 [n].

    Raises:
        InputError: There are too many images and tiles for a key, or too many intersections.
    """
    bits = tile_bits(tile_columns, tile_rows)
    if bits + max(image_count, 1).bit_length() > 64 - DEPTH_BITS:
        tiles = f"{tile_columns} x {tile_rows}"
        raise InputError(
            f"{image_count} images of {tiles} tiles do not fit into 64-bit keys; pass fewer images at a time"
        )
    with torch.no_grad():
        limits = torch.tensor([tile_columns, tile_rows], device=means2d.device)
        first = ((means2d - radii) / tile_size).floor().clamp(min=0).minimum(limits)
        last = ((means2d + radii) / tile_size).ceil().clamp(min=0).minimum(limits)
        size = torch.where((radii > 0).all(1, keepdim=True), last - first, 0).nan_to_num(0.0).to(torch.int64)
        counts = size.prod(1)
        total = int(counts.sum())
        if total > MAX_INTERSECTIONS:
            raise InputError(f"{total} tile intersections exceed {MAX_INTERSECTIONS}; render at a lower resolution")
        rows = torch.repeat_interleave(torch.arange(len(counts), device=counts.device), counts, output_size=total)
        within = torch.arange(total, device=counts.device) - (counts.cumsum(0) - counts)[rows]
        across = size[rows, 0]
        corner = first.to(torch.int64)[rows]
        tile = (corner[:, 1] + within // across) * tile_columns + corner[:, 0] + within % across
        keys = intersection_keys(images[rows], tile, depths[rows], bits)
        listed = rows.to(torch.int32)
        if sort and total:
            keys, listed = (torch.cat([t, torch.empty_like(t)]) for t in (keys, listed))
            sort_pairs(keys, listed, total, wp.int64)
            keys, listed = keys[:total].clone(), listed[:total].clone()
        return counts.to(torch.int32), keys, listed


def first_entries(keys: Tensor, image_count: int, tile_columns: int, tile_rows: int) -> Tensor:
    """First entry of each tile in sorted keys, int32 [images, tile rows, tile columns]."""
    bits = tile_bits(tile_columns, tile_rows)
    image = torch.arange(image_count, device=keys.device)[:, None] << bits
    wanted = (image | torch.arange(tile_columns * tile_rows, device=keys.device)) << DEPTH_BITS
    places = torch.searchsorted(keys.contiguous(), wanted.flatten().contiguous())
    return places.to(torch.int32).view(image_count, tile_rows, tile_columns)
