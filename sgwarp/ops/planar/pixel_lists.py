"""Explicit pairs (Gaussian, pixel) of the rasterizer, and compositing over them with torch alone.

Far slower than rendering and far more memory, but every weight is at hand and autograd sees everything.
"""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.kernels.contributors import pairs as pixel_lists
from sgwarp.ops.arguments import view
from sgwarp.ops.launcher import launch
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.ops.splatting.tiles import knobs

MAX_PIXELS = 2**31 - 1


def contributors_in_range(
    listed_range: tuple[int, int],
    transmittances: Tensor,
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    offsets: Tensor,
    listed: Tensor,
    tile_size: int,
    settings: RasterSettings = RasterSettings(),  # noqa: B008 - frozen
) -> tuple[Tensor, Tensor]:
    """Pairs of splat and pixel that compositing would give a weight, pixel by pixel, front to back.

    Args:
        listed_range: Entries of every tile's list to look at, counted from the list's start: first, and first not.
        transmittances: Of each pixel in front of that range, float32 [I, H, W].
        means2d, conics, opacities: The splats [pixels, 1 / pixels^2], float32 [M, 2], [M, 3], [M].
        offsets: First entry of each tile, int32 [I, tile rows, tile columns].
        listed: Splat of each entry, front to back within a tile, int32 [n].
        tile_size: Side of a tile [pixels].

    Returns:
        Splats int64 [pairs] and pixels (image * H + row) * W + column, int64 [pairs].
    """
    images, height, width = transmittances.shape
    count = transmittances.numel()
    if count > MAX_PIXELS:
        raise InputError(f"{count} pixels exceed 2^31 - 1; ask for fewer images at a time")
    device = means2d.device
    ends = torch.cat([offsets.flatten().to(torch.int32), torch.tensor([len(listed)], dtype=torch.int32, device=device)])
    nothing = torch.empty(0, dtype=torch.int32, device=device)
    counts = torch.empty(count, dtype=torch.int32, device=device)
    inputs = [
        *(min(entry, len(listed)) for entry in listed_range),
        view(transmittances.to(torch.float32).flatten().contiguous(), wp.float32),
        view(means2d.to(torch.float32).contiguous(), wp.vec2),
        view(conics.to(torch.float32).contiguous(), wp.vec3),
        view(opacities.to(torch.float32).contiguous(), wp.float32),
        knobs(settings),
        *(width, height, tile_size, offsets.shape[-1], offsets.shape[-2]),
        view(ends, wp.int32),
        view(listed.to(torch.int32).contiguous(), wp.int32),
    ]
    outputs = [view(t, wp.int32) for t in (counts, nothing, nothing)]
    unplaced = view(torch.empty(0, dtype=torch.int64, device=device), wp.int64)
    launch(pixel_lists.make_list_contributors(False), count, [*inputs, unplaced], outputs, device=device)
    ends_of_pixels = counts.cumsum(0, dtype=torch.int64)
    places, total = ends_of_pixels - counts, int(ends_of_pixels[-1]) if images else 0
    splats, pixels = (torch.empty(total, dtype=torch.int32, device=device) for _ in range(2))
    outputs = [view(t, wp.int32) for t in (nothing, splats, pixels)]
    if total:
        placed = view(places, wp.int64)
        launch(pixel_lists.make_list_contributors(True), count, [*inputs, placed], outputs, device=device)
    return splats.to(torch.int64), pixels.to(torch.int64)


def composite_pairs(alphas: Tensor, features: Tensor, pixels: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Composite pairs of splat and pixel; differentiable in alphas and features.

    Args:
        alphas: Opacity of each pair at its pixel, below 1, [pairs].
        features: Of each pair's splat, [pairs, C].
        pixels: int64 [pairs]; the pairs of one pixel stand front to back.
        count: Number of pixels P.

    Returns:
        sum of alpha T features, [P, C], and accumulated opacity, [P].
    """
    if len(pixels) > 1 and bool((pixels[1:] < pixels[:-1]).any()):
        order = pixels.argsort(stable=True)
        alphas, features, pixels = alphas[order], features[order], pixels[order]
    # Transmittance as a difference of running sums of logarithms, in float64 because they run over all pixels.
    log_T = torch.log1p(-alphas.to(torch.float64))
    running = log_T.cumsum(0)
    first = torch.searchsorted(pixels, pixels)
    T = (running - log_T - (running - log_T)[first]).exp()
    weights = (alphas * T).to(features.dtype)
    image = features.new_zeros(count, features.shape[1]).index_add(0, pixels, weights[:, None] * features)
    return image, weights.new_zeros(count).index_add(0, pixels, weights)
