"""Adjoint of projection and colour, lane schedule (CPU): 16 Gaussians at a time, in C++ (`native.py`).

The maths and its order are those of `backward.py`, where they are explained, and of `harmonics/backward.py`; the tests
compare them. In the common case one kernel adds up a Gaussian's rows, differentiates both and writes every gradient:
what lies between these steps never leaves the registers.
"""

import warp as wp

from sgwarp.kernels.gaussian import EXACT_OPTIONS, Pinhole
from sgwarp.kernels.harmonics import lanes as harmonics
from sgwarp.kernels.native import by_groups, columns, snippet
from sgwarp.kernels.projection.forward import Knobs
from sgwarp.kernels.projection.lanes import COLUMNS, CONSTANTS, FACTOR, JACOBIAN, POINT
from sgwarp.kernels.transmittance import Lanes

wp.set_module_options(EXACT_OPTIONS)

MOMENTS = """
    Row moments[16];
    const Row* const of_gaussians = reinterpret_cast<const Row*>(sums.data) + first;
    for (int i = 0; i < 16; ++i) moments[i] = of_gaussians[i < count ? i : count - 1];
    transpose(moments);
    const Ints seen = moments[SEEN] != zero;
"""

# The sums of `sum_used_rows`. Rows and coefficients of the next 16 are fetched meanwhile.
GATHER = """
    // By arithmetic, not by branches: whether a Gaussian is seen and has a second row is anybody's guess.
    const Row nothing = zero;
    const unsigned char unused = 0;
    const auto* const all_rows = rows.shape[0] > 0 ? reinterpret_cast<const Row*>(rows.data) : &nothing;
    const auto* const all_used = used.shape[0] > 0 ? used.data : &unused;  // nothing may be in view
    const auto fetch = [&](int i) {
        const int first_row = ranges.data[2 * i], more = ranges.data[2 * i + 1] - 1, visible = ~(more >> 31);
        const Row* const row = all_rows + first_row;
        const auto* const values = sh.data + (long long)(i & visible) * sh.shape[1];
        __builtin_prefetch(used.data + first_row);
        __builtin_prefetch(row);
        for (int step = 1; step < 4; ++step) __builtin_prefetch(row + (step <= more ? step : 0));
        for (int line = 0; line < 3; ++line) __builtin_prefetch(reinterpret_cast<const char*>(values) + 64 * line);
    };
    const auto fetch_columns = [&](const auto& array, int width) {
        const char* const next = reinterpret_cast<const char*>(array.data + first) + 64 * width;
        for (int line = 0; line < width; ++line) __builtin_prefetch(next + 64 * line);
    };
    fetch_columns(means, 3);
    fetch_columns(quats, 4);
    fetch_columns(scales, 3);
    fetch_columns(opacities, 1);
    Row moments[16];
    int seen_bits = 0;
    for (int i = 0; i < 16; ++i) {
        fetch(first + 16 + i < means.shape[0] ? first + 16 + i : 0);
        const int start = i < count ? ranges.data[2 * (first + i)] : 0;
        const int rows_here = i < count ? ranges.data[2 * (first + i) + 1] : 0;
        const auto add = [&](Row sum, int row, int there) -> Row {
            const int taken = -(there & all_used[row]);
            seen_bits |= taken & 1 << i;
            return sum + reinterpret_cast<Row>(reinterpret_cast<Ints>(all_rows[row]) & taken);
        };
        const int some = rows_here > 0, more = rows_here > 1;
        Row total = add(add(zero, start * some, some), (start + 1) * more, more);  // few have more than two
#pragma clang loop unroll(disable)
        for (int row = start + 2; row < start + rows_here; ++row) total = add(total, row, 1);
        moments[i] = total;
    }
    transpose(moments);
    const Ints lane_bits = {1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024, 2048, 4096, 8192, 16384, 32768};
    const Ints seen = (lane_bits & seen_bits) != 0;
"""

WRITE = """
    const auto write = [&](const auto& join, const auto& array, int width, const Row* from) {
        Row kept[4];
        for (int j = 0; j < width; ++j) kept[j] = seen ? from[j] : zero;
        float* const to = reinterpret_cast<float*>(array.data) + (long long)first * width;
        if (count == 16) return join(kept, to);
        float padded[64];
        join(kept, padded);
        for (int i = 0; i < count * width; ++i) to[i] = padded[i];
    };
"""

