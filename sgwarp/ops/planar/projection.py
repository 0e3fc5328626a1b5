"""Projection of Gaussians through any camera model, in plain torch: differentiable, for covariances too.

The kernels project pinhole cameras from quaternions and scales; here are the same maths, EWA splatting, for
orthographic and fisheye cameras and for Gaussians given by their covariance, with every intermediate quantity open to
autograd. All of it is element-wise over the Gaussians. Camera conventions are OpenCV's, pixel centres lie at .5.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.scene import Camera
from sgwarp.scene.checks import require_finite

CAMERA_MODELS = ("pinhole", "ortho", "fisheye")
MIN_QUAT_NORM2 = 1e-6  # |q|^2 below this has no direction
ALPHA_MAX = 0.999  # of the kernels that the smallest opacity must stay below
FULL_REACH = 3.33  # standard deviations at which an opaque Gaussian falls below 1/255
FACTOR_UNIT = math.sqrt(0.5 * math.log2(math.e))  # makes the exponent of a footprint a power of two


@dataclass(frozen=True)
class ProjectionSettings:
    """Settings of the projection.

    Attributes:
        camera_model: "pinhole", "ortho" or "fisheye" (equidistant, without distortion).
        near, far: Range of z in the camera frame that is kept, both ends excluded [m].
        dilation: Added to both projected variances [pixels^2].
        radius_clip: Splats whose two radii are at most this are left out [pixels].
        compensated: Whether opacities will be scaled by the area that the dilation added.
        min_area_ratio: Areas before and after the dilation are taken for at least this far apart; above zero, so that
            the compensation of a Gaussian without area has a gradient.
        alpha_min: Splats fainter than this are left out, where opacities are known.

    Raises:
        InputError: Unknown camera model, an empty range of depth, or NaN or infinity in a number but `far`.
    """

    camera_model: str = "pinhole"
    near: float = 0.01
    far: float = 1e10
    dilation: float = 0.3
    radius_clip: float = 0.0
    compensated: bool = False
    min_area_ratio: float = 1e-12
    alpha_min: float = 1.0 / 255.0

    def __post_init__(self) -> None:
        if self.camera_model not in CAMERA_MODELS:
            raise InputError(f"camera_model: expected one of {', '.join(CAMERA_MODELS)}, got '{self.camera_model}'")
        if not self.near < self.far:
            raise InputError(f"near_plane: expected near < far, got {self.near} and {self.far}")
        for name, value in (("eps2d", self.dilation), ("radius_clip", self.radius_clip)):
            require_finite(name, value)


@dataclass(frozen=True, eq=False)
class ProjectedSplats:
    """The V Gaussians of one camera that may be seen, in the order of the input.

    Attributes:
        index: Row of each in the input, int64 [V].
        means2d: Projected centres [pixels], [V, 2].
        depths: z in the camera frame [m], [V].
        conics: (A, B, C) of the inverse covariance [[A, B], [B, C]] [1 / pixels^2], [V, 3].
        factors: (a, b, c) of the footprint 2^-(u^2 + v^2), u = a dx + b dy, v = c dy, float64 [V, 3]. The conic says
            the same, but taking it apart again costs needles their digits.
        compensations: sqrt(area before / area after the dilation), [V]; None unless asked for.
        covariances: (xx, xy, yy), dilated [pixels^2], without gradient, [V, 3].
        radii: Half size of the bounding box of {alpha >= alpha_min}, rounded up [pixels], int32 [V, 2].
        camera: Where kernels made the table, the camera as they read it.
    """

    index: Tensor
    means2d: Tensor
    depths: Tensor
    conics: Tensor
    factors: Tensor
    compensations: Tensor | None
    covariances: Tensor
    radii: Tensor
    camera: Camera | None = None


class _SelectRows(torch.autograd.Function):
    """Distinct rows of a tensor; their gradient is written, not added, and may stay sparse (COO)."""

    @staticmethod
    def forward(ctx, values: Tensor, index: Tensor, sparse: bool) -> Tensor:
        ctx.save_for_backward(index)
        ctx.size, ctx.sparse = values.shape, sparse
        return values.index_select(0, index)

    @staticmethod
    def backward(ctx, grad: Tensor):
        (index,) = ctx.saved_tensors
        if ctx.sparse:
            rows = torch.sparse_coo_tensor(index[None], grad, ctx.size, is_coalesced=True, check_invariants=False)
            return rows, None, None
        return grad.new_zeros(ctx.size).index_copy_(0, index, grad), None, None


def select_rows(values: Tensor, index: Tensor, sparse: bool = False) -> Tensor:
    """Rows of `values` [N, ...] at `index`, increasing int64 [V]; with `sparse` their gradient is a COO tensor."""
    return _SelectRows.apply(values, index, sparse)


def rotation_matrices(quats: Tensor) -> Tensor:
    """Rotations [..., 3, 3] of quaternions (w, x, y, z), [..., 4], of any length but zero."""
    return torch.stack(_rotation_entries(quats.movedim(-1, 0)), dim=-1).unflatten(-1, (3, 3))


def _rotation_entries(quats: Tensor) -> tuple[Tensor, ...]:
    """The nine entries, row by row, of rotations given as [4, ...]."""
    w, x, y, z = (quats * quats.square().sum(0).rsqrt()).unbind(0)
    return (
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def unpack_symmetric(upper: Tensor) -> Tensor:
    """Symmetric matrices [..., 3, 3] of their upper triangles (xx, xy, xz, yy, yz, zz), [..., 6]."""
    return upper[..., [0, 1, 2, 1, 3, 4, 2, 4, 5]].unflatten(-1, (3, 3))


def project_splats(
    means: Tensor,
    world_to_camera: Tensor,
    K: Tensor,
    width: int,
    height: int,
    settings: ProjectionSettings,
    *,
    quats: Tensor | None = None,
    scales: Tensor | None = None,
    covars: Tensor | None = None,
    opacities: Tensor | None = None,
    sparse: bool = False,
    kernels: bool | None = None,
) -> ProjectedSplats:
    """Project Gaussians into one camera (EWA splatting, Zwicker et al. 2002) and leave out what it cannot see.

    Left out are Gaussians that are not finite, have no rotation (|q|^2 < 1e-6), lie outside (near, far), are fainter
    than `alpha_min`, have a singular projection, or whose bounding box misses the image; none of them gets a gradient.
    Differentiable in `means`, `quats`, `scales`, `covars` and `world_to_camera`.

    Args:
        means: Centres [m], [N, 3].
        world_to_camera: Pose, [4, 4].
        K: Intrinsics [pixels], [3, 3].
        quats, scales: Rotations (w, x, y, z), [N, 4], and standard deviations [m], [N, 3]; or:
        covars: Covariances [m^2], [N, 3, 3]; then `quats` and `scales` are not read.
        opacities: [N], for the extent of the footprint; None takes every Gaussian for opaque.
        sparse: Gradients of `means`, `quats`, `scales` and `covars` as sparse tensors (COO).
        kernels: Let kernels do it where they can: pinhole cameras, quaternions and scales, float32. By default on CUDA.
    """
    if means.is_cuda if kernels is None else kernels:
        made = _by_kernels(means, world_to_camera, K, width, height, settings, quats, scales, covars, opacities, sparse)
        if made is not None:
            return made
    shapes = [covars] if covars is not None else [quats, scales]
    given = [t for t in (means, *shapes, opacities) if t is not None]
    index = _candidates(given, quats if covars is None else None, opacities, world_to_camera, settings)
    # From here components come first, [3, V]: rows of V numbers are what element-wise work is fast on.
    pose = world_to_camera.to(means.device, torch.float64)
    columns = select_rows(means, index, sparse).T
    # In float64 until the origin is the camera's, so that scenes far from theirs keep their digits.
    points = (pose[:3, :3] @ columns.to(torch.float64) + pose[:3, 3:]).to(means.dtype)
    row_x, row_y, means2d = _linearised(settings.camera_model, points, K.to(points), width, height)
    turn = pose[:3, :3].T.to(points)
    row_x, row_y = turn @ row_x, turn @ row_y
    if covars is None:
        assert quats is not None
        assert scales is not None
        axes = torch.stack(_rotation_entries(select_rows(quats, index, sparse).T.contiguous())).unflatten(0, (3, 3))
        scales = select_rows(scales, index, sparse).T
        # From here to the factors in float64: their gradients hold large terms that cancel for needles.
        m_x, m_y = (((row[:, None] * axes).sum(0) * scales).double() for row in (row_x, row_y))
        plain = [(m_x * m_x).sum(0), (m_x * m_y).sum(0), (m_y * m_y).sum(0)]
        # Sum of squared minors (Cauchy-Binet): needles lose nothing to cancellation.
        area = torch.linalg.cross(m_x, m_y, dim=0).square().sum(0)
    else:
        plain, area = _projected_covariance(select_rows(covars, index, sparse), row_x, row_y)
    return _splats(index, means2d, points[2], plain, area, opacities, width, height, settings)


def _by_kernels(
    means: Tensor,
    world_to_camera: Tensor,
    K: Tensor,
    width: int,
    height: int,
    settings: ProjectionSettings,
    quats: Tensor | None,
    scales: Tensor | None,
    covars: Tensor | None,
    opacities: Tensor | None,
    sparse: bool,
) -> ProjectedSplats | None:
    """The table made by kernels, or None where they cannot make it."""
    fields = [means, quats, scales] + ([] if opacities is None else [opacities])
    single = all(t is not None and t.dtype == torch.float32 for t in fields)
    plain = settings.camera_model == "pinhole" and 2.0**-16 <= settings.alpha_min < ALPHA_MAX and settings.near > 0
    if covars is not None or not single or not plain or K.requires_grad:
        return None
    from sgwarp.ops.planar.tables import ProjectTable, TableRequest, read_camera

    camera = read_camera(world_to_camera, K, width, height, settings.near, settings.far)
    if camera is None:
        return None
    opacity = means.new_empty(0) if opacities is None else opacities.detach().contiguous()
    request = TableRequest(camera, settings, opacity, sparse)
    assert quats is not None
    assert scales is not None
    index, means2d, depths, conics, factors, compensations, covariances, radii = ProjectTable.apply(
        means.contiguous(), quats.contiguous(), scales.contiguous(), world_to_camera, request
    )
    kept = compensations if settings.compensated else None
    return ProjectedSplats(index, means2d, depths, conics, factors, kept, covariances, radii, camera)


def _candidates(
    given: list[Tensor],
    quats: Tensor | None,
    opacities: Tensor | None,
    world_to_camera: Tensor,
    settings: ProjectionSettings,
) -> Tensor:
    """Rows that are finite, in range and not transparent, int64; cheap tests before anything is projected."""
    with torch.no_grad():
        # One sum is finite only if all of its terms are.
        flat = [t.reshape(len(t), math.prod(t.shape[1:])) for t in given]
        total = torch.stack([t @ t.new_ones(t.shape[1]) for t in flat]).sum(0)
        pose = world_to_camera.to(given[0].device, torch.float64)
        depth = given[0].to(torch.float64) @ pose[2, :3] + pose[2, 3]
        keep = torch.isfinite(total) & (depth > settings.near) & (depth < settings.far)
        if settings.camera_model != "ortho":
            keep &= depth > 0
        if quats is not None:
            keep &= quats.square() @ quats.new_ones(4) >= MIN_QUAT_NORM2
        if opacities is not None:
            keep &= opacities >= settings.alpha_min
        return keep.nonzero()[:, 0]


def _linearised(model: str, points: Tensor, K: Tensor, width: int, height: int) -> tuple[Tensor, Tensor, Tensor]:
    """Rows of the projection's Jacobian at camera points [3, V], [3, V] each, and the projected points [2, V]."""
    x, y, z = points.unbind(0)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    zero = torch.zeros_like(z)
    if model == "ortho":
        row_x, row_y = torch.stack([fx + zero, zero, zero]), torch.stack([zero, fy + zero, zero])
        return row_x, row_y, torch.stack([fx * x + cx, fy * y + cy])
    inv_z = 1.0 / z
    X, Y = x * inv_z, y * inv_z
    fx_z, fy_z = fx * inv_z, fy * inv_z
    if model == "pinhole":
        # Held within 15 % of the image's size beyond its borders, around the true principal point, as gsplat does:
        # the linearisation of a Gaussian far outside would blow up.
        tx = X.clamp(-cx / fx - 0.15 * width / fx, (width - cx) / fx + 0.15 * width / fx)
        ty = Y.clamp(-cy / fy - 0.15 * height / fy, (height - cy) / fy + 0.15 * height / fy)
        row_x, row_y = torch.stack([fx_z, zero, -fx_z * tx]), torch.stack([zero, fy_z, -fy_z * ty])
        return row_x, row_y, torch.stack([fx * X + cx, fy * Y + cy])
    s = X * X + Y * Y
    k, h = _fisheye_profile(s)
    radial = 1.0 / (1.0 + s)
    mixed = X * Y * h
    row_x = torch.stack([fx_z * (radial + Y * Y * h), -fx_z * mixed, -fx_z * X * radial])
    row_y = torch.stack([-fy_z * mixed, fy_z * (radial + X * X * h), -fy_z * Y * radial])
    return row_x, row_y, torch.stack([fx * X * k + cx, fy * Y * k + cy])


