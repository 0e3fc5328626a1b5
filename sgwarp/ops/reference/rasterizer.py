"""The float64 oracle of projection, spherical harmonics and compositing: plain torch, differentiable, no Warp.

Written for reading and for trust, not for speed: each block of pixels is composited against every Gaussian that may
reach it, with one cumulative product. Every function takes raw float64 tensors and lets gradients through; `rasterize`
takes the scene types. Sources: 3D Gaussian Splatting (Kerbl et al. 2023) for the model, EWA splatting (Zwicker et al.
2002) for the projection, with the frustum clamp of gsplat 1.5.3 around the true principal point.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sgwarp.scene import Camera, Gaussians

BLOCK = 32  # side of the pixel blocks that are composited at once [pixels]


@dataclass(frozen=True)
class ReferenceSettings:
    """Thresholds of the image formation.

    Attributes:
        alpha_min: A Gaussian is skipped at a pixel where its alpha is smaller.
        alpha_max: Alpha is clamped to this.
        transmittance_min: A pixel closes before the Gaussian that would bring its transmittance down to this.
        eps2d: Added to the diagonal of the projected covariance [pixels^2].
        surface_opacity: The surface lies where accumulated opacity first reaches this.
        antialiased: Scale opacities by sqrt(det before / det after) of the dilation by eps2d.
    """

    alpha_min: float = 1.0 / 255.0
    alpha_max: float = 0.999
    transmittance_min: float = 1e-4
    eps2d: float = 0.3
    surface_opacity: float = 0.5
    antialiased: bool = False


@dataclass(frozen=True, eq=False)
class Projection:
    """The M Gaussians that were not culled, front to back in the stable order (depth, index). All float64.

    Attributes:
        index: Row of each in the input, int64 [M].
        mean2d: Projected centres [pixels], [M, 2].
        conic: (a, b, c) of the inverse covariance [[a, b], [b, c]] [1 / pixels^2], [M, 3].
        depth: z in the camera [m], [M].
        opacity: Opacities, compensated if antialiased, [M].
        extent: Half size of the bounding box of {alpha >= alpha_min} [pixels], [M, 2].
        depth_scale: Sum of the magnitudes that `depth` is made of, taken from the camera's position: what its rounding
            is relative to [m], [M].
    """

    index: Tensor
    mean2d: Tensor
    conic: Tensor
    depth: Tensor
    opacity: Tensor
    extent: Tensor
    depth_scale: Tensor


@dataclass(frozen=True, eq=False)
class Raster:
    """Images, float64. Margins say how near a pixel is to a decision that rounding may turn.

    Attributes:
        features: Composited features over the background, [H, W, C].
        alpha: 1 - final transmittance, [H, W].
        expected_depth: Mean depth under the weights [m], 0 where there is no weight, [H, W].
        depth: Depth of the surface [m], 0 where there is none, [H, W].
        margin: Smallest relative distance of any alpha to alpha_min or of a transmittance to transmittance_min, [H, W].
        order_margin: Smallest relative gap in depth of two neighbours in order; exact ties, which go by index, do not
            count, [H, W].
        surface_margin: Smallest relative distance of any transmittance to 1 - surface_opacity, [H, W].
    """

    features: Tensor
    alpha: Tensor
    expected_depth: Tensor
    depth: Tensor
    margin: Tensor
    order_margin: Tensor
    surface_margin: Tensor


@dataclass(frozen=True, eq=False)
class Blend:
    """One block of P pixels against the m rows of a projection that may reach it.

    Attributes:
        pixels: Flat pixel indices y * width + x, int64 [P].
        rows: Rows of the projection, int64 [m].
        weights: alpha T, zero where a Gaussian does not contribute, [P, m].
        transmittance: Final transmittance, [P].
        depth, margin, order_margin, surface_margin: As in Raster, [P].
    """

    pixels: Tensor
    rows: Tensor
    weights: Tensor
    transmittance: Tensor
    depth: Tensor
    margin: Tensor
    order_margin: Tensor
    surface_margin: Tensor


def rotation_matrices(quats: Tensor) -> Tensor:
    """Rotations [N, 3, 3] of quaternions (w, x, y, z), [N, 4], of any non-zero length."""
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True)).unbind(1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)


def perspective_jacobian(points: Tensor, K: Tensor, width: int, height: int) -> Tensor:
    """Jacobian of the pinhole projection at camera-space `points` [N, 3], clamped to just outside the image, [N, 2, 3].

    x/z and y/z are held within the image widened on each side by 15 % of its size, so that Gaussians far outside do not
    blow up; the clamp is around the true principal point.
    """
    x, y, z = points.unbind(1)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    margin_x, margin_y = 0.3 * 0.5 * width / fx, 0.3 * 0.5 * height / fy
    u = (x / z).clamp(-(cx / fx + margin_x), (width - cx) / fx + margin_x)
    v = (y / z).clamp(-(cy / fy + margin_y), (height - cy) / fy + margin_y)
    zero = torch.zeros_like(z)
    return torch.stack(
        [torch.stack([fx / z, zero, -fx * u / z], dim=1), torch.stack([zero, fy / z, -fy * v / z], dim=1)], dim=1
    )


def project(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    world_to_camera: Tensor,
    K: Tensor,
    width: int,
    height: int,
    near: float = 0.01,
    far: float = 1e10,
    settings: ReferenceSettings | None = None,
) -> Projection:
    """Project Gaussians into the image and order them front to back.

    Args:
        means: Centres [m], [N, 3].
        quats: Rotations (w, x, y, z), [N, 4].
        scales: Standard deviations [m], [N, 3].
        opacities: [N].
        world_to_camera: Pose, [4, 4].
        K: Intrinsics [pixels], [3, 3].

    Left out are rows that are not finite, not within (near, far), have |q|^2 < 1e-6 or an opacity below alpha_min, a
    singular projected covariance, or a bounding box of {alpha >= alpha_min} that does not touch the image.
    """
    settings = settings or ReferenceSettings()
    R, t = world_to_camera[:3, :3], world_to_camera[:3, 3]
    with torch.no_grad():
        fields = torch.cat([means, quats, scales, opacities[:, None]], dim=1)
        z = means @ R[2] + t[2]
        keep = torch.isfinite(fields).all(dim=1) & (z > near) & (z < far)
        keep &= ((quats * quats).sum(dim=1) >= 1e-6) & (opacities >= settings.alpha_min)
        index = keep.nonzero()[:, 0]
    means, quats, scales, opacities = means[index], quats[index], scales[index], opacities[index]

    points = means @ R.T + t
    depth = points[:, 2]
    mean2d = points[:, :2] / depth[:, None] * K.diagonal()[:2] + K[:2, 2]

    # cov2d = M M^T + eps I. Its determinant as a sum of squared minors (Cauchy-Binet) does not cancel for needles.
    J = perspective_jacobian(points, K, width, height)
    M = J @ R @ rotation_matrices(quats) * scales[:, None, :]
    plain = (M @ M.transpose(1, 2)).reshape(-1, 4)
    xx, xy, yy = plain[:, 0], plain[:, 1], plain[:, 3]
    det_plain = torch.linalg.cross(M[:, 0], M[:, 1]).square().sum(dim=1)
    det = det_plain + settings.eps2d * (xx + yy) + settings.eps2d**2
    if settings.antialiased:
        opacities = opacities * (det_plain / det).clamp(min=1e-300).sqrt()  # a finite gradient at zero
    xx, yy = xx + settings.eps2d, yy + settings.eps2d

    with torch.no_grad():
        reach = 2 * (opacities / settings.alpha_min).clamp(min=1.0).log()
        extent = torch.stack([(reach * xx).sqrt(), (reach * yy).sqrt()], dim=1)
        size = torch.tensor([width, height], dtype=extent.dtype)
        on_image = ((mean2d + extent >= 0) & (mean2d - extent <= size)).all(dim=1)
        visible = (on_image & (det > 0) & (opacities >= settings.alpha_min)).nonzero()[:, 0]
        rows = visible[torch.argsort(depth[visible], stable=True)]
        depth_scale = (means + t @ R).abs() @ R[2].abs()
    conic = torch.stack([yy, -xy, xx], dim=1)[rows] / det[rows, None]
    return Projection(index[rows], mean2d[rows], conic, depth[rows], opacities[rows], extent[rows], depth_scale[rows])


def harmonics(directions: Tensor, degree: int) -> Tensor:
    """Real spherical harmonics at unit `directions` [N, 3], [N, (degree + 1)^2], order and signs of Inria's 3DGS."""
    x, y, z = directions.unbind(1)
    pi = math.pi
    basis = [torch.full_like(x, math.sqrt(1 / (4 * pi)))]
    if degree >= 1:
        c = math.sqrt(3 / (4 * pi))
        basis += [-c * y, c * z, -c * x]
    if degree >= 2:
        c = math.sqrt(15 / (4 * pi))
        basis += [c * x * y, -c * y * z, math.sqrt(5 / (16 * pi)) * (2 * z * z - x * x - y * y)]
        basis += [-c * x * z, c / 2 * (x * x - y * y)]
    if degree >= 3:
        c, d, e = math.sqrt(35 / (32 * pi)), math.sqrt(105 / (4 * pi)), math.sqrt(21 / (32 * pi))
        basis += [-c * y * (3 * x * x - y * y), d * x * y * z, -e * y * (4 * z * z - x * x - y * y)]
        basis += [math.sqrt(7 / (16 * pi)) * z * (2 * z * z - 3 * x * x - 3 * y * y)]
        basis += [-e * x * (4 * z * z - x * x - y * y), d / 2 * z * (x * x - y * y), -c * x * (x * x - 3 * y * y)]
    return torch.stack(basis, dim=1)


