"""gsplat 1.5.3's functions: `from sgwarp.compat import gsplat`, on the CPU as on CUDA.

Names, arguments, shapes and the keys of `meta` are gsplat's. What differs: tile lists hold exactly the tiles that a
footprint reaches instead of those of its bounding box, Gaussians that are not finite are left out, and everything is
deterministic on the CPU.
"""

from __future__ import annotations

from enum import Enum
from typing import Any

import torch
from torch import Tensor

from sgwarp.compat.gsplat.checks import expect_choice, expect_shape, expect_tile_size, refuse, widen
from sgwarp.compat.gsplat.meta import Images, ListTable, SplatTable
from sgwarp.compat.gsplat.pixels import accumulate as accumulate
from sgwarp.compat.gsplat.pixels import expect_degree
from sgwarp.compat.gsplat.pixels import isect_offset_encode as isect_offset_encode
from sgwarp.compat.gsplat.pixels import isect_tiles as isect_tiles
from sgwarp.compat.gsplat.pixels import rasterize_to_indices_in_range as rasterize_to_indices_in_range
from sgwarp.compat.gsplat.pixels import rasterize_to_pixels as rasterize_to_pixels
from sgwarp.compat.gsplat.pixels import spherical_harmonics as spherical_harmonics
from sgwarp.compat.gsplat.projection import fully_fused_projection as fully_fused_projection
from sgwarp.compat.gsplat.projection import project_images
from sgwarp.compat.gsplat.projection import quat_scale_to_covar_preci as quat_scale_to_covar_preci
from sgwarp.ops.planar.harmonics import harmonic_colors
from sgwarp.ops.planar.projection import CAMERA_MODELS, ProjectedSplats, ProjectionSettings, select_rows
from sgwarp.ops.planar.splats import SplatJob, composite_splats
from sgwarp.ops.planar.tables import ShadeTable
from sgwarp.runs.isolation import isolated
from sgwarp.scene.checks import require_finite

RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
RASTERIZE_MODES = ("classic", "antialiased")


class RollingShutterType(Enum):
    """Readout order of a sensor; only GLOBAL is supported."""

    ROLLING_TOP_TO_BOTTOM = 0
    ROLLING_LEFT_TO_RIGHT = 1
    ROLLING_BOTTOM_TO_TOP = 2
    ROLLING_RIGHT_TO_LEFT = 3
    GLOBAL = 4