def _fisheye_profile(s: Tensor) -> tuple[Tensor, Tensor]:
    """k = atan(r) / r and h = (k - 1 / (1 + r^2)) / r^2 of s = r^2: series near the axis, where both are 0 / 0.

    The equidistant fisheye maps (X, Y) = (x / z, y / z) to k (X, Y), and h is what its Jacobian differs by from radial.
    """
    near_axis = s < 0.04
    small = torch.where(near_axis, s, 0.0)
    k_series, h_series = torch.zeros_like(s), torch.zeros_like(s)
    for n in reversed(range(10)):
        k_series = k_series * small + (-1) ** n / (2 * n + 1)
        h_series = h_series * small + (-1) ** n * (1 - 1 / (2 * n + 3))
    away = torch.where(near_axis, 1.0, s)
    r = away.sqrt()
    k_exact = r.atan() / r
    h_exact = (k_exact - 1.0 / (1.0 + away)) / away
    return torch.where(near_axis, k_series, k_exact), torch.where(near_axis, h_series, h_exact)


def _projected_covariance(covars: Tensor, row_x: Tensor, row_y: Tensor) -> tuple[list[Tensor], Tensor]:
    """(xx, xy, yy) and determinant of J Sigma J^T; in float64, because a covariance has no factor to square."""
    covars, row_x, row_y = covars.permute(1, 2, 0).double(), row_x.double(), row_y.double()
    s_x, s_y = ((covars * row).sum(1) for row in (row_x, row_y))
    xx, xy, yy = (row_x * s_x).sum(0), 0.5 * ((row_x * s_y).sum(0) + (row_y * s_x).sum(0)), (row_y * s_y).sum(0)
    return [xx, xy, yy], (xx * yy - xy * xy).clamp(min=0.0)