PROJECTION = (
    """
    POINT
    JACOBIAN
    FACTOR
    const Row g = LN_2 * moments[0], gu = LN_2 * moments[1], gv = LN_2 * moments[2];
    const Row guu = LN_2 * moments[3], guv = LN_2 * moments[4], gvv = LN_2 * moments[5];
    const Row v_pixel[2] = {2.0f * a * gu, 2.0f * (b * gu + c * gv)};
    // N = L^T M, then L (moments N).
    Row v_x[3], v_y[3];
    for (int j = 0; j < 3; ++j) {
        const Row n_u = a * m_x[j] + b * m_y[j], n_v = c * m_y[j];
        const Row q_u = (4.0f / LOG2_E) * (guu * n_u + guv * n_v), q_v = (4.0f / LOG2_E) * (guv * n_u + gvv * n_v);
        v_x[j] = a * q_u, v_y[j] = b * q_u + c * q_v;
    }
    if (knobs.antialiased) {
        // opacity sqrt(sharp / determinant): half the logarithm of both.
        // A splat seen end on (sharp = 0) has no gradient here, and zero times infinity is NaN.
        const Row half = 0.5f * moments[0];
        const Row v_sharp = half == zero ? zero : half * (1.0f / sharp - 1.0f / determinant);
        const Row v_trace = -half * knobs.dilation / determinant;
        for (int j = 0; j < 3; ++j) {
            const int k = (j + 1) % 3, l = (j + 2) % 3;
            v_x[j] += 2.0f * (v_sharp * (m_y[k] * minors[l] - m_y[l] * minors[k]) + v_trace * m_x[j]);
            v_y[j] += 2.0f * (v_sharp * (minors[k] * m_x[l] - minors[l] * m_x[k]) + v_trace * m_y[j]);
        }
    }
    Row scaled_x[3], scaled_y[3], v_scale[3], v_axes[3][3];
    for (int j = 0; j < 3; ++j) {
        scaled_x[j] = v_x[j] * scale[j], scaled_y[j] = v_y[j] * scale[j];
        v_scale[j] = v_x[j] * along_x[j] + v_y[j] * along_y[j];
        v_axes[0][j] = fx * scaled_x[j], v_axes[1][j] = fy * scaled_y[j];
        v_axes[2][j] = sx * scaled_x[j] + sy * scaled_y[j];
    }
    // Of the rows of J; where x/z or y/z is clamped, J does not depend on it.
    Row row_x[3], row_y[3];
    for (int i = 0; i < 3; ++i) {
        row_x[i] = axes[i][0] * scaled_x[0] + axes[i][1] * scaled_x[1] + axes[i][2] * scaled_x[2];
        row_y[i] = axes[i][0] * scaled_y[0] + axes[i][1] * scaled_y[1] + axes[i][2] * scaled_y[2];
    }
    const Row free_x = tangent[0] == slope[0] ? fx * row_x[2] : zero;
    const Row free_y = tangent[1] == slope[1] ? fy * row_y[2] : zero;
    const Row v_slope_x = camera.focal[0] * v_pixel[0] - free_x, v_slope_y = camera.focal[1] * v_pixel[1] - free_y;
    const Row v_inv_z = camera.focal[0] * (row_x[0] - tangent[0] * row_x[2])
                      + camera.focal[1] * (row_y[1] - tangent[1] * row_y[2]);
    Row v_point[3] = {v_slope_x * inv_z, v_slope_y * inv_z,
                      (-slope[0] * v_slope_x - slope[1] * v_slope_y - v_inv_z * inv_z) * inv_z};
    if (at_depth >= 0) v_point[2] += moments[at_depth];
    // From the camera's axes to the world's.
    Row v_mean[3], v[3][3];
    for (int i = 0; i < 3; ++i) {
        v_mean[i] = view[0][i] * v_point[0] + view[1][i] * v_point[1] + view[2][i] * v_point[2];
        for (int j = 0; j < 3; ++j)
            v[i][j] = view[0][i] * v_axes[0][j] + view[1][i] * v_axes[1][j] + view[2][i] * v_axes[2][j];
    }
    // `quaternion_gradient`.
    const Row inv_length = 1.0f / root(norm2);
    const Row unit[4] = {quat[0] * inv_length, quat[1] * inv_length, quat[2] * inv_length, quat[3] * inv_length};
    const Row qw = unit[0], ux = unit[1], uy = unit[2], uz = unit[3];
    const Row yz = v[2][1] - v[1][2], zx = v[0][2] - v[2][0], xy_ = v[1][0] - v[0][1];
    const Row s_xy = v[0][1] + v[1][0], s_xz = v[0][2] + v[2][0], s_yz = v[1][2] + v[2][1];
    Row v_quat[4] = {2.0f * (ux * yz + uy * zx + uz * xy_),
                     2.0f * (qw * yz + uy * s_xy + uz * s_xz - 2.0f * ux * (v[1][1] + v[2][2])),
                     2.0f * (qw * zx + ux * s_xy + uz * s_yz - 2.0f * uy * (v[0][0] + v[2][2])),
                     2.0f * (qw * xy_ + ux * s_xz + uy * s_yz - 2.0f * uz * (v[0][0] + v[1][1]))};
    const Row radial = qw * v_quat[0] + ux * v_quat[1] + uy * v_quat[2] + uz * v_quat[3];
    for (int j = 0; j < 4; ++j) v_quat[j] = (v_quat[j] - unit[j] * radial) * inv_length;
    const Row v_opacity = moments[0] / given[0];
""".replace("    POINT\n", POINT)
    .replace("    JACOBIAN\n", JACOBIAN)
    .replace("    FACTOR\n", FACTOR)
)