@isolated
def rasterization(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = 16,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: str = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    ftheta_coeffs: Any = None,
    rolling_shutter: Any = RollingShutterType.GLOBAL,
    viewmats_rs: Tensor | None = None,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render scenes from cameras, as `gsplat.rasterization` does.

    Args:
        means: Centres [m], [..., N, 3].
        quats, scales: Rotations (w, x, y, z) of any length, [..., N, 4], and standard deviations [m], [..., N, 3].
        opacities: In [0, 1], [..., N].
        colors: [..., N, D] or per camera [..., C, N, D], any D; with `sh_degree` coefficients [..., (C,) N, K, 3].
        viewmats: World to camera, OpenCV axes, [..., C, 4, 4].
        Ks: Intrinsics [pixels], [..., C, 3, 3]; without gradient.
        width, height: Image size [pixels].
        near_plane, far_plane: Range of depth that is rendered [m].
        radius_clip: Splats whose radii are at most this are left out [pixels].
        eps2d: Added to both projected variances [pixels^2].
        sh_degree: Degree of spherical harmonics to use, 0 to 4; None takes `colors` as they are.
        packed: `meta` holds only visible rows; the images are the same.
        tile_size: 16.
        backgrounds: Seen through what is left transparent, [..., C, D].
        render_mode: "RGB", "D" (sum of alpha T z), "ED" (its mean), "RGB+D" or "RGB+ED", depth last.
        sparse_grad: With `packed`: gradients of means, quats and scales as sparse tensors.
        absgrad: Leave the sum of the magnitudes of each pixel's gradient in `meta["means2d"].absgrad`.
        rasterize_mode: "classic", or "antialiased": opacities scaled by the area that eps2d added.
        channel_chunk, segmented: Accepted; they change nothing here.
        camera_model: "pinhole", "ortho" or "fisheye".
        covars: Covariances [m^2] instead of `quats` and `scales`, [..., N, 3, 3].

    Tensors of half precision are computed with in float32, and so are the images; gradients come in their own type.
    Not supported are distributed, with_ut, with_eval3d, radial_coeffs, tangential_coeffs, thin_prism_coeffs,
    ftheta_coeffs, viewmats_rs and rolling shutters.

    Returns:
        Images [..., C, H, W, X], opacities [..., C, H, W, 1] and `meta`: batch_ids, camera_ids, gaussian_ids (None
        unless packed), radii, means2d, depths, conics, opacities, tile_width, tile_height, tiles_per_gauss, isect_ids,
        flatten_ids, isect_offsets, width, height, tile_size, n_batches, n_cameras. Images and opacities are
        differentiable in every float tensor but Ks; `meta["means2d"]` lies on the way, so its gradient can be retained.

    Raises:
        InputError: Naming the argument that does not fit or is not supported.
    """
    refuse(
        distributed=distributed,
        with_ut=with_ut,
        with_eval3d=with_eval3d,
        radial_coeffs=radial_coeffs,
        tangential_coeffs=tangential_coeffs,
        thin_prism_coeffs=thin_prism_coeffs,
        ftheta_coeffs=ftheta_coeffs,
        rolling_shutter=None if getattr(rolling_shutter, "name", "") == "GLOBAL" else rolling_shutter,
        viewmats_rs=viewmats_rs,
    )
    means, quats, scales, opacities, colors = widen(means, quats, scales, opacities, colors)
    viewmats, Ks, backgrounds, covars = widen(viewmats, Ks, backgrounds, covars)
    expect_tile_size(tile_size)
    expect_choice("render_mode", render_mode, RENDER_MODES)
    expect_choice("rasterize_mode", rasterize_mode, RASTERIZE_MODES)
    expect_choice("camera_model", camera_model, CAMERA_MODELS)
    images = Images.of(means, viewmats)
    batch, N, C = images.batch_dims, images.gaussians, images.cameras
    if covars is not None:
        expect_shape("covars", covars, (*batch, N, 3, 3))
    expect_shape("opacities", opacities, (*batch, N))
    last = (None,) if sh_degree is None else (None, 3)
    expect_shape("colors", colors, (*batch, N, *last), (*batch, C, N, *last))
    if sh_degree is not None:
        expect_degree("sh_degree", sh_degree, colors.shape[-2])
    channels = colors.shape[-1]
    if backgrounds is not None:
        expect_shape("backgrounds", backgrounds, (*batch, C, channels))
        require_finite("backgrounds", backgrounds)

    antialiased = rasterize_mode == "antialiased"
    settings = ProjectionSettings(camera_model, near_plane, far_plane, eps2d, radius_clip, antialiased)
    sparse = sparse_grad and packed
    splats = project_images(
        images, means, covars, quats, scales, opacities, viewmats, Ks, width, height, settings, sparse
    )
    table = SplatTable(images, splats, packed)
    opacity = [select_rows(images.scenes(opacities)[i // C], p.index) for i, p in enumerate(splats)]
    opacity = [o if p.compensations is None else o * p.compensations for o, p in zip(opacity, splats, strict=True)]
    means2d = table.join([p.means2d for p in splats])
    receivers = table.receive_absgrad(means2d) if absgrad else [None] * images.count
    lists = ListTable(table, width, height, tile_size)
    values: list[Tensor] = []
    if render_mode not in ("D", "ED"):
        values = _values(images, splats, means, viewmats, colors, sh_degree, sparse)
    renders, alphas = [], []
    for i, (p, centres) in enumerate(zip(splats, table.split(means2d), strict=True)):
        job = SplatJob(width, height, receive_absolute=receivers[i])
        background = None if backgrounds is None else backgrounds.reshape(-1, channels)[i]
        render, alpha = _render(p, centres, opacity[i], values[i] if values else None, background, render_mode, job)
        assert job.lists is not None
        lists.add(job.lists)
        renders.append(render)
        alphas.append(alpha)
    shape = (*batch, C, height, width)
    meta = {
        **table.ids(),
        "radii": table.join([p.radii for p in splats]),
        "means2d": means2d,
        "depths": table.join([p.depths for p in splats]),
        "conics": table.join([p.conics for p in splats]),
        "opacities": table.join(opacity),
        **lists.meta(),
    }
    return torch.stack(renders).reshape(*shape, -1), torch.stack(alphas).reshape(*shape, 1), meta


def _values(
    images: Images,
    splats: list[ProjectedSplats],
    means: Tensor,
    viewmats: Tensor,
    colors: Tensor,
    sh_degree: int | None,
    sparse: bool,
) -> list[Tensor]:
    """Values of the visible splats of each image, [V, D]: the given colors, or those of the harmonics."""
    trailing = 2 if sh_degree is None else 3
    shared = colors.ndim == len(images.batch_dims) + trailing
    source = images.scenes(colors) if shared else images.images(colors)
    values = []
    for i, (p, viewmat) in enumerate(zip(splats, images.images(viewmats), strict=True)):
        scene = i // images.cameras
        by_kernel = sh_degree is not None and sh_degree <= 3 and not sparse and colors.dtype == torch.float32
        if by_kernel and p.camera is not None:
            of_scene = images.scenes(means)[scene].contiguous(), source[scene if shared else i].contiguous()
            center = torch.linalg.inv_ex(viewmat.to(torch.float64))[0][:3, 3]  # unlike inv, it does not wait
            values.append(ShadeTable.apply(*of_scene, center, p.index, p.camera, sh_degree))
            continue
        rows = select_rows(source[scene if shared else i], p.index)
        if sh_degree is not None:
            center = torch.linalg.inv(viewmat.to(means.device, torch.float64))[:3, 3]
            mean = select_rows(images.scenes(means)[scene], p.index, sparse)
            directions = (mean.to(torch.float64) - center).to(mean)
            colors_of_rows, shown = harmonic_colors(directions, rows, sh_degree)
            rows = torch.where(shown[:, None], colors_of_rows, torch.nan)  # which is left out
        values.append(rows)
    return values


def _render(
    p: ProjectedSplats,
    centres: Tensor,
    opacities: Tensor,
    values: Tensor | None,
    background: Tensor | None,
    render_mode: str,
    job: SplatJob,
) -> tuple[Tensor, Tensor]:
    """One image [H, W, X] with the channels of a render mode, and its opacity [H, W, 1]."""
    depths = p.depths[:, None]
    channels = 0 if values is None else values.shape[1]
    wants_depth = render_mode != "RGB"
    # Three colours and depth share a pass of their own; otherwise depth is one more channel.
    job.wants_depth = wants_depth and channels == 3
    if values is None:
        values = depths
    elif wants_depth and not job.wants_depth:
        values = torch.cat([values, depths], dim=1)
    image, transmittance, alpha, depth = composite_splats(centres, p.factors, opacities, values, p.depths, job)
    transmittance, alpha = transmittance[..., None], alpha[..., None]
    depth = depth[..., None] if job.wants_depth else image[..., channels:]
    image = image[..., :channels]
    if background is not None and channels:
        image = image + transmittance * background
    if not wants_depth:
        return image, alpha
    if render_mode.endswith("ED"):
        depth = depth / alpha.clamp(min=1e-10)
    return torch.cat([image, depth], dim=2), alpha
