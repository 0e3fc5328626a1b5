"""Device functions of one Gaussian: camera frame, projected covariance, footprint.

Conventions: OpenCV camera axes (x right, y down, z forward), quaternions (w, x, y, z), pixel centres at .5.

The projected covariance is kept as a factor, never as a difference of products: with M = J W R S (2 x 3),
Sigma' = M M^T + dilation I. Its determinant is a sum of squares (Cauchy-Binet), and the exponent of the footprint is
u^2 + v^2 with u = a dx + b dy, v = c dy (Cholesky), so needles lose no digits to cancellation.
"""

import warp as wp

# Exact about NaN and infinity, which projection looks for.
EXACT_OPTIONS = {
    "enable_backward": False,
    "fast_math": False,
    "cpu_compiler_flags": "-march=native -ffp-contract=fast -mprefer-vector-width=512 -mllvm=-inline-threshold=9000",
}
wp.set_module_options(EXACT_OPTIONS)

LOG2_E = wp.constant(1.4426950408889634)
UNIT = wp.constant(0.8493218002880191)  # sqrt(log2(e) / 2): makes the exponent of a footprint a power of two
MIN_QUAT_NORM2 = wp.constant(1.0e-6)  # |q|^2 below this has no direction
LEVEL_SLACK = wp.constant(1.0e-4)  # widens footprints by this many powers of two: culling errs on the safe side


@wp.struct
class Pinhole:
    """A camera on the device. The centre is split in two floats, so that scenes at 1e5 m keep millimetres."""

    rotation: wp.mat33  # world to camera
    center: wp.vec3  # camera centre in the world [m]
    center_rest: wp.vec3  # what float32 rounding took from the centre [m]
    focal: wp.vec2  # fx, fy [pixels]
    principal: wp.vec2  # cx, cy [pixels]
    tangent_min: wp.vec2  # EWA clamp of x/z, y/z
    tangent_max: wp.vec2
    width: int
    height: int
    near: float  # [m]
    far: float  # [m]


@wp.struct
class Splat:
    """A projected Gaussian: alpha(dx, dy) = 2^(level - u^2 - v^2), u = a dx + b dy, v = c dy.

    64 bytes, one line of the cache. The last fields are filled in once the splats lie in depth order.
    """

    mean: wp.vec2  # [pixels]
    a: float
    b: float
    c: float
    level: float  # log2 of the opacity
    depth: float  # z in the camera frame [m]
    half_width: float  # of the footprint {alpha >= alpha_min} [pixels]
    half_height: float
    reach: float  # the footprint is u^2 + v^2 <= reach
    summit: float  # dy at which its right border is furthest right [pixels]
    inv_bc: float  # 1 / sqrt(b^2 + c^2) [pixels]
    gaussian: int
    color: wp.vec3


@wp.func
def rotation_from_quaternion(q: wp.vec4) -> wp.mat33:
    """Rotation matrix of q = (w, x, y, z), which need not be normalised."""
    s = 2.0 / wp.dot(q, q)
    x = s * q[1]
    y = s * q[2]
    z = s * q[3]
    wx = x * q[0]
    wy = y * q[0]
    wz = z * q[0]
    xx = x * q[1]
    xy = x * q[2]
    xz = x * q[3]
    yy = y * q[2]
    yz = y * q[3]
    zz = z * q[3]
    return wp.mat33(
        1.0 - (yy + zz), xy - wz, xz + wy, xy + wz, 1.0 - (xx + zz), yz - wx, xz - wy, yz + wx, 1.0 - (xx + yy)
    )


@wp.func
def camera_from_world(camera: Pinhole, mean: wp.vec3) -> wp.vec3:
    """Camera coordinates of a world point [m]; the subtraction comes first, so far origins cost no digits."""
    return camera.rotation * ((mean - camera.center) - camera.center_rest)


@wp.func
def ewa_rows(camera: Pinhole, point: wp.vec3):
    """Rows of J (EWA Jacobian of the pinhole projection), x/z and y/z clamped around the principal point."""
    inv_z = 1.0 / point[2]
    tx = wp.clamp(point[0] * inv_z, camera.tangent_min[0], camera.tangent_max[0])
    ty = wp.clamp(point[1] * inv_z, camera.tangent_min[1], camera.tangent_max[1])
    row_x = wp.vec3(camera.focal[0] * inv_z, 0.0, -camera.focal[0] * tx * inv_z)
    row_y = wp.vec3(0.0, camera.focal[1] * inv_z, -camera.focal[1] * ty * inv_z)
    return row_x, row_y


@wp.func
def projected_factor(camera: Pinhole, point: wp.vec3, quat: wp.vec4, scale: wp.vec3):
    """Rows of M = J W R S [pixels]; the projected covariance is M M^T."""
    row_x, row_y = ewa_rows(camera, point)
    axes = camera.rotation * rotation_from_quaternion(quat)
    m_x = wp.cw_mul(wp.transpose(axes) * row_x, scale)
    m_y = wp.cw_mul(wp.transpose(axes) * row_y, scale)
    return m_x, m_y


@wp.func
def factor_determinant(m_x: wp.vec3, m_y: wp.vec3) -> float:
    """det(M M^T) as the sum of squared minors (Cauchy-Binet): exact zero for needles seen end on, never negative."""
    return wp.length_sq(wp.cross(m_x, m_y))


@wp.func
def footprint_factor(xy: float, yy: float, determinant: float):
    """(a, b, c) of a splat: Cholesky rows of the conic of its dilated covariance, scaled by `UNIT`."""
    inv_y = 1.0 / wp.sqrt(yy)
    inv_root = 1.0 / wp.sqrt(determinant)
    scaled = UNIT * inv_y * inv_root
    return scaled * yy, -scaled * xy, UNIT * inv_y


@wp.func
def column_range(splat: Splat, y_first: float, y_last: float):
    """Exact range of x [pixels] that the footprint covers between two heights; empty if first > second.

    The right border x(y) = (-b y + sqrt(reach - c^2 y^2)) / a is concave, so its largest value over a band lies at the
    summit or at the end of the band nearest to it; the left border mirrors it.
    """
    lo = wp.max(y_first - splat.mean[1], -splat.half_height)
    hi = wp.min(y_last - splat.mean[1], splat.half_height)
    y_right = wp.clamp(splat.summit, lo, hi)
    y_left = wp.clamp(-splat.summit, lo, hi)
    cr = splat.c * y_right
    cl = splat.c * y_left
    inv_a = 1.0 / splat.a
    right = (wp.sqrt(wp.max(splat.reach - cr * cr, 0.0)) - splat.b * y_right) * inv_a
    left = (-wp.sqrt(wp.max(splat.reach - cl * cl, 0.0)) - splat.b * y_left) * inv_a
    right = wp.where(lo > hi, -1.0e30, right)
    left = wp.where(lo > hi, 1.0e30, left)
    return splat.mean[0] + left, splat.mean[0] + right
