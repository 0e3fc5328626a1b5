"""gsplat's stages between splats and pixels: tile intersections, compositing, explicit pairs, harmonics."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from sgwarp.compat.gsplat.checks import expect_shape, expect_tile_size
from sgwarp.errors import InputError
from sgwarp.ops.planar.harmonics import harmonics_sum
from sgwarp.ops.planar.intersections import first_entries, intersect_boxes
from sgwarp.ops.planar.pixel_lists import composite_pairs, contributors_in_range
from sgwarp.ops.planar.splats import ListedSplats, SplatJob, composite_splats, factors_from_conics
from sgwarp.runs.isolation import isolated
from sgwarp.scene.checks import require_finite

ALPHA_MAX = 0.999
MAX_SH_DEGREE = 4


@isolated
def isect_tiles(
    means2d: Tensor,
    radii: Tensor,
    depths: Tensor,
    tile_size: int,
    tile_width: int,
    tile_height: int,
    sort: bool = True,
    segmented: bool = False,
    packed: bool = False,
    n_images: int | None = None,
    image_ids: Tensor | None = None,
    gaussian_ids: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Tiles that the bounding boxes of splats touch, as in `gsplat.isect_tiles`.

    Args:
        means2d: Centres [pixels], [..., N, 2], or [nnz, 2] if packed.
        radii: Half sizes of the boxes [pixels], zero for what is hidden; shaped like `means2d`.
        depths: z [m], [..., N] or [nnz].
        tile_size: Side of a tile [pixels].
        tile_width, tile_height: Columns and rows of tiles.
        sort: By image, tile and depth; ties keep the order of the rows.
        segmented: How gsplat sorts; the result is the same, and so is the sort here.
        packed: The tensors hold visible splats of `n_images` images, `image_ids` [nnz] says whose.
        gaussian_ids: Not needed.

    Returns:
        Tiles per splat, int32 [..., N] or [nnz]; keys image | tile | depth, int64 [n]; flat rows, int32 [n].
    """
    if packed:
        if image_ids is None or n_images is None:
            raise InputError(f"{'image_ids' if image_ids is None else 'n_images'}: needed with packed=True")
        shape: tuple[int, ...] = (len(means2d),)
        count, images = n_images, image_ids
    else:
        shape = tuple(means2d.shape[:-1])
        count = math.prod(shape[:-1])
        images = torch.arange(count, device=means2d.device).repeat_interleave(shape[-1])
    expect_shape("means2d", means2d, (*shape, 2))
    expect_shape("radii", radii, (*shape, 2))
    expect_shape("depths", depths, shape)
    tiles, keys, rows = intersect_boxes(
        means2d.reshape(-1, 2),
        radii.reshape(-1, 2),
        depths.reshape(-1),
        images,
        count,
        tile_size,
        tile_width,
        tile_height,
        sort,
    )
    return tiles.reshape(shape), keys, rows


def isect_offset_encode(isect_ids: Tensor, n_images: int, tile_width: int, tile_height: int) -> Tensor:
    """First entry of each tile in sorted `isect_ids`, int32 [n_images, tile_height, tile_width]."""
    return first_entries(isect_ids, n_images, tile_width, tile_height)


