"""Gaussian -> splat, lane schedule (CPU): `project_gaussians` for 16 Gaussians at a time, in C++ (`native.py`).

The maths and its order are those of `forward.py` and `backward.py`, where they are explained; the tests
compare them splat by splat. Comparisons are exact about NaN and infinity, as there.
"""

import warp as wp

from sgwarp.kernels.gaussian import EXACT_OPTIONS, LOG2_E, MIN_QUAT_NORM2, UNIT, Pinhole, Splat
from sgwarp.kernels.harmonics import lanes as harmonics
from sgwarp.kernels.harmonics.forward import BRIGHTEST
from sgwarp.kernels.native import by_groups, columns, snippet
from sgwarp.kernels.projection.backward import LN_2, SEEN
from sgwarp.kernels.projection.forward import (
    DEGENERATE,
    NON_FINITE,
    OFF_SCREEN,
    OUTSIDE_DEPTH,
    TRANSPARENT,
    VISIBLE,
    Knobs,
)

wp.set_module_options(EXACT_OPTIONS)

# Columns of 16 Gaussians; what lies beyond the last repeats it.
COLUMNS = """
    const int first = group * 16, count = means.shape[0] - first < 16 ? means.shape[0] - first : 16;
    const auto read = [&](const auto& split, const auto& array, int width, Row* to) {
        const float* const from = reinterpret_cast<const float*>(array.data + first);
        if (count == 16) return split(from, to);
        float padded[64];
        for (int i = 0; i < 16; ++i)
            for (int j = 0; j < width; ++j) padded[i * width + j] = from[(i < count ? i : count - 1) * width + j];
        split(padded, to);
    };
    Row mean[3], quat[4], scale[3], given[1];
    read(split_3, means, 3, mean);
    read(split_4, quats, 4, quat);
    read(split_3, scales, 3, scale);
    read(split_1, opacities, 1, given);
    const auto root = [](Row x) -> Row { return __builtin_elementwise_sqrt(x); };
    const auto& view = camera.rotation.data;
"""

# The centre seen from the camera: `away` in the world's axes, `point` in the camera's.
POINT = """
    Row away[3], point[3];
    for (int j = 0; j < 3; ++j) away[j] = (mean[j] - camera.center[j]) - camera.center_rest[j];
    for (int j = 0; j < 3; ++j) point[j] = view[j][0] * away[0] + view[j][1] * away[1] + view[j][2] * away[2];
"""

# Rows of J: (fx, 0, sx) and (0, fy, sy), with x/z and y/z clamped.
JACOBIAN = """
    const Row inv_z = 1.0f / point[2];
    Row slope[2], tangent[2];
    for (int j = 0; j < 2; ++j) {
        slope[j] = point[j] * inv_z;
        const Row low = zero + camera.tangent_min[j], high = zero + camera.tangent_max[j];
        const Row clamped = slope[j] < low ? low : slope[j];
        tangent[j] = clamped > high ? high : clamped;
    }
    const Row fx = camera.focal[0] * inv_z, fy = camera.focal[1] * inv_z, sx = -fx * tangent[0], sy = -fy * tangent[1];
"""

