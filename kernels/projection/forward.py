"""Gaussian -> splat: culling, projection, footprint. One thread per Gaussian, the same kernel on CPU and CUDA."""

import warp as wp

from sgwarp.kernels.gaussian import (
    EXACT_OPTIONS,
    LEVEL_SLACK,
    LOG2_E,
    MIN_QUAT_NORM2,
    UNIT,
    Pinhole,
    Splat,
    camera_from_world,
    ewa_rows,
    factor_determinant,
    footprint_factor,
    projected_factor,
)

wp.set_module_options(EXACT_OPTIONS)

# Why a Gaussian is left out; `status_out` holds one of these.
VISIBLE = wp.constant(0)
NON_FINITE = wp.constant(1)  # NaN, infinity or a quaternion without direction
TRANSPARENT = wp.constant(2)  # opacity below alpha_min: no pixel could reach it
OUTSIDE_DEPTH = wp.constant(3)  # not between near and far
OFF_SCREEN = wp.constant(4)  # footprint holds no pixel centre of the image
DEGENERATE = wp.constant(5)  # projected covariance overflows or is singular

STATUS_NAMES = ("visible", "non_finite", "transparent", "outside_depth", "off_screen", "degenerate")


@wp.struct
class Knobs:
    """The rasterizer's approximations (`RasterSettings` on the host)."""

    alpha_min: float
    alpha_max: float
    transmittance_min: float
    dilation: float  # added to both variances [pixels^2]
    antialiased: int
    surface_transmittance: float  # 1 - alpha_d
    alpha_min_level: float  # log2(alpha_min)


@wp.func
def is_finite(mean: wp.vec3, quat: wp.vec4, scale: wp.vec3, opacity: float) -> bool:
    """One sum catches every NaN and infinity; a quaternion must also have a direction."""
    norm2 = wp.length_sq(quat)
    total = wp.abs(mean[0]) + wp.abs(mean[1]) + wp.abs(mean[2])
    total += wp.abs(scale[0]) + wp.abs(scale[1]) + wp.abs(scale[2]) + wp.abs(opacity) + norm2
    return wp.isfinite(total) and norm2 >= MIN_QUAT_NORM2


@wp.func
def is_far_off_screen(camera: Pinhole, point: wp.vec3, scale: wp.vec3, knobs: Knobs) -> bool:
    """Whether not even a round, opaque Gaussian of the largest scale would reach the image: no square root is needed.

    Its deviation along an image axis is at most scale |J row|, its footprint sqrt(2 ln(1 / alpha_min)) times that.
    """
    row_x, row_y = ewa_rows(camera, point)
    largest = wp.max(scale)
    reach2 = (LEVEL_SLACK - knobs.alpha_min_level) * 2.0 / LOG2_E
    width2 = reach2 * (largest * largest * wp.length_sq(row_x) + knobs.dilation)
    height2 = reach2 * (largest * largest * wp.length_sq(row_y) + knobs.dilation)
    x = camera.focal[0] * point[0] / point[2] + camera.principal[0]
    y = camera.focal[1] * point[1] / point[2] + camera.principal[1]
    away_x = wp.max(wp.max(-x, x - float(camera.width)), 0.0)
    away_y = wp.max(wp.max(-y, y - float(camera.height)), 0.0)
    return away_x * away_x > width2 or away_y * away_y > height2


@wp.kernel
def project_gaussians(
    # In:
    base: int,  # first Gaussian of this launch
    means: wp.array[wp.vec3],  # [N] centres [m]
    quats: wp.array[wp.vec4],  # [N] rotations (w, x, y, z)
    scales: wp.array[wp.vec3],  # [N] standard deviations [m]
    opacities: wp.array[float],  # [N]
    camera: Pinhole,
    knobs: Knobs,
    # Out:
    splats_out: wp.array[Splat],  # [N] valid where visible
    status_out: wp.array[wp.uint8],  # [N] VISIBLE or why not
    depths_out: wp.array[float],  # [N] z in the camera frame [m], where visible
):
    """Project every Gaussian (paper eq. 2, 3) and decide whether any pixel can see it."""
    i = base + wp.tid()
    mean = means[i]
    quat = quats[i]
    scale = scales[i]
    opacity = opacities[i]
    if not is_finite(mean, quat, scale, opacity):
        status_out[i] = wp.uint8(NON_FINITE)
        return
    if opacity < knobs.alpha_min:
        status_out[i] = wp.uint8(TRANSPARENT)
        return
    point = camera_from_world(camera, mean)
    if not (point[2] > camera.near and point[2] < camera.far):
        status_out[i] = wp.uint8(OUTSIDE_DEPTH)
        return

    if is_far_off_screen(camera, point, scale, knobs):
        status_out[i] = wp.uint8(OFF_SCREEN)
        return

    m_x, m_y = projected_factor(camera, point, quat, scale)
    xx = wp.length_sq(m_x)
    yy = wp.length_sq(m_y)
    sharp = factor_determinant(m_x, m_y)
    determinant = sharp + knobs.dilation * (xx + yy) + knobs.dilation * knobs.dilation
    xx += knobs.dilation
    yy += knobs.dilation
    xy = wp.dot(m_x, m_y)
    if not (determinant > 0.0 and wp.isfinite(determinant) and yy > 0.0):
        status_out[i] = wp.uint8(DEGENERATE)
        return
    if knobs.antialiased != 0:
        opacity *= wp.sqrt(sharp / determinant)
        if opacity < knobs.alpha_min:
            status_out[i] = wp.uint8(TRANSPARENT)
            return

    splat = Splat()
    inv_z = 1.0 / point[2]
    splat.mean = wp.vec2(
        camera.focal[0] * (point[0] * inv_z) + camera.principal[0],
        camera.focal[1] * (point[1] * inv_z) + camera.principal[1],
    )
    a, b, c = footprint_factor(xy, yy, determinant)
    splat.a = a
    splat.b = b
    splat.c = c
    splat.level = wp.log2(opacity)
    splat.depth = point[2]
    splat.reach = splat.level - knobs.alpha_min_level + LEVEL_SLACK
    radius = wp.sqrt(splat.reach) * (1.0 / UNIT)
    splat.half_width = radius * wp.sqrt(xx)
    splat.half_height = radius * wp.sqrt(yy)
    splat.inv_bc = wp.sqrt(determinant / xx) * (1.0 / UNIT)
    splat.summit = -b * splat.half_height * splat.inv_bc
    x = splat.mean[0]
    y = splat.mean[1]
    inside = x + splat.half_width >= 0.5 and x - splat.half_width <= float(camera.width) - 0.5
    inside = inside and y + splat.half_height >= 0.5 and y - splat.half_height <= float(camera.height) - 0.5
    if not inside:
        status_out[i] = wp.uint8(OFF_SCREEN)
        return
    splats_out[i] = splat
    depths_out[i] = point[2]
    status_out[i] = wp.uint8(VISIBLE)


@wp.kernel
def mark_non_finite_colors(
    # In:
    sh: wp.array2d[wp.vec3],  # [N, K]
    # Out:
    status_out: wp.array[wp.uint8],  # [N] NON_FINITE where a coefficient is, else as it was
):
    """Leave out Gaussians whose colour is not finite; a thread per coefficient, and all write the same."""
    e = wp.tid()
    i = e / sh.shape[1]
    if not wp.isfinite(wp.dot(sh[i, e % sh.shape[1]], wp.vec3(0.0, 0.0, 0.0))):
        status_out[i] = wp.uint8(NON_FINITE)