def spherical_harmonics(means: Tensor, sh: Tensor, world_to_camera: Tensor, degree: int | None = None) -> Tensor:
    """Colours [N, 3] of Gaussians seen by the camera: max(0, sum of sh times basis + 0.5).

    Args:
        means: Centres [m], [N, 3].
        sh: Coefficients, [N, K, 3].
        world_to_camera: Pose, [4, 4].
        degree: Highest degree used, all of `sh` by default.
    """
    degree = math.isqrt(sh.shape[1]) - 1 if degree is None else degree
    position = -world_to_camera[:3, :3].T @ world_to_camera[:3, 3]
    directions = torch.nn.functional.normalize(means - position, dim=1)
    basis = harmonics(directions, degree)
    return ((basis[:, :, None] * sh[:, : basis.shape[1]]).sum(dim=1) + 0.5).clamp(min=0.0)


def blend_blocks(projection: Projection, width: int, height: int, settings: ReferenceSettings) -> Iterator[Blend]:
    """Composite the image in blocks of at most BLOCK x BLOCK pixels."""
    low, high = projection.mean2d.detach() - projection.extent, projection.mean2d.detach() + projection.extent
    slack = 1.0 + 0.01 * projection.extent  # keeps the rows that only come near alpha_min, for the margin
    low, high = low - slack, high + slack
    for top in range(0, height, BLOCK):
        for left in range(0, width, BLOCK):
            bottom, right = min(top + BLOCK, height), min(left + BLOCK, width)
            reaches = (high[:, 0] >= left) & (low[:, 0] <= right) & (high[:, 1] >= top) & (low[:, 1] <= bottom)
            y, x = torch.meshgrid(torch.arange(top, bottom), torch.arange(left, right), indexing="ij")
            yield blend_pixels(projection, reaches.nonzero()[:, 0], x.flatten(), y.flatten(), width, settings)


