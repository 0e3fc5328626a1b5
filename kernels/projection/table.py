"""Projection for callers that want every quantity of a splat in a table, as the facades of CUDA rasterizers do (CUDA).

What is left out are Gaussians whose bounding box misses the image, not those whose footprint does: that is the rule of
gsplat and of Inria's rasterizer. The maths is that of `forward.py`, and so is the adjoint: `gather_moments` turns the
gradients of a table into the moments that `project_backward` takes.
"""

import warp as wp

from sgwarp.kernels.gaussian import (
    EXACT_OPTIONS,
    UNIT,
    Pinhole,
    camera_from_world,
    factor_determinant,
    footprint_factor,
    projected_factor,
)
from sgwarp.kernels.projection.backward import LN_2, SEEN
from sgwarp.kernels.projection.forward import Knobs, is_finite

wp.set_module_options(EXACT_OPTIONS)

FULL_REACH = wp.constant(3.33)  # standard deviations at which an opaque Gaussian falls below 1/255
TABLE_COLUMNS = 13  # x, y [pixels], z [m], conic A B C, factor a b c, compensation, covariance xx xy yy
AT_DEPTH = 6  # column of the sums with the gradient of the depth, behind the six moments
LARGEST_RADIUS = wp.constant(2147483520.0)  # the largest float32 that fits an int32


@wp.kernel
def tabulate_splats(
    # In:
    base: int,  # first Gaussian of this launch
    means: wp.array[wp.vec3],  # [N] centres [m]
    quats: wp.array[wp.vec4],  # [N] rotations (w, x, y, z)
    scales: wp.array[wp.vec3],  # [N] standard deviations [m]
    opacities: wp.array[float],  # [N], or empty: all are opaque
    camera: Pinhole,
    knobs: Knobs,
    radius_clip: float,  # splats are left out whose radii are at most this [pixels]
    min_area_ratio: float,  # of the areas before and after the dilation
    # Out:
    kept_out: wp.array[wp.uint8],  # [N] 1 = in the table, 0 = left out
    table_out: wp.array2d[float],  # [N, TABLE_COLUMNS] where kept
    radii_out: wp.array2d[int],  # [N, 2] half size of the bounding box [pixels], where kept
):
    """Project every Gaussian and decide whether its bounding box meets the image."""
    i = base + wp.tid()
    kept_out[i] = wp.uint8(0)
    mean = means[i]
    quat = quats[i]
    scale = scales[i]
    opacity = float(1.0)
    if opacities.shape[0] > 0:
        opacity = opacities[i]
    if not is_finite(mean, quat, scale, opacity) or opacity < knobs.alpha_min:
        return
    point = camera_from_world(camera, mean)
    if not (point[2] > camera.near and point[2] < camera.far and point[2] > 0.0):
        return
    m_x, m_y = projected_factor(camera, point, quat, scale)
    sharp = factor_determinant(m_x, m_y)
    xx = wp.length_sq(m_x)
    yy = wp.length_sq(m_y)
    determinant = sharp + knobs.dilation * (xx + yy) + knobs.dilation * knobs.dilation
    xx += knobs.dilation
    yy += knobs.dilation
    xy = wp.dot(m_x, m_y)
    if not (determinant > 0.0 and wp.isfinite(determinant) and yy > 0.0):
        return
    compensation = float(1.0)
    if knobs.antialiased != 0:
        compensation = wp.sqrt(wp.max(sharp / determinant, min_area_ratio))
    reach = float(FULL_REACH)
    if opacities.shape[0] > 0:
        visible = opacity * compensation
        if visible < knobs.alpha_min:
            return
        reach = wp.min(wp.sqrt(2.0 * wp.log(wp.max(visible / knobs.alpha_min, 1.0))), FULL_REACH)
    radius_x = wp.ceil(reach * wp.sqrt(xx))
    radius_y = wp.ceil(reach * wp.sqrt(yy))
    inv_z = 1.0 / point[2]
    x = camera.focal[0] * (point[0] * inv_z) + camera.principal[0]
    y = camera.focal[1] * (point[1] * inv_z) + camera.principal[1]
    seen = radius_x > radius_clip or radius_y > radius_clip
    seen = seen and x + radius_x > 0.0 and x - radius_x < float(camera.width)
    seen = seen and y + radius_y > 0.0 and y - radius_y < float(camera.height)
    if not seen:
        return
    a, b, c = footprint_factor(xy, yy, determinant)
    kept_out[i] = wp.uint8(1)
    radii_out[i, 0] = int(wp.min(radius_x, LARGEST_RADIUS))
    radii_out[i, 1] = int(wp.min(radius_y, LARGEST_RADIUS))
    table_out[i, 0] = x
    table_out[i, 1] = y
    table_out[i, 2] = point[2]
    table_out[i, 3] = yy / determinant
    table_out[i, 4] = -xy / determinant
    table_out[i, 5] = xx / determinant
    table_out[i, 6] = a
    table_out[i, 7] = b
    table_out[i, 8] = c
    table_out[i, 9] = compensation
    table_out[i, 10] = xx
    table_out[i, 11] = xy
    table_out[i, 12] = yy