@isolated
def rasterize_to_pixels(
    means2d: Tensor,
    conics: Tensor,
    colors: Tensor,
    opacities: Tensor,
    image_width: int,
    image_height: int,
    tile_size: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
    backgrounds: Tensor | None = None,
    masks: Tensor | None = None,
    packed: bool = False,
    absgrad: bool = False,
) -> tuple[Tensor, Tensor]:
    """Composite splats in the order of given tile lists, as `gsplat.rasterize_to_pixels` does.

    Args:
        means2d: Centres [pixels], [..., N, 2], or [nnz, 2] if packed.
        conics: (A, B, C) of the inverse covariances [1 / pixels^2], [..., N, 3] or [nnz, 3].
        colors: Any number of channels D > 0, [..., N, D] or [nnz, D].
        opacities: [..., N] or [nnz].
        image_width, image_height: [pixels].
        tile_size: 16.
        isect_offsets, flatten_ids: Tile lists of `isect_offset_encode`, [..., rows, columns], and `isect_tiles`, [n].
        backgrounds: [..., D].
        masks: Tiles to render, bool [..., rows, columns]; the others show the background, with an opacity of zero.
        packed: The tensors hold visible splats only.
        absgrad: Leave the sum of the magnitudes of each pixel's gradient in `means2d.absgrad`.

    Returns:
        Colours [..., H, W, D] and opacities [..., H, W, 1]; differentiable in means2d, conics, colors, opacities and
        backgrounds.
    """
    expect_tile_size(tile_size)
    columns, rows = -(-image_width // tile_size), -(-image_height // tile_size)
    lead = tuple(isect_offsets.shape[:-2])
    splats = (means2d.shape[0],) if packed else (*lead, means2d.shape[-2])
    channels = colors.shape[-1]
    if channels == 0:
        raise InputError("colors: expected at least one channel")
    shapes = {"means2d": (*splats, 2), "conics": (*splats, 3), "colors": (*splats, channels), "opacities": splats}
    for name, tensor in (("means2d", means2d), ("conics", conics), ("colors", colors), ("opacities", opacities)):
        expect_shape(name, tensor, shapes[name])
    expect_shape("isect_offsets", isect_offsets, (*lead, rows, columns))
    if backgrounds is not None:
        expect_shape("backgrounds", backgrounds, (*lead, channels))
        require_finite("backgrounds", backgrounds)
    if masks is not None:
        expect_shape("masks", masks, (*lead, rows, columns))

    count = math.prod(lead)
    flat = [t.reshape(-1, *t.shape[len(splats) :]) for t in (means2d, conics, colors, opacities)]
    absolute = torch.zeros_like(flat[0]) if absgrad else None
    if absolute is not None:
        means2d.absgrad = absolute.view(means2d.shape)  # type: ignore[attr-defined]
    ends = [*isect_offsets.reshape(count, -1)[:, 0].tolist(), len(flatten_ids)]
    colors_out, alphas_out = [], []
    for i in range(count):
        listed = flatten_ids[ends[i] : ends[i + 1]]
        offsets = torch.empty(rows * columns + 1, dtype=torch.int32, device=means2d.device)
        offsets[:-1] = isect_offsets.reshape(count, -1)[i] - ends[i]
        offsets[-1] = len(listed)
        if masks is not None:
            listed, offsets = _only_tiles(masks.reshape(count, -1)[i], listed, offsets)
        # Rows that this image may list: a view of them alone, so that gradients of others are not even zeroed.
        first, last = (int(listed.min()), int(listed.max()) + 1) if len(listed) else (0, 0)
        part = [t[first:last] for t in flat]
        receive = None if absolute is None else _writer(absolute[first:last])
        job = SplatJob(image_width, image_height, given=ListedSplats(listed - first, offsets), receive_absolute=receive)
        nothing = torch.zeros(last - first, device=means2d.device)
        image, transmittance, alpha, _ = composite_splats(
            part[0], factors_from_conics(part[1]), part[3], part[2], nothing, job
        )
        if backgrounds is not None:
            image = image + transmittance[..., None] * backgrounds.reshape(count, channels)[i]
        colors_out.append(image)
        alphas_out.append(alpha[..., None])
    shape = (*lead, image_height, image_width)
    return torch.stack(colors_out).reshape(*shape, channels), torch.stack(alphas_out).reshape(*shape, 1)


def _writer(rows: Tensor) -> Callable[[Tensor], None]:
    """A function that writes values into rows of a table."""

    def write(values: Tensor) -> None:
        rows.copy_(values)

    return write


def _only_tiles(mask: Tensor, listed: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor]:
    """Tile lists without those of the tiles that are not set in `mask`."""
    sizes = offsets.diff()
    kept = torch.repeat_interleave(mask, sizes)
    return listed[kept], torch.cat([offsets[:1], (sizes * mask).cumsum(0, dtype=torch.int32)])


@isolated
def rasterize_to_indices_in_range(
    range_start: int,
    range_end: int,
    transmittances: Tensor,
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    image_width: int,
    image_height: int,
    tile_size: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Pairs of contributing splats and pixels, as in `gsplat.rasterize_to_indices_in_range`.

    Args:
        range_start, range_end: Batches of tile_size^2 entries of every tile's list to look at; the end is excluded.
        transmittances: In front of that range, [..., H, W].
        means2d, conics, opacities: Splats [pixels, 1 / pixels^2], [..., N, 2], [..., N, 3], [..., N].
        isect_offsets, flatten_ids: Tile lists.

    Returns:
        gaussian_ids, pixel_ids (row-major) and image_ids, int64 [M] each: pixel by pixel, front to back.
    """
    lead, N = tuple(means2d.shape[:-2]), means2d.shape[-2]
    expect_shape("transmittances", transmittances, (*lead, image_height, image_width))
    expect_shape("conics", conics, (*lead, N, 3))
    expect_shape("opacities", opacities, (*lead, N))
    columns, rows = -(-image_width // tile_size), -(-image_height // tile_size)
    expect_shape("isect_offsets", isect_offsets, (*lead, rows, columns))
    per_batch = tile_size * tile_size
    splats, pixels = contributors_in_range(
        (int(range_start) * per_batch, int(range_end) * per_batch),
        transmittances.detach().reshape(-1, image_height, image_width),
        means2d.detach().reshape(-1, 2),
        conics.detach().reshape(-1, 3),
        opacities.detach().reshape(-1),
        isect_offsets.reshape(-1, rows, columns),
        flatten_ids,
        tile_size,
    )
    size = image_height * image_width
    return splats % max(N, 1), pixels % size, pixels // size


@isolated
def accumulate(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    colors: Tensor,
    gaussian_ids: Tensor,
    pixel_ids: Tensor,
    image_ids: Tensor,
    image_width: int,
    image_height: int,
) -> tuple[Tensor, Tensor]:
    """Composite pairs of splat and pixel in plain torch, as `gsplat.accumulate` does (which asks for nerfacc).

    Args:
        means2d, conics, opacities, colors: [..., N, 2], [..., N, 3], [..., N], [..., N, D].
        gaussian_ids, pixel_ids, image_ids: Pairs, [M] each; those of one pixel stand front to back.

    Returns:
        Colours [..., H, W, D] and opacities [..., H, W, 1], differentiable in the first four. Pairs of splats that are
        not finite are left out.
    """
    lead, N, channels = tuple(means2d.shape[:-2]), means2d.shape[-2], colors.shape[-1]
    expect_shape("conics", conics, (*lead, N, 3))
    expect_shape("opacities", opacities, (*lead, N))
    expect_shape("colors", colors, (*lead, N, channels))
    rows = image_ids * N + gaussian_ids
    parts = (t.detach().reshape(math.prod(lead) * N, -1) for t in (means2d, conics, opacities, colors))
    finite = torch.isfinite(torch.stack([part.sum(dim=1, dtype=torch.float64) for part in parts]).sum(dim=0))
    kept = finite[rows].nonzero()[:, 0]
    rows, pixel_ids, image_ids = rows[kept], pixel_ids[kept], image_ids[kept]
    at = torch.stack([pixel_ids % image_width, pixel_ids // image_width], dim=1) + 0.5
    dx, dy = (at - means2d.reshape(-1, 2)[rows]).unbind(1)
    A, B, C = conics.reshape(-1, 3)[rows].unbind(1)
    power = 0.5 * (A * dx * dx + C * dy * dy) + B * dx * dy
    alphas = (opacities.reshape(-1)[rows] * torch.exp(-power)).clamp(max=ALPHA_MAX)
    size = image_height * image_width
    count = math.prod(lead) * size
    image, alpha = composite_pairs(alphas, colors.reshape(-1, channels)[rows], image_ids * size + pixel_ids, count)
    shape = (*lead, image_height, image_width)
    return image.reshape(*shape, channels), alpha.reshape(*shape, 1)


@isolated
def spherical_harmonics(degrees_to_use: int, dirs: Tensor, coeffs: Tensor, masks: Tensor | None = None) -> Tensor:
    """Real spherical harmonics summed with coefficients, as `gsplat.spherical_harmonics` does.

    Args:
        degrees_to_use: 0 to 4, no more than there are coefficients for.
        dirs: Directions of any length, [..., 3].
        coeffs: [..., K, 3].
        masks: Rows to evaluate, [...]; the others are zero.

    Returns:
        [..., 3]; colours are this plus 0.5, clamped at 0.
    """
    lead = tuple(dirs.shape[:-1])
    expect_shape("dirs", dirs, (*lead, 3))
    expect_shape("coeffs", coeffs, (*lead, None, 3))
    expect_degree("degrees_to_use", degrees_to_use, coeffs.shape[-2])
    directions, coefficients = dirs.reshape(-1, 3), coeffs.reshape(-1, *coeffs.shape[-2:])
    if masks is None:
        return harmonics_sum(directions, coefficients, degrees_to_use).reshape(*lead, 3)
    expect_shape("masks", masks, lead)
    index = masks.reshape(-1).nonzero()[:, 0]
    values = harmonics_sum(directions[index], coefficients[index], degrees_to_use)
    return values.new_zeros(len(directions), 3).index_copy(0, index, values).reshape(*lead, 3)


def expect_degree(name: str, degree: int, coefficients: int) -> None:
    """Raise unless there are coefficients for the degree."""
    if not 0 <= degree <= MAX_SH_DEGREE or (degree + 1) ** 2 > coefficients:
        raise InputError(f"{name}: expected 0 to 4 with (degree + 1)^2 <= {coefficients} coefficients, got {degree}")
