"""Backward pass of projection: from the gradient of splats to that of Gaussians and the camera's pose.

One thread per Gaussian, the same kernels on CPU and CUDA. Compositing leaves, for every Gaussian that reached a tile,
the moments of g = dL/d log2(alpha) / ln 2 under the whitened coordinates (u, v) = L^T d of `gaussian.py`, where
L L^T = kappa Sigma'^-1, kappa = log2(e) / 2 and Sigma' = M M^T + dilation I. The chain then needs no inverse:

    dL/d mean' = 2 L [g u, g v],    dL/dM = (2 / kappa) L [g (u, v)(u, v)^T] (L^T M).
"""

import warp as wp

from sgwarp.kernels.gaussian import (
    EXACT_OPTIONS,
    LOG2_E,
    Pinhole,
    camera_from_world,
    ewa_rows,
    footprint_factor,
    rotation_from_quaternion,
)
from sgwarp.kernels.projection.forward import Knobs
from sgwarp.kernels.transmittance import Lanes

wp.set_module_options(EXACT_OPTIONS)

LN_2 = wp.constant(0.6931471805599453)
SEEN = wp.constant(15)  # column of the sums that is positive where a Gaussian reached a tile
ROWS_AHEAD = wp.constant(16)  # rows between the one that is added and the one that is fetched
POSE_COLUMNS = 12  # gradient of the world-to-camera rotation about the camera's centre, row by row, and translation
mat23 = wp.types.matrix(shape=(2, 3), dtype=wp.float32)


@wp.func_native("""
#if !defined(__CUDA_ARCH__)
    if (entry < places.shape[0]) __builtin_prefetch(rows.data + places.data[entry]);
#endif
""")
def prefetch_row(rows: wp.array[Lanes], places: wp.array[int], entry: int): ...  # a hint for the CPU's cache


@wp.kernel
def sum_intersections(
    # In:
    base: int,  # first rank of this launch
    order: wp.array[int],  # [V] Gaussians
    entries: wp.array[int],  # [V + 1] first entry of each
    places: wp.array[int],  # [I] place of each entry in the tile lists
    rows: wp.array[Lanes],  # [I] by place
    # Out:
    sums_out: wp.array[Lanes],  # [N] zeroed
):
    """Add the rows of each Gaussian's entries, in order, and mark the Gaussian as seen."""
    k = base + wp.tid()
    first = entries[k]
    last = entries[k + 1]
    if first == last:
        return
    total = Lanes(0.0)
    for e in range(first, last):
        prefetch_row(rows, places, e + ROWS_AHEAD)
        total += rows[places[e]]
    total[SEEN] = 1.0
    sums_out[order[k]] = total


@wp.func
def quaternion_gradient(q: wp.vec4, v: wp.mat33) -> wp.vec4:
    """Gradient of a quaternion (w, x, y, z) of any length from that of its rotation matrix."""
    inv_length = 1.0 / wp.length(q)
    n = q * inv_length
    w = n[0]
    x = n[1]
    y = n[2]
    z = n[3]
    # Rotation by the unit quaternion, differentiated as it is written in `rotation_from_quaternion`.
    yz = v[2, 1] - v[1, 2]
    zx = v[0, 2] - v[2, 0]
    xy = v[1, 0] - v[0, 1]
    s_xy = v[0, 1] + v[1, 0]
    s_xz = v[0, 2] + v[2, 0]
    s_yz = v[1, 2] + v[2, 1]
    g = 2.0 * wp.vec4(
        x * yz + y * zx + z * xy,
        w * yz + y * s_xy + z * s_xz - 2.0 * x * (v[1, 1] + v[2, 2]),
        w * zx + x * s_xy + z * s_yz - 2.0 * y * (v[0, 0] + v[2, 2]),
        w * xy + x * s_xz + y * s_yz - 2.0 * z * (v[0, 0] + v[1, 1]),
    )
    return (g - n * wp.dot(n, g)) * inv_length


@wp.func
def point_gradient(camera: Pinhole, point: wp.vec3, v_mean: wp.vec2, v_row_x: wp.vec3, v_row_y: wp.vec3) -> wp.vec3:
    """Gradient of a point in the camera from those of its pixel and of the rows of its EWA Jacobian.

    Where x/z or y/z is clamped, the Jacobian does not depend on it.
    """
    inv_z = 1.0 / point[2]
    x = point[0] * inv_z
    y = point[1] * inv_z
    tx = wp.clamp(x, camera.tangent_min[0], camera.tangent_max[0])
    ty = wp.clamp(y, camera.tangent_min[1], camera.tangent_max[1])
    fx = camera.focal[0] * inv_z
    fy = camera.focal[1] * inv_z
    # Gradients of x/z and y/z; the rows are fx (1, 0, -tx) / z and fy (0, 1, -ty) / z.
    v_x = camera.focal[0] * v_mean[0] - wp.where(tx == x, fx * v_row_x[2], 0.0)
    v_y = camera.focal[1] * v_mean[1] - wp.where(ty == y, fy * v_row_y[2], 0.0)
    v_inv_z = camera.focal[0] * (v_row_x[0] - tx * v_row_x[2]) + camera.focal[1] * (v_row_y[1] - ty * v_row_y[2])
    return wp.vec3(v_x, v_y, -x * v_x - y * v_y - v_inv_z * inv_z) * inv_z