WRITE_ALL = """
    write(join_3, means_out, 3, v_mean);
    write(join_4, quats_out, 4, v_quat);
    write(join_3, scales_out, 3, v_scale);
    write(join_1, opacities_out, 1, &v_opacity);
    if (means2d_out.shape[0] > 0) write(join_2, means2d_out, 2, v_pixel);
    if (poses_out.shape[0] > 0) {
        Row pose[12];
        for (int r = 0; r < 3; ++r) {
            for (int j = 0; j < 3; ++j)
                pose[3 * r + j] = v_point[r] * away[j] + v_axes[r][0] * R[j][0] + v_axes[r][1] * R[j][1]
                                + v_axes[r][2] * R[j][2];
            pose[9 + r] = v_point[r];
        }
        for (int j = 0; j < 12; ++j) {
            const Row kept = seen ? pose[j] : zero;
            for (int i = 0; i < count; ++i) poses_out.data[(first + i) * 12 + j] = kept[i];
        }
    }
"""

# A channel that was clamped at zero has no gradient.
COLOR = (
    harmonics.COEFFICIENTS
    + harmonics.TARGET
    + """
    Row v_away[3] = {zero, zero, zero};
    if (!seen_bits) no_coefficients();
    else {
        read_coefficients(seen_bits);
        DIRECTION
        COLOR
        Row v[3];
        for (int j = 0; j < 3; ++j) v[j] = (seen & (color[j] > zero)) ? moments[at_color + j] : zero;
        TO_DIRECTION
        SPREAD
        for (int j = 0; j < 3; ++j) v_mean[j] += v_away[j];
    }
    if (offsets_out.shape[0] > 0) write(join_3, offsets_out, 3, v_away);
""".replace("        DIRECTION\n", harmonics.DIRECTION)
    .replace("        COLOR\n", harmonics.COLOR)
    .replace("        TO_DIRECTION\n", harmonics.TO_DIRECTION)
    .replace("        SPREAD\n", harmonics.SPREAD)
)

BACKWARD = columns(1, 2, 3, 4) + by_groups(COLUMNS + MOMENTS + WRITE + PROJECTION + WRITE_ALL, count="means.shape[0]")
TOGETHER = columns(1, 2, 3, 4) + by_groups(
    COLUMNS + GATHER + WRITE + PROJECTION + COLOR + WRITE_ALL, count="means.shape[0]"
)


@wp.func_native(snippet(BACKWARD, **CONSTANTS))
def project_group_backward(
    block: int,
    means: wp.array[wp.vec3],
    quats: wp.array[wp.vec4],
    scales: wp.array[wp.vec3],
    opacities: wp.array[float],
    camera: Pinhole,
    knobs: Knobs,
    sums: wp.array2d[float],
    at_depth: int,
    means_out: wp.array[wp.vec3],
    quats_out: wp.array[wp.vec4],
    scales_out: wp.array[wp.vec3],
    opacities_out: wp.array[float],
    means2d_out: wp.array[wp.vec2],
    poses_out: wp.array2d[float],
): ...