def blend_pixels(
    projection: Projection, rows: Tensor, x: Tensor, y: Tensor, width: int, settings: ReferenceSettings
) -> Blend:
    """Composite pixels (x, y), int64 [P], against some rows of a projection, ascending."""
    mean2d, opacity, depth = projection.mean2d[rows], projection.opacity[rows], projection.depth[rows]
    a, b, c = projection.conic[rows].unbind(1)
    dx = x[:, None] + 0.5 - mean2d[:, 0]
    dy = y[:, None] + 0.5 - mean2d[:, 1]
    alpha = opacity * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    alpha = alpha.clamp(max=settings.alpha_max)

    one = alpha.new_ones(len(alpha), 1)
    with torch.no_grad():
        passed = alpha >= settings.alpha_min
        after = torch.cumprod(1 - alpha * passed, dim=1)
        before = torch.cat([one, after], dim=1)[:, :-1]
        reached = before > settings.transmittance_min
        counts = passed & (after > settings.transmittance_min)
        margin = torch.minimum(
            _nearest(alpha, settings.alpha_min, reached), _nearest(after, settings.transmittance_min, passed & reached)
        )
        order_margin = _order_margin(depth, projection.depth_scale[rows], passed & reached)
        surface_margin = _nearest(after, 1 - settings.surface_opacity, counts)

    alpha = alpha * counts
    after = torch.cumprod(1 - alpha, dim=1)
    before = torch.cat([one, after], dim=1)
    transmittance, before = before[:, -1], before[:, :-1]
    level = 1 - settings.surface_opacity
    crosses = counts & (before > level) & (after <= level)
    surface = (crosses * depth).sum(dim=1)
    return Blend(y * width + x, rows, alpha * before, transmittance, surface, margin, order_margin, surface_margin)