@wp.kernel
def project_backward(
    # In:
    base: int,  # first Gaussian of this launch
    means: wp.array[wp.vec3],  # [N] centres [m]
    quats: wp.array[wp.vec4],  # [N] rotations (w, x, y, z)
    scales: wp.array[wp.vec3],  # [N] standard deviations [m]
    opacities: wp.array[float],  # [N]
    camera: Pinhole,
    knobs: Knobs,
    sums: wp.array2d[float],  # [N, 16] moments of g under 1, u, v, u^2, u v, v^2, then others; last: seen or not
    at_depth: int,  # column of `sums` with the gradient of the depth, -1 = none
    # Out:
    means_out: wp.array[wp.vec3],  # [N] zero where no tile was reached, as all that follow
    quats_out: wp.array[wp.vec4],  # [N]
    scales_out: wp.array[wp.vec3],  # [N]
    opacities_out: wp.array[float],  # [N]
    means2d_out: wp.array[wp.vec2],  # [N] gradient of the projected centres [1 / pixels]
    poses_out: wp.array2d[float],  # [N, POSE_COLUMNS] each Gaussian's share of the pose's gradient, or empty
):
    """Differentiate `project_gaussians`."""
    i = base + wp.tid()
    if sums[i, SEEN] == 0.0:
        means_out[i] = wp.vec3(0.0, 0.0, 0.0)
        quats_out[i] = wp.vec4(0.0, 0.0, 0.0, 0.0)
        scales_out[i] = wp.vec3(0.0, 0.0, 0.0)
        opacities_out[i] = 0.0
        means2d_out[i] = wp.vec2(0.0, 0.0)
        if poses_out.shape[0] > 0:
            for r in range(POSE_COLUMNS):
                poses_out[i, r] = 0.0
        return
    quat = quats[i]
    scale = scales[i]
    away = (means[i] - camera.center) - camera.center_rest
    point = camera_from_world(camera, means[i])
    row_x, row_y = ewa_rows(camera, point)
    rotation = rotation_from_quaternion(quat)
    axes = camera.rotation * rotation
    along_x = wp.transpose(axes) * row_x
    along_y = wp.transpose(axes) * row_y
    m_x = wp.cw_mul(along_x, scale)
    m_y = wp.cw_mul(along_y, scale)
    minors = wp.cross(m_x, m_y)
    sharp = wp.length_sq(minors)
    xx = wp.length_sq(m_x)
    yy = wp.length_sq(m_y)
    determinant = sharp + knobs.dilation * (xx + yy) + knobs.dilation * knobs.dilation
    yy += knobs.dilation
    a, b, c = footprint_factor(wp.dot(m_x, m_y), yy, determinant)

    g = LN_2 * sums[i, 0]
    gu = LN_2 * sums[i, 1]
    gv = LN_2 * sums[i, 2]
    guu = LN_2 * sums[i, 3]
    guv = LN_2 * sums[i, 4]
    gvv = LN_2 * sums[i, 5]
    v_mean = wp.vec2(2.0 * a * gu, 2.0 * (b * gu + c * gv))
    # N = L^T M, then L (moments N).
    n_u = a * m_x + b * m_y
    n_v = c * m_y
    weight = 4.0 / LOG2_E
    q_u = weight * (guu * n_u + guv * n_v)
    q_v = weight * (guv * n_u + gvv * n_v)
    v_x = a * q_u
    v_y = b * q_u + c * q_v
    half = 0.5 * g / LN_2
    # A splat seen end on (sharp = 0) has no gradient here, and zero times infinity is NaN.
    if knobs.antialiased != 0 and half != 0.0:
        # opacity sqrt(sharp / determinant): half the logarithm of both.
        v_sharp = half * (1.0 / sharp - 1.0 / determinant)
        v_trace = -half * knobs.dilation / determinant
        v_x += 2.0 * (v_sharp * wp.cross(m_y, minors) + v_trace * m_x)
        v_y += 2.0 * (v_sharp * wp.cross(minors, m_x) + v_trace * m_y)

    scaled_x = wp.cw_mul(v_x, scale)
    scaled_y = wp.cw_mul(v_y, scale)
    v_axes = wp.outer(row_x, scaled_x) + wp.outer(row_y, scaled_y)
    v_point = point_gradient(camera, point, v_mean, axes * scaled_x, axes * scaled_y)
    if at_depth >= 0:
        v_point[2] = v_point[2] + sums[i, at_depth]
    means_out[i] = wp.transpose(camera.rotation) * v_point
    quats_out[i] = quaternion_gradient(quat, wp.transpose(camera.rotation) * v_axes)
    scales_out[i] = wp.cw_mul(v_x, along_x) + wp.cw_mul(v_y, along_y)
    opacities_out[i] = g / (LN_2 * opacities[i])
    means2d_out[i] = v_mean
    if poses_out.shape[0] > 0:
        v_rotation = wp.outer(v_point, away) + v_axes * wp.transpose(rotation)
        for r in range(3):
            for s in range(3):
                poses_out[i, 3 * r + s] = v_rotation[r, s]
            poses_out[i, 9 + r] = v_point[r]


@wp.kernel
def sum_groups(
    # In:
    base: int,  # first group of this launch
    rows: wp.array2d[float],  # [N, Q]
    per_group: int,  # rows of a group
    # Out:
    sums_out: wp.array2d[wp.float64],  # [groups, Q]
):
    """Add rows group by group in double precision, in an order that no number of threads changes."""
    group = base + wp.tid()
    for q in range(rows.shape[1]):
        total = wp.float64(0.0)
        for i in range(group * per_group, wp.min((group + 1) * per_group, rows.shape[0])):
            total += wp.float64(rows[i, q])
        sums_out[group, q] = total