@wp.kernel
def project_groups_backward(
    # In:
    base: int,  # first GROUP of this launch
    means: wp.array[wp.vec3],  # [N] centres [m]
    quats: wp.array[wp.vec4],  # [N] rotations (w, x, y, z)
    scales: wp.array[wp.vec3],  # [N] standard deviations [m]
    opacities: wp.array[float],  # [N]
    camera: Pinhole,
    knobs: Knobs,
    sums: wp.array2d[float],  # [N, 16] as `project_backward` reads them
    at_depth: int,  # column of `sums` with the gradient of the depth, -1 = none
    # Out:
    means_out: wp.array[wp.vec3],  # [N] zero where no tile was reached, as all that follow
    quats_out: wp.array[wp.vec4],  # [N]
    scales_out: wp.array[wp.vec3],  # [N]
    opacities_out: wp.array[float],  # [N]
    means2d_out: wp.array[wp.vec2],  # [N] gradient of the projected centres [1 / pixels]
    poses_out: wp.array2d[float],  # [N, POSE_COLUMNS] each Gaussian's share of the pose's gradient, or empty
):
    """Differentiate `project_groups`."""
    project_group_backward(
        base + wp.tid(),
        means,
        quats,
        scales,
        opacities,
        camera,
        knobs,
        sums,
        at_depth,
        means_out,
        quats_out,
        scales_out,
        opacities_out,
        means2d_out,
        poses_out,
    )


@wp.func_native(snippet(TOGETHER, **CONSTANTS))
def differentiate_group(
    block: int,
    means: wp.array[wp.vec3],
    quats: wp.array[wp.vec4],
    scales: wp.array[wp.vec3],
    opacities: wp.array[float],
    sh: wp.array2d[wp.vec3],
    degree: int,
    camera: Pinhole,
    knobs: Knobs,
    ranges: wp.array2d[int],
    used: wp.array[wp.uint8],
    rows: wp.array[Lanes],
    at_color: int,
    at_depth: int,
    means_out: wp.array[wp.vec3],
    quats_out: wp.array[wp.vec4],
    scales_out: wp.array[wp.vec3],
    opacities_out: wp.array[float],
    sh_out: wp.array2d[wp.vec3],
    means2d_out: wp.array[wp.vec2],
    poses_out: wp.array2d[float],
    offsets_out: wp.array2d[float],
): ...


@wp.kernel
def differentiate_groups(
    # In:
    base: int,  # first GROUP of this launch
    means: wp.array[wp.vec3],  # [N] centres [m]
    quats: wp.array[wp.vec4],  # [N] rotations (w, x, y, z)
    scales: wp.array[wp.vec3],  # [N] standard deviations [m]
    opacities: wp.array[float],  # [N]
    sh: wp.array2d[wp.vec3],  # [N, K] coefficients
    degree: int,
    camera: Pinhole,
    knobs: Knobs,
    ranges: wp.array2d[int],  # [N + 1, 2] first row of sums of each Gaussian and their number
    used: wp.array[wp.uint8],  # [R] whether there is a row; where not, it would be zero
    rows: wp.array[Lanes],  # [R] rows of sums
    at_color: int,  # column of the rows with the gradient of the first channel
    at_depth: int,  # and with that of the depth, -1 = none
    # Out:
    means_out: wp.array[wp.vec3],  # [N] zero where no tile was reached, as all that follow
    quats_out: wp.array[wp.vec4],  # [N]
    scales_out: wp.array[wp.vec3],  # [N]
    opacities_out: wp.array[float],  # [N]
    sh_out: wp.array2d[wp.vec3],  # [N, K]
    means2d_out: wp.array[wp.vec2],  # [N] gradient of the projected centres [1 / pixels], or empty
    poses_out: wp.array2d[float],  # [N, POSE_COLUMNS] each Gaussian's share of the pose's gradient, or empty
    offsets_out: wp.array2d[float],  # [N, 3] gradient of centre minus camera centre by the colour, or empty
):
    """`sum_used_rows`, `project_groups_backward` and `shade_groups_backward` in one."""
    differentiate_group(
        base + wp.tid(),
        means,
        quats,
        scales,
        opacities,
        sh,
        degree,
        camera,
        knobs,
        ranges,
        used,
        rows,
        at_color,
        at_depth,
        means_out,
        quats_out,
        scales_out,
        opacities_out,
        sh_out,
        means2d_out,
        poses_out,
        offsets_out,
    )
