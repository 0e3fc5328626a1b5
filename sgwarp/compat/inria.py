"""Inria's rasterizer (diff-gaussian-rasterization) and neighbour distances (simple-knn), on the CPU as on CUDA.

Names, arguments, transposed matrices, thresholds (near plane 0.2, opacity clamped at 0.99) and the return values are
Inria's: image and radii; with settings that say whether to antialias, as they do since October 2024, also the inverse
depth. What differs: a footprint ends where it falls below 1/255 instead of at the tiles of three standard
deviations, the principal point may lie off the image's centre, Gaussians that are not finite are left out.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from sgwarp.compat.gsplat.checks import widen
from sgwarp.errors import InputError
from sgwarp.ops.neighbors import mean_squared_neighbor_distance
from sgwarp.ops.planar.harmonics import harmonic_colors
from sgwarp.ops.planar.projection import (
    ProjectedSplats,
    ProjectionSettings,
    project_splats,
    select_rows,
    unpack_symmetric,
)
from sgwarp.ops.planar.splats import SplatJob, composite_splats
from sgwarp.ops.planar.tables import ShadeTable
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.runs.isolation import isolated
from sgwarp.scene import Camera
from sgwarp.scene.checks import require_finite

NEAR = 0.2  # [m]
ALPHA_MAX = 0.99
MAX_DEGREE = 3  # of the harmonics that kernels evaluate
MIN_AREA_RATIO = 2.5e-5  # of the antialiasing compensation
MIN_EIGENVALUE_GAP = 0.1  # under the root of the larger eigenvalue [pixels^4]
FOCAL_TOLERANCE = 1e-3  # relative, between tanfov and projmatrix


class GaussianRasterizationSettings(NamedTuple):
    """A camera and how to render it.

    Attributes:
        image_height, image_width: [pixels].
        tanfovx, tanfovy: Tangents of half the fields of view.
        bg: Background, [C].
        scale_modifier: Multiplies all scales.
        viewmatrix: World to camera, transposed (points are row vectors), [4, 4].
        projmatrix: `viewmatrix` times the transposed projection, [4, 4]; it may move the principal point.
        sh_degree: Degree of spherical harmonics to use.
        campos: Camera centre in the world [m], [3].
        prefiltered, debug: Accepted; they change nothing here.
        antialiasing: Scale opacities by the area that the low-pass filter added. None, for code from before October
            2024, which does not give it, is False, and the rasterizer then returns two values instead of three.
    """

    image_height: int
    image_width: int
    tanfovx: float
    tanfovy: float
    bg: Tensor
    scale_modifier: float
    viewmatrix: Tensor
    projmatrix: Tensor
    sh_degree: int
    campos: Tensor
    prefiltered: bool = False
    debug: bool = False
    antialiasing: bool | None = None


class GaussianRasterizer(torch.nn.Module):
    """Renders one image per call."""

    def __init__(self, raster_settings: GaussianRasterizationSettings) -> None:
        super().__init__()
        self.raster_settings = raster_settings

    def markVisible(self, positions: Tensor) -> Tensor:
        """Mask of the points [N, 3] in front of the near plane, bool [N]."""
        with torch.no_grad():
            view = self.raster_settings.viewmatrix
            require_finite("viewmatrix", view)
            return positions @ view[:3, 2].to(positions) + view[3, 2].to(positions) > NEAR

    @isolated
    def forward(
        self,
        means3D: Tensor,
        means2D: Tensor | None,
        opacities: Tensor,
        shs: Tensor | None = None,
        colors_precomp: Tensor | None = None,
        scales: Tensor | None = None,
        rotations: Tensor | None = None,
        cov3D_precomp: Tensor | None = None,
        dc: Tensor | None = None,
    ) -> tuple[Tensor, ...]:
        """Render.

        Args:
            means3D: Centres [m], [N, 3].
            means2D: Receives the gradient of the projected centres, in units of half the image's size; its values are
                not read, [N, 3] or [N, 2]; or None.
            opacities: In [0, 1], [N, 1] or [N].
            shs: Spherical-harmonic coefficients, [N, K, 3]; or:
            colors_precomp: Any number of channels, [N, C].
            scales, rotations: Standard deviations [m], [N, 3], and (w, x, y, z), [N, 4]; or:
            cov3D_precomp: Upper triangles of covariances [m^2], [N, 6].
            dc: The coefficients of degree 0, [N, 1, 3]; `shs` then holds those above, [N, K - 1, 3].

        Returns:
            Image [C, H, W]; without gradient, radii: three standard deviations along the longer axis, rounded up
            [pixels], int32 [N], zero for what is not seen; and, if the settings say whether to antialias, the inverse
            depth: the sum of alpha T / z [1 / m], [1, H, W].

        Raises:
            InputError: Naming the argument that does not fit, or a projection that is no pinhole camera.
        """
        settings = self.raster_settings
        means3D, means2D, opacities, shs, dc = widen(means3D, means2D, opacities, shs, dc)
        colors_precomp, scales, rotations, cov3D_precomp = widen(colors_precomp, scales, rotations, cov3D_precomp)
        if dc is not None:
            shs = _joined(dc, shs, len(means3D))
        _check(means3D, means2D, opacities, shs, colors_precomp, scales, rotations, cov3D_precomp, settings)
        width, height = int(settings.image_width), int(settings.image_height)
        opacities = opacities.reshape(-1)
        projection = ProjectionSettings(
            near=NEAR, far=math.inf, compensated=bool(settings.antialiasing), min_area_ratio=MIN_AREA_RATIO
        )
        viewmat = settings.viewmatrix.to(means3D.device).T
        K = _intrinsics(settings)
        p = project_splats(
            means3D,
            viewmat,
            K,
            width,
            height,
            projection,
            quats=rotations,
            scales=None if scales is None else scales * settings.scale_modifier,
            covars=None if cov3D_precomp is None else unpack_symmetric(cov3D_precomp),
            opacities=opacities,
        )
        opacity = select_rows(opacities, p.index)
        if p.compensations is not None:
            opacity = opacity * p.compensations
        centres = p.means2d
        if means2D is not None:
            # Not the values of `means2D` count but its gradient.
            proxy = select_rows(means2D, p.index)[:, :2]
            centres = centres + (proxy - proxy.detach()) * proxy.new_tensor([0.5 * width, 0.5 * height])
        if shs is None:
            assert colors_precomp is not None
            values = select_rows(colors_precomp, p.index)
        elif p.camera is not None and settings.sh_degree <= MAX_DEGREE and shs.dtype == torch.float32:
            values = _shade(means3D, shs, p.index, p.camera, viewmat, settings)
        else:
            directions = select_rows(means3D, p.index) - settings.campos.to(means3D)
            colors, shown = harmonic_colors(directions, select_rows(shs, p.index), settings.sh_degree)
            values = torch.where(shown[:, None], colors, torch.nan)  # which is left out
        channels, wants_depth = values.shape[1], settings.antialiasing is not None
        if wants_depth:
            values = torch.cat([values, 1.0 / p.depths[:, None]], dim=1)
        job = SplatJob(width, height, RasterSettings(alpha_max=ALPHA_MAX))
        layers, transmittance, _, _ = composite_splats(centres, p.factors, opacity, values, p.depths, job)
        image = layers[..., :channels] + transmittance[..., None] * settings.bg.to(layers)
        found = image.permute(2, 0, 1).contiguous(), _radii(p, len(means3D))
        return (*found, layers[..., channels:].permute(2, 0, 1).contiguous()) if wants_depth else found


def _shade(
    means: Tensor,
    shs: Tensor,
    index: Tensor,
    camera: Camera,
    viewmat: Tensor,
    settings: GaussianRasterizationSettings,
) -> Tensor:
    """Colors of the visible Gaussians by kernels (CUDA), NaN where they are not finite, [V, 3].

    The kernels look from the camera's own centre, Inria's rasterizer from `campos`: the difference moves the Gaussians.
    """
    with torch.no_grad():
        pose = viewmat.to(means.device, torch.float64)
        center = -(pose[:3, :3].T @ pose[:3, 3])
    moved = means + (center - settings.campos.to(means.device, torch.float64)).to(means.dtype)
    values: Tensor = ShadeTable.apply(moved, shs.contiguous(), center, index, camera, settings.sh_degree)
    return values


class SparseGaussianAdam(torch.optim.Adam):
    """Adam that moves only the Gaussians that were seen, as the one in Inria's rasterizer since October 2024 does.

    Moments have no bias correction, and rows that were not seen keep theirs. Each group of parameters holds one tensor.

    Args:
        params: Groups as for torch.optim.Adam.
        lr: Rate of groups that have none of their own.
        eps: Added to the root of the second moment.
    """

    def __init__(self, params: Any, lr: float, eps: float) -> None:
        super().__init__(params=params, lr=lr, eps=eps)

    @torch.no_grad()
    def step(self, visibility: Tensor, N: int) -> None:  # type: ignore[override]
        """Update the rows of the visible Gaussians.

        Args:
            visibility: Which were seen, bool [N]; radii > 0.
            N: How many Gaussians there are; every parameter has N rows.

        Raises:
            InputError: A group holds several tensors, or a tensor has another number of rows.
        """
        seen = visibility.reshape(-1).to(torch.bool)
        for group in self.param_groups:
            (parameter, *others) = group["params"]
            if others or len(parameter) != N or len(seen) != N:
                raise InputError(
                    f"SparseGaussianAdam: expected one tensor of {N} rows in each group, and visibility [{N}]; got "
                    f"{1 + len(others)} tensors, {len(parameter)} rows, visibility [{len(seen)}]"
                )
            if parameter.grad is None:
                continue
            state = self.state[parameter]
            if not state:
                state["step"] = torch.tensor(0.0)
                state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(parameter), torch.zeros_like(parameter)
            rows = seen.nonzero().flatten().to(parameter.device)
            gradient = parameter.grad[rows]
            beta1, beta2 = group["betas"]
            first = state["exp_avg"][rows] * beta1 + (1 - beta1) * gradient
            second = state["exp_avg_sq"][rows] * beta2 + (1 - beta2) * gradient**2
            state["exp_avg"][rows], state["exp_avg_sq"][rows] = first, second
            state["step"] += 1
            parameter[rows] -= group["lr"] * first / (second.sqrt() + group["eps"])


@isolated
def dist2(points: Tensor) -> Tensor:
    """Mean of the squared distances to the three nearest other points, exact (`simple_knn.distCUDA2`).

    Args:
        points: [m], [N, 3], N >= 4, duplicates welcome.

    Returns:
        [m^2], float32 [N].

    Raises:
        InputError: Another shape, fewer than 4 points, or a point that is not finite.
    """
    return mean_squared_neighbor_distance(points)


def _check(
    means3D: Tensor,
    means2D: Tensor | None,
    opacities: Tensor,
    shs: Tensor | None,
    colors_precomp: Tensor | None,
    scales: Tensor | None,
    rotations: Tensor | None,
    cov3D_precomp: Tensor | None,
    settings: GaussianRasterizationSettings,
) -> None:
    """Raise unless the arguments fit together."""
    if (shs is None) == (colors_precomp is None):
        raise InputError("shs, colors_precomp: give exactly one of them")
    pair = (scales is not None) + (rotations is not None)
    if pair != (2 if cov3D_precomp is None else 0):
        raise InputError("scales, rotations, cov3D_precomp: give both scales and rotations, or only cov3D_precomp")
    n = len(means3D)
    wanted: tuple[tuple[str, Any, tuple[str, ...]], ...] = (
        ("means3D", means3D, (f"[{n}, 3]",)),
        ("means2D", means2D, (f"[{n}, 3]", f"[{n}, 2]")),
        ("opacities", opacities, (f"[{n}, 1]", f"[{n}]")),
        ("scales", scales, (f"[{n}, 3]",)),
        ("rotations", rotations, (f"[{n}, 4]",)),
        ("cov3D_precomp", cov3D_precomp, (f"[{n}, 6]",)),
        ("viewmatrix", settings.viewmatrix, ("[4, 4]",)),
        ("projmatrix", settings.projmatrix, ("[4, 4]",)),
        ("campos", settings.campos, ("[3]",)),
    )
    for name, tensor, shapes in wanted:
        if tensor is not None and str(list(tensor.shape)) not in shapes:
            raise InputError(f"{name}: expected shape {' or '.join(shapes)}, got {list(tensor.shape)}")
    channels = 3
    if colors_precomp is not None:
        if colors_precomp.ndim != 2 or len(colors_precomp) != n or colors_precomp.shape[1] == 0:
            raise InputError(f"colors_precomp: expected shape [{n}, C], got {list(colors_precomp.shape)}")
        channels = colors_precomp.shape[1]
    elif shs is not None:
        count = (settings.sh_degree + 1) ** 2
        if shs.ndim != 3 or len(shs) != n or shs.shape[2] != 3 or shs.shape[1] < count:
            raise InputError(f"shs: expected [{n}, at least {count}, 3] for sh_degree {settings.sh_degree}")
    if tuple(settings.bg.shape) != (channels,):
        raise InputError(f"bg: expected shape [{channels}], got {list(settings.bg.shape)}")
    for name in ("viewmatrix", "projmatrix", "campos", "bg", "tanfovx", "tanfovy", "scale_modifier"):
        require_finite(name, getattr(settings, name))


def _joined(dc: Tensor, shs: Tensor | None, count: int) -> Tensor:
    """Harmonics [N, K, 3] of the coefficients of degree 0 and of those above."""
    if tuple(dc.shape) != (count, 1, 3):
        raise InputError(f"dc: expected shape [{count}, 1, 3], got {list(dc.shape)}")
    if shs is None:
        return dc
    if shs.ndim != 3 or len(shs) != count or shs.shape[2] != 3:
        raise InputError(f"shs: expected shape [{count}, K - 1, 3] beside dc, got {list(shs.shape)}")
    return torch.cat([dc, shs], dim=1)


def _intrinsics(settings: GaussianRasterizationSettings) -> Tensor:
    """Pinhole intrinsics [pixels] of the settings, float64 [3, 3]: focal lengths of tanfov, centre of projmatrix."""
    view, full = (m.detach().to(torch.float64).cpu() for m in (settings.viewmatrix, settings.projmatrix))
    require_finite("viewmatrix", view)  # those of CUDA, too: they are here now
    require_finite("projmatrix", full)
    if torch.linalg.det(view).item() == 0:
        raise InputError("viewmatrix: has no inverse; expected world to camera, transposed")
    P = torch.linalg.inv(view) @ full
    w = P[2, 3].item()
    off_axis = max(abs(P[i, j].item()) for i, j in ((0, 1), (1, 0), (0, 3), (1, 3)))
    # A shift that does not shrink with depth; as exact as float32 holds the product of both matrices.
    shift = max(abs(P[3, j].item()) for j in (0, 1, 3))
    centered = shift < FOCAL_TOLERANCE * (w + full[3].abs().max().item())
    if not (w > 0 and off_axis < FOCAL_TOLERANCE * w and centered):
        raise InputError("projmatrix: expected viewmatrix times a perspective projection, both transposed")
    K = torch.eye(3, dtype=torch.float64, device="cpu")
    sizes = (settings.image_width, settings.image_height)
    for axis, (size, tangent) in enumerate(zip(sizes, (settings.tanfovx, settings.tanfovy), strict=True)):
        slope = P[axis, axis].item() / w
        if not abs(slope * tangent - 1.0) < FOCAL_TOLERANCE:
            name = "tanfovx" if axis == 0 else "tanfovy"
            said = 1.0 / slope if slope else math.inf
            raise InputError(f"{name}: {tangent:g} contradicts projmatrix, which says {said:g}")
        K[axis, axis] = 0.5 * size / tangent
        K[axis, 2] = 0.5 * size * (1.0 + P[2, axis].item() / w)
    return K


def _radii(p: ProjectedSplats, count: int) -> Tensor:
    """Three standard deviations along the longer axis of each splat [pixels], int32 [N], zero for what is not seen."""
    xx, xy, yy = p.covariances.unbind(1)
    middle = 0.5 * (xx + yy)
    gap = (middle * middle - (xx * yy - xy * xy)).clamp(min=MIN_EIGENVALUE_GAP).sqrt()
    longest = (3.0 * (middle + gap).sqrt()).ceil().clamp(max=2.0**30).to(torch.int32)
    return torch.zeros(count, dtype=torch.int32, device=xx.device).index_copy_(0, p.index, longest)