@wp.kernel
def gather_moments(
    # In:
    index: wp.array[wp.int64],  # [V] Gaussian of each row
    table: wp.array2d[float],  # [V, TABLE_COLUMNS]
    v_means2d: wp.array2d[float],  # [V, 2], the gradients; each of these may be empty: zero
    v_depths: wp.array[float],  # [V]
    v_conics: wp.array2d[float],  # [V, 3]
    v_factors: wp.array2d[wp.float64],  # [V, 3]
    v_compensations: wp.array[float],  # [V]
    min_area_ratio: float,  # at which a compensation is held, and then has no gradient
    # Out:
    sums_out: wp.array2d[float],  # [N, 16] moments under 1, u, v, u^2, u v, v^2, the depth's gradient, seen; zeroed
):
    """Moments that have these gradients; in double precision, because a needle's large terms cancel."""
    k = wp.tid()
    i = int(index[k])
    a = wp.float64(table[k, 6])
    b = wp.float64(table[k, 7])
    c = wp.float64(table[k, 8])
    v_a = wp.float64(0.0)
    v_b = wp.float64(0.0)
    v_c = wp.float64(0.0)
    if v_factors.shape[0] > 0:
        v_a = v_factors[k, 0]
        v_b = v_factors[k, 1]
        v_c = v_factors[k, 2]
    if v_conics.shape[0] > 0:
        # The conic is (a^2, a b, b^2 + c^2) / UNIT^2.
        scale = wp.float64(1.0) / (wp.float64(UNIT) * wp.float64(UNIT))
        v_A = scale * wp.float64(v_conics[k, 0])
        v_B = scale * wp.float64(v_conics[k, 1])
        v_C = scale * wp.float64(v_conics[k, 2])
        v_a += wp.float64(2.0) * a * v_A + b * v_B
        v_b += a * v_B + wp.float64(2.0) * b * v_C
        v_c += wp.float64(2.0) * c * v_C
    twice = wp.float64(2.0) * wp.float64(LN_2)
    guv = -c * v_b / twice
    sums_out[i, 3] = float(b / c * guv - a * v_a / twice)
    sums_out[i, 4] = float(guv)
    sums_out[i, 5] = float(-c * v_c / twice)
    if v_means2d.shape[0] > 0:
        gu = wp.float64(v_means2d[k, 0]) / (twice * a)
        sums_out[i, 1] = float(gu)
        sums_out[i, 2] = float((wp.float64(v_means2d[k, 1]) / twice - b * gu) / c)
    if v_depths.shape[0] > 0:
        sums_out[i, AT_DEPTH] = v_depths[k]
    if v_compensations.shape[0] > 0 and table[k, 9] > wp.sqrt(min_area_ratio):
        sums_out[i, 0] = v_compensations[k] * table[k, 9]
    sums_out[i, SEEN] = 1.0


@wp.kernel
def scatter_colors(
    # In:
    index: wp.array[wp.int64],  # [V] Gaussian of each row
    v_colors: wp.array2d[float],  # [V, 3]
    # Out:
    sums_out: wp.array2d[float],  # [N, 16] the gradient in the first three columns, seen in the last; zeroed
):
    """Gradients of the colours of a table, for `harmonics_backward`."""
    k = wp.tid()
    i = int(index[k])
    seen = float(0.0)
    for c in range(3):
        sums_out[i, c] = v_colors[k, c]
        if v_colors[k, c] != 0.0:
            seen = 1.0
    sums_out[i, SEEN] = seen  # not where a coefficient is not finite: that splat is left out, and zero times it is NaN