def _nearest(values: Tensor, threshold: float, where: Tensor) -> Tensor:
    """Smallest relative distance to `threshold` among the entries of each line, infinity if there are none."""
    distance = torch.where(where, (values / threshold - 1).abs(), torch.inf)
    return torch.cat([distance.new_full((len(distance), 1), torch.inf), distance], dim=1).amin(dim=1)


def _order_margin(depth: Tensor, scale: Tensor, where: Tensor) -> Tensor:
    """Smallest relative gap in depth between two neighbours that both count at a pixel; exact ties do not."""
    rank = torch.arange(len(depth)).expand_as(where)
    last = torch.cummax(torch.where(where, rank, -1), dim=1).values
    previous = torch.cat([last.new_full((len(last), 1), -1), last], dim=1)[:, :-1]
    gap = (depth - depth[previous]) / scale
    return _nearest(1 + gap, 1.0, where & (previous >= 0) & (gap > 0))


def composite(
    projection: Projection,
    features: Tensor,
    width: int,
    height: int,
    background: Tensor | None = None,
    settings: ReferenceSettings | None = None,
) -> Raster:
    """Composite `features` [N, C] of the original rows front to back; `background` is [C], black by default."""
    settings = settings or ReferenceSettings()
    features = features[projection.index]
    background = torch.zeros(features.shape[1], dtype=features.dtype) if background is None else background
    pixels, images = [], []
    for blend in blend_blocks(projection, width, height, settings):
        total = blend.weights.sum(dim=1)
        mean_depth = blend.weights @ projection.depth[blend.rows] / torch.where(total > 0, total, 1.0)
        image = blend.weights @ features[blend.rows] + blend.transmittance[:, None] * background
        margins = (blend.margin, blend.order_margin, blend.surface_margin)
        scalars = torch.stack([1 - blend.transmittance, mean_depth, blend.depth, *margins], dim=1)
        images.append(torch.cat([image, scalars], dim=1))
        pixels.append(blend.pixels)
    order = torch.argsort(torch.cat(pixels))
    image = torch.cat(images)[order].reshape(height, width, -1)
    return Raster(image[..., :-6], *image[..., -6:].unbind(-1))


def project_scene(gaussians: Gaussians, camera: Camera, settings: ReferenceSettings | None = None) -> Projection:
    """Project a scene; rows with a non-finite field, colours included, are left out."""
    kept = gaussians.finite.nonzero()[:, 0]
    means, quats, scales, opacities = (
        getattr(gaussians, name)[kept].double() for name in ("means", "quats", "scales", "opacities")
    )
    projection = project(
        means,
        quats,
        scales,
        opacities,
        camera.world_to_camera,
        camera.K,
        camera.width,
        camera.height,
        camera.near,
        camera.far,
        settings,
    )
    return replace(projection, index=kept[projection.index])


def rasterize(
    gaussians: Gaussians,
    camera: Camera,
    features: Tensor | None = None,
    background: Tensor | None = None,
    settings: ReferenceSettings | None = None,
    sh_degree: int | None = None,
) -> Raster:
    """Render a scene in float64.

    Args:
        features: What to composite, [N, C]; the colours seen from the camera by default.
        background: [C], black by default.
        sh_degree: Highest degree of the colours, all by default.
    """
    if features is None:
        means, sh = gaussians.means.double(), gaussians.sh.double()
        features = spherical_harmonics(means, sh, camera.world_to_camera, sh_degree)
    background = background.double() if background is not None else None
    projection = project_scene(gaussians, camera, settings)
    return composite(projection, features.double(), camera.width, camera.height, background, settings)