# M = J W R S, rows m_x and m_y; `along` is M without the scales. Determinant and entries of the dilated M M^T.
FACTOR = """
    const Row norm2 = quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3], s = 2.0f / norm2;
    const Row qx = s * quat[1], qy = s * quat[2], qz = s * quat[3];
    const Row w_x = qx * quat[0], w_y = qy * quat[0], w_z = qz * quat[0], x_x = qx * quat[1], x_y = qx * quat[2];
    const Row x_z = qx * quat[3], y_y = qy * quat[2], y_z = qy * quat[3], z_z = qz * quat[3];
    const Row R[3][3] = {{1.0f - (y_y + z_z), x_y - w_z, x_z + w_y},
                         {x_y + w_z, 1.0f - (x_x + z_z), y_z - w_x},
                         {x_z - w_y, y_z + w_x, 1.0f - (x_x + y_y)}};
    Row axes[3][3], along_x[3], along_y[3], m_x[3], m_y[3];
    for (int j = 0; j < 3; ++j) {
        for (int i = 0; i < 3; ++i) axes[i][j] = view[i][0] * R[0][j] + view[i][1] * R[1][j] + view[i][2] * R[2][j];
        along_x[j] = fx * axes[0][j] + sx * axes[2][j], along_y[j] = fy * axes[1][j] + sy * axes[2][j];
        m_x[j] = along_x[j] * scale[j], m_y[j] = along_y[j] * scale[j];
    }
    const Row minors[3] = {m_x[1] * m_y[2] - m_x[2] * m_y[1], m_x[2] * m_y[0] - m_x[0] * m_y[2],
                           m_x[0] * m_y[1] - m_x[1] * m_y[0]};
    const Row sharp = minors[0] * minors[0] + minors[1] * minors[1] + minors[2] * minors[2];
    Row xx = m_x[0] * m_x[0] + m_x[1] * m_x[1] + m_x[2] * m_x[2];
    Row yy = m_y[0] * m_y[0] + m_y[1] * m_y[1] + m_y[2] * m_y[2];
    const Row xy = m_x[0] * m_y[0] + m_x[1] * m_y[1] + m_x[2] * m_y[2];
    const Row determinant = sharp + knobs.dilation * (xx + yy) + knobs.dilation * knobs.dilation;
    xx += knobs.dilation;
    yy += knobs.dilation;
    const Row root_det = root(determinant), inv_y = 1.0f / root(yy), scaled = UNIT * inv_y / root_det;
    const Row a = scaled * yy, b = -scaled * xy, c = UNIT * inv_y;
"""