def _splats(
    index: Tensor,
    means2d: Tensor,
    depths: Tensor,
    plain: list[Tensor],
    area: Tensor,
    opacities: Tensor | None,
    width: int,
    height: int,
    settings: ProjectionSettings,
) -> ProjectedSplats:
    """Dilate, invert and bound the projected covariances; keep what reaches the image."""
    d = settings.dilation
    xx, xy, yy = plain[0] + d, plain[1], plain[2] + d
    det = area + d * (plain[0] + plain[2]) + d * d
    with torch.no_grad():
        keep = (det > 0) & torch.isfinite(det) & (yy > 0)
        reach = torch.full_like(depths, FULL_REACH)
        if opacities is not None:
            visible = opacities[index].to(depths)
            if settings.compensated:
                visible = visible * (area / det).clamp(min=settings.min_area_ratio).sqrt().to(depths)
            keep &= visible >= settings.alpha_min
            reach = (2.0 * (visible / settings.alpha_min).clamp(min=1.0).log()).sqrt().clamp(max=FULL_REACH)
        radius_x, radius_y = ((reach * variance.to(depths).sqrt()).ceil() for variance in (xx, yy))
        keep &= (radius_x > settings.radius_clip) | (radius_y > settings.radius_clip)
        keep &= (means2d[0] + radius_x > 0) & (means2d[0] - radius_x < width)
        keep &= (means2d[1] + radius_y > 0) & (means2d[1] - radius_y < height)
        kept = keep.nonzero()[:, 0]
        index = index[kept]
        largest = torch.iinfo(torch.int32).max - 127  # the largest float32 that fits
        radii = torch.stack([radius_x[kept], radius_y[kept]], 1).clamp(max=largest).to(torch.int32)
    means2d, depths = means2d.index_select(1, kept), depths.index_select(0, kept)
    xx, xy, yy, det, area = (t.index_select(0, kept) for t in (xx, xy, yy, det, area))
    inv_root, sigma_y = det.rsqrt(), yy.sqrt()
    factors = FACTOR_UNIT * torch.stack([sigma_y * inv_root, -xy * inv_root / sigma_y, 1.0 / sigma_y], 1)
    compensations = (area / det).clamp(min=settings.min_area_ratio).sqrt().to(depths) if settings.compensated else None
    covariances = torch.stack([xx, xy, yy], 1).detach().to(depths)
    conics = (torch.stack([yy, -xy, xx], 1) / det[:, None]).to(depths)
    return ProjectedSplats(index, means2d.T.contiguous(), depths, conics, factors, compensations, covariances, radii)