PROJECT = (
    COLUMNS
    + """
    const auto magnitude = [](Row x) -> Row { return __builtin_elementwise_abs(x); };
    const auto larger = [](Row x, Row y) -> Row { return x > y ? x : y; };
    const float largest_float = 3.4028234e38f;

    // Why each is left out: the first reason that holds.
    const Ints visible = VISIBLE;
    auto& kept = held[group % GROUPS];
    Ints& status = kept.status;
    status = visible;
    const auto leave_out = [&](Ints holds, int reason) {
        const Ints code = reason;
        status = (status == visible) & holds ? code : status;
    };
    const Row length2 = quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3];
    Row total = magnitude(given[0]) + length2;
    for (int j = 0; j < 3; ++j) total += magnitude(mean[j]) + magnitude(scale[j]);
    leave_out(~(total <= largest_float) | ~(length2 >= MIN_NORM2), NON_FINITE);
    const Ints negative = (scale[0] < zero) | (scale[1] < zero) | (scale[2] < zero) | (given[0] < zero);
    if (bits(negative | (given[0] > 1.0f))) invalid_out.data[0] = 1;  // NaN is not
    leave_out(given[0] < knobs.alpha_min, TRANSPARENT);

    POINT
    leave_out(~((point[2] > camera.near) & (point[2] < camera.far)), OUTSIDE_DEPTH);
    if (!bits(status == visible)) return;

    JACOBIAN
    const Row x = camera.focal[0] * slope[0] + camera.principal[0];
    const Row y = camera.focal[1] * slope[1] + camera.principal[1];
    // Not even a round, opaque Gaussian of the largest scale would reach the image.
    const Row largest = larger(larger(scale[0], scale[1]), scale[2]), largest2 = largest * largest;
    const float reach2 = (LEVEL_SLACK - knobs.alpha_min_level) * 2.0f / LOG2_E;
    const float width = camera.width, height = camera.height;
    const Row off_x = larger(larger(-x, x - width), zero), off_y = larger(larger(-y, y - height), zero);
    leave_out((off_x * off_x > reach2 * (largest2 * (fx * fx + sx * sx) + knobs.dilation))
            | (off_y * off_y > reach2 * (largest2 * (fy * fy + sy * sy) + knobs.dilation)), OFF_SCREEN);

    FACTOR
    leave_out(~((determinant > zero) & (determinant <= largest_float) & (yy > zero)), DEGENERATE);
    Row alpha = given[0];
    if (knobs.antialiased) {
        alpha *= root(sharp / determinant);
        leave_out(alpha < knobs.alpha_min, TRANSPARENT);
    }

    const Row root_xx = root(xx), root_yy = root(yy);
    // log2 alpha: the exponent, and the mantissa m in (sqrt 1/2, sqrt 2) by artanh((m - 1) / (m + 1)).
    const Ints pattern = reinterpret_cast<Ints>(alpha), shifted = pattern - 0x3f3504f3;
    const Row whole = __builtin_convertvector(shifted >> 23, Row);
    const Row m = reinterpret_cast<Row>((shifted & 0x7fffff) + 0x3f3504f3);
    const Row t = (m - 1.0f) / (m + 1.0f), t2 = t * t;
    const Row series = ((t2 * 0.1111111f + 0.14285715f) * t2 + 0.2f) * t2 + 0.33333334f;
    const Row level = whole + 2.885390082f * (t + t * t2 * series);
    const Row reach = level - knobs.alpha_min_level + LEVEL_SLACK, radius = root(reach) * (1.0f / UNIT);
    const Row half_width = radius * root_xx, half_height = radius * root_yy;
    const Row inv_bc = root_det / root_xx * (1.0f / UNIT), summit = -b * half_height * inv_bc;
    leave_out(~((x + half_width >= 0.5f) & (x - half_width <= width - 0.5f) & (y + half_height >= 0.5f)
              & (y - half_height <= height - 0.5f)), OFF_SCREEN);

    const Row lines[12] = {x, y, a, b, c, level, point[2], half_width, half_height, reach, summit, inv_bc};
    for (int e = 0; e < 12; ++e) kept.lines[e] = lines[e];
    for (int j = 0; j < 3; ++j) kept.away[j] = away[j];
    // Coefficients are fetched while the next groups are projected.
    const int size = 12 * (degree + 1) * (degree + 1);
    for (unsigned left = degree < 0 ? 0 : bits(status == visible) & ((1u << count) - 1); left; left &= left - 1) {
        const auto* const values = sh.data + (long long)(first + __builtin_ctz(left)) * sh.shape[1];
        for (int byte = 0; byte < size; byte += 64) __builtin_prefetch(reinterpret_cast<const char*>(values) + byte);
    }
""".replace("    POINT\n", POINT)
    .replace("    JACOBIAN\n", JACOBIAN)
    .replace("    FACTOR\n", FACTOR)
)

# What the groups of a thread keep until the coefficients have come.
HELD = """
    struct Held {
        Row lines[12], away[3];
        Ints status;
    };
    Held held[GROUPS] __attribute__((aligned(64)));
"""

# Colours up to `degree`, and the splats. Those whose coefficients are not finite are left out as well.
FINISH = """
    const int first = group * 16, count = means.shape[0] - first < 16 ? means.shape[0] - first : 16;
    auto& kept = held[group % GROUPS];
    const Ints visible = VISIBLE;
    Ints status = kept.status;
    Row lines[16] = {};
    unsigned left = bits(status == visible) & ((1u << count) - 1);
    if (degree >= 0 && left) {
        COEFFICIENTS
        read_coefficients(left);
        Row wrong = zero;  // zero times infinity or NaN is NaN
#pragma clang loop unroll(full)
        for (int e = 0; e < MOST; ++e)
            if (e < in_use) wrong += 0.0f * blocks[e / 16][e % 16];
        const Ints broken = NON_FINITE;
        status = (status == visible) & ~(wrong == zero) ? broken : status;
        left &= bits(status == visible);
        const Row* const away = kept.away;
        DIRECTION
        COLOR
        for (int j = 0; j < 3; ++j) {
            const Row shown = color[j] > zero ? color[j] : zero;
            lines[13 + j] = __builtin_elementwise_min(shown, zero + BRIGHTEST);
        }
    }
    typedef wp::uint8 Bytes __attribute__((ext_vector_type(16), aligned(1)));
    const Bytes bytes = __builtin_convertvector(status, Bytes);
    if (count == 16) *reinterpret_cast<Bytes*>(status_out.data + first) = bytes;
    else for (int i = 0; i < count; ++i) status_out.data[first + i] = bytes[i];
    if (!left) return;
    for (int e = 0; e < 12; ++e) lines[e] = kept.lines[e];
    if (count == 16) *reinterpret_cast<Row*>(depths_out.data + first) = lines[6];
    else for (int i = 0; i < count; ++i) depths_out.data[first + i] = lines[6][i];
    transpose(lines);
    for (; left; left &= left - 1) {
        const int i = __builtin_ctz(left);
        reinterpret_cast<Row*>(splats_out.data)[first + i] = lines[i];
    }
""".replace("        COEFFICIENTS\n", harmonics.COEFFICIENTS)
FINISH = FINISH.replace("        DIRECTION\n", harmonics.DIRECTION).replace("        COLOR\n", harmonics.COLOR)


CONSTANTS = {
    "BRIGHTEST": float(BRIGHTEST),
    "MIN_NORM2": float(MIN_QUAT_NORM2),
    "UNIT": float(UNIT),
    "LOG2_E": float(LOG2_E),
    "LN_2": float(LN_2),
    "SEEN": int(SEEN),
    "VISIBLE": int(VISIBLE),
    "NON_FINITE": int(NON_FINITE),
    "TRANSPARENT": int(TRANSPARENT),
    "OUTSIDE_DEPTH": int(OUTSIDE_DEPTH),
    "OFF_SCREEN": int(OFF_SCREEN),
    "DEGENERATE": int(DEGENERATE),
}


@wp.func_native(snippet(columns(1, 3, 4) + HELD + by_groups(PROJECT, FINISH, count="means.shape[0]"), **CONSTANTS))
def project_group(
    block: int,
    means: wp.array[wp.vec3],
    quats: wp.array[wp.vec4],
    scales: wp.array[wp.vec3],
    opacities: wp.array[float],
    sh: wp.array2d[wp.vec3],
    degree: int,
    camera: Pinhole,
    knobs: Knobs,
    splats_out: wp.array[Splat],
    status_out: wp.array[wp.uint8],
    depths_out: wp.array[float],
    invalid_out: wp.array[int],
): ...


@wp.kernel
def project_groups(
    # In:
    base: int,  # first GROUP of this launch
    means: wp.array[wp.vec3],  # [N] centres [m]
    quats: wp.array[wp.vec4],  # [N] rotations (w, x, y, z)
    scales: wp.array[wp.vec3],  # [N] standard deviations [m]
    opacities: wp.array[float],  # [N]
    sh: wp.array2d[wp.vec3],  # [N, K] coefficients; or empty
    degree: int,  # of the colours, -1 = none
    camera: Pinhole,
    knobs: Knobs,
    # Out:
    splats_out: wp.array[Splat],  # [N] valid where visible, with colours if asked for
    status_out: wp.array[wp.uint8],  # [N] VISIBLE or why not
    depths_out: wp.array[float],  # [N] z in the camera frame [m], where visible
    invalid_out: wp.array[int],  # [1] set if some scale is negative or opacity outside [0, 1]
):
    """Project a few times 16 Gaussians (paper eq. 2, 3) and decide whether any pixel can see them."""
    project_group(
        base + wp.tid(),
        means,
        quats,
        scales,
        opacities,
        sh,
        degree,
        camera,
        knobs,
        splats_out,
        status_out,
        depths_out,
        invalid_out,
    )
