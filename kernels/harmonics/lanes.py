"""View-dependent colour and its adjoint, lane schedule (CPU): 16 Gaussians at a time, in C++ (`native.py`).

The maths and its order are those of `forward.py` and `backward.py`; the tests compare them. The pieces stand on their
own, because the projection reads the same Gaussians: it colours the splats on its way (`projection/lanes.py`).
"""

import warp as wp

from sgwarp.kernels.gaussian import EXACT_OPTIONS, Pinhole
from sgwarp.kernels.native import by_groups, columns, snippet
from sgwarp.kernels.projection.backward import SEEN

wp.set_module_options(EXACT_OPTIONS)

# Coefficients of those of 16 Gaussians that are `wanted`, one number of all of them in a vector; zero elsewhere. Those
# of a lower degree than 3, and the last ones of a scene, go through a copy.
COEFFICIENTS = """
    constexpr int MOST = 48;  // numbers of a Gaussian: three channels of degree 3
    const int per_row = 3 * sh.shape[1], in_use = 3 * (degree + 1) * (degree + 1);
    const bool direct = per_row == MOST && in_use == MOST && count == 16;
    Row blocks[3][16] __attribute__((aligned(64)));
    float copied[16 * MOST] __attribute__((aligned(64)));
    const auto coefficient = [&](int k, int channel) -> Row {
        return blocks[(3 * k + channel) / 16][(3 * k + channel) % 16];
    };
    const auto read_coefficients = [&](unsigned wanted) {
        const float nothing[MOST] = {};
        const float* const from = reinterpret_cast<const float*>(sh.data) + (long long)first * per_row;
        const float* rows[16];
        for (int i = 0; i < 16; ++i) rows[i] = wanted >> i & 1 ? from + i * MOST : nothing;
        if (!direct)
            for (int i = 0; i < 16; ++i) {
                rows[i] = copied + i * MOST;
                for (int e = 0; e < in_use; ++e) copied[i * MOST + e] = wanted >> i & 1 ? from[i * per_row + e] : 0.0f;
            }
#pragma clang loop unroll(full)
        for (int block = 0; block < 3; ++block)
            if (16 * block < in_use) {
#pragma clang loop unroll(full)
                for (int i = 0; i < 16; ++i) blocks[block][i] = *reinterpret_cast<const Row*>(rows[i] + 16 * block);
                transpose(blocks[block]);
            }
    };
"""

# Unit vector (x, y, z) from the camera's centre to each Gaussian's, zero where none is wanted.
DIRECTION = """
    const Row distance = __builtin_elementwise_sqrt(away[0] * away[0] + away[1] * away[1] + away[2] * away[2]);
    const Row x = away[0] / distance, y = away[1] / distance, z = away[2] / distance;
"""

# The sum of `harmonics_color`, with no channel clamped yet.
COLOR = """
    Row color[3];
    for (int j = 0; j < 3; ++j) {
        const auto of = [&](int k) -> Row { return coefficient(k, j); };
        Row sum = 0.28209479177387814f * of(0);
        if (degree > 0) sum += 0.4886025119029199f * (z * of(2) - y * of(1) - x * of(3));
        if (degree > 1) {
            sum += 1.0925484305920792f * (x * y * of(4) - y * z * of(5) - x * z * of(7));
            sum += 0.31539156525252005f * (3.0f * z * z - 1.0f) * of(6);
            sum += 0.5462742152960396f * (x * x - y * y) * of(8);
        }
        if (degree > 2) {
            const Row five = 5.0f * z * z - 1.0f;
            sum += -0.5900435899266435f
                 * (y * (3.0f * x * x - y * y) * of(9) + x * (x * x - 3.0f * y * y) * of(15));
            sum += 2.890611442640554f * x * y * z * of(10);
            sum += -0.4570457994644658f * five * (y * of(11) + x * of(13));
            sum += 0.3731763325901154f * z * (5.0f * z * z - 3.0f) * of(12);
            sum += 1.445305721320277f * z * (x * x - y * y) * of(14);
        }
        color[j] = sum + 0.5f;
    }
"""

# From the gradient `v` of the colour to that of the direction, across it, over the distance: `v_away`.
TO_DIRECTION = """
    const auto under = [&](int k) -> Row {
        return coefficient(k, 0) * v[0] + coefficient(k, 1) * v[1] + coefficient(k, 2) * v[2];
    };
    if (degree > 0) {
        v_away[0] += 0.4886025119029199f * -under(3);
        v_away[1] += 0.4886025119029199f * -under(1);
        v_away[2] += 0.4886025119029199f * under(2);
    }
    if (degree > 1) {
        const Row s4 = 1.0925484305920792f * under(4), s5 = -1.0925484305920792f * under(5);
        const Row s6 = 1.8923493915151204f * under(6), s7 = -1.0925484305920792f * under(7);
        const Row s8 = 1.0925484305920792f * under(8);
        v_away[0] += y * s4 + z * s7 + x * s8;
        v_away[1] += x * s4 + z * s5 - y * s8;
        v_away[2] += y * s5 + x * s7 + z * s6;
    }
    if (degree > 2) {
        const Row five = 5.0f * z * z - 1.0f, lean = x * x - y * y;
        const Row s9 = -1.7701307697799305f * under(9), s10 = 2.890611442640554f * under(10);
        const Row s11 = -0.4570457994644658f * under(11), s12 = 1.1195289977703462f * under(12);
        const Row s13 = -0.4570457994644658f * under(13), s14 = 1.445305721320277f * under(14);
        const Row s15 = -1.7701307697799305f * under(15);
        v_away[0] += 2.0f * x * y * s9 + y * z * s10 + five * s13 + 2.0f * x * z * s14 + lean * s15;
        v_away[1] += lean * s9 + x * z * s10 + five * s11 - 2.0f * y * z * s14 - 2.0f * x * y * s15;
        v_away[2] += x * y * s10 + 10.0f * z * (y * s11 + x * s13) + five * s12 + lean * s14;
    }
    const Row along = x * v_away[0] + y * v_away[1] + z * v_away[2];
    const Row steps[3] = {x, y, z};
    for (int j = 0; j < 3; ++j) v_away[j] = degree > 0 && seen_bits ? (v_away[j] - steps[j] * along) / distance : zero;
"""

# The gradient of the coefficients: the basis times `v`, which is zero where a Gaussian was not seen. Memory that is
# written in whole lines of the cache goes past the cache: whoever reads the gradient comes when it would have left.
SPREAD = """
    const auto spread = [&](int k, Row basis) {
        for (int j = 0; j < 3; ++j) blocks[(3 * k + j) / 16][(3 * k + j) % 16] = seen ? basis * v[j] : zero;
    };
    spread(0, zero + 0.28209479177387814f);
    if (degree > 0) {
        spread(1, -0.4886025119029199f * y);
        spread(2, 0.4886025119029199f * z);
        spread(3, -0.4886025119029199f * x);
    }
    if (degree > 1) {
        spread(4, 1.0925484305920792f * x * y);
        spread(5, -1.0925484305920792f * y * z);
        spread(6, 0.31539156525252005f * (3.0f * z * z - 1.0f));
        spread(7, -1.0925484305920792f * x * z);
        spread(8, 0.5462742152960396f * (x * x - y * y));
    }
    if (degree > 2) {
        const Row five = 5.0f * z * z - 1.0f;
        spread(9, -0.5900435899266435f * y * (3.0f * x * x - y * y));
        spread(10, 2.890611442640554f * x * y * z);
        spread(11, -0.4570457994644658f * y * five);
        spread(12, 0.3731763325901154f * z * (5.0f * z * z - 3.0f));
        spread(13, -0.4570457994644658f * x * five);
        spread(14, 1.445305721320277f * z * (x * x - y * y));
        spread(15, -0.5900435899266435f * x * (x * x - 3.0f * y * y));
    }
    float* const target = direct ? to : copied;
#pragma clang loop unroll(full)
    for (int block = 0; block < 3; ++block)
        if (16 * block < in_use) {
            transpose(blocks[block]);
            float* const rows = target + 16 * block;
            if (whole_lines)
#pragma clang loop unroll(full)
                for (int i = 0; i < 16; ++i)
                    __builtin_nontemporal_store(blocks[block][i], reinterpret_cast<Line*>(rows + i * MOST));
            else
#pragma clang loop unroll(full)
                for (int i = 0; i < 16; ++i) *reinterpret_cast<Row*>(rows + i * MOST) = blocks[block][i];
        }
    for (int i = 0; !direct && i < count; ++i)
        for (int e = 0; e < per_row; ++e) to[i * per_row + e] = e < in_use ? copied[i * MOST + e] : 0.0f;
"""

# Where the gradient of the coefficients goes, and zeros for 16 of which none was seen.
TARGET = """
    typedef float Line __attribute__((ext_vector_type(16), aligned(64)));
    float* const to = reinterpret_cast<float*>(sh_out.data) + (long long)first * per_row;
    const bool whole_lines = direct && !(reinterpret_cast<unsigned long long>(to) & 63);
    const auto no_coefficients = [&] {
        if (whole_lines)
            for (int e = 0; e < 16 * MOST; e += 16) __builtin_nontemporal_store(zero, reinterpret_cast<Line*>(to + e));
        else for (int e = 0; e < count * per_row; ++e) to[e] = 0.0f;
    };
"""

BACKWARD = (
    """
    const int first = group * 16, count = means.shape[0] - first < 16 ? means.shape[0] - first : 16;
    float padded[64] = {};
    const auto read = [&](const auto& array, Row* to) {
        const float* const from = reinterpret_cast<const float*>(array.data + first);
        for (int e = 0; count < 16 && e < 3 * count; ++e) padded[e] = from[e];
        split_3(count < 16 ? padded : from, to);
    };
    const auto write = [&](const Row* values, float* out) {
        join_3(values, count < 16 ? padded : out);
        for (int e = 0; count < 16 && e < 3 * count; ++e) out[e] = padded[e];
    };
    Row moments[16];
    const Row* const rows = reinterpret_cast<const Row*>(sums.data) + first;
    for (int i = 0; i < 16; ++i) moments[i] = i < count ? rows[i] : zero;
    transpose(moments);
    const Ints seen = moments[SEEN] != zero;
    const unsigned seen_bits = bits(seen);
"""
    + COEFFICIENTS
    + TARGET
    + """
    Row no_offsets[3] = {zero, zero, zero};
    if (!seen_bits) {
        no_coefficients();
        if (offsets_out.shape[0] > 0) write(no_offsets, offsets_out.data + 3 * first);
        return;
    }
    Row away[3], v[3], v_away[3] = {zero, zero, zero};
    read(means, away);
    for (int j = 0; j < 3; ++j)
        away[j] = seen ? (away[j] - camera.center[j]) - camera.center_rest[j] : one;
    read_coefficients(seen_bits);
    DIRECTION
    COLOR
    for (int j = 0; j < 3; ++j) v[j] = (seen & (color[j] > zero)) ? moments[at_color + j] : zero;
    TO_DIRECTION
    for (int j = 0; j < 3; ++j) v_away[j] = seen ? v_away[j] : zero;
    SPREAD
    Row v_mean[3];
    read(means_out, v_mean);
    for (int j = 0; j < 3; ++j) v_mean[j] += v_away[j];
    write(v_mean, reinterpret_cast<float*>(means_out.data + first));
    if (offsets_out.shape[0] > 0) write(v_away, offsets_out.data + 3 * first);
""".replace("    DIRECTION\n", DIRECTION)
    .replace("    COLOR\n", COLOR)
    .replace("    TO_DIRECTION\n", TO_DIRECTION)
    .replace("    SPREAD\n", SPREAD)
)

CONSTANTS = {"SEEN": int(SEEN)}


@wp.func_native(snippet(columns(3) + by_groups(BACKWARD, count="means.shape[0]"), **CONSTANTS))
def shade_group_backward(
    block: int,
    means: wp.array[wp.vec3],
    sh: wp.array2d[wp.vec3],
    degree: int,
    camera: Pinhole,
    sums: wp.array2d[float],
    at_color: int,
    sh_out: wp.array2d[wp.vec3],
    means_out: wp.array[wp.vec3],
    offsets_out: wp.array2d[float],
): ...


@wp.kernel
def shade_groups_backward(
    # In:
    base: int,  # first GROUP of this launch
    means: wp.array[wp.vec3],  # [N] centres [m]
    sh: wp.array2d[wp.vec3],  # [N, K] coefficients
    degree: int,
    camera: Pinhole,
    sums: wp.array2d[float],  # [N, 16] what compositing left for every Gaussian
    at_color: int,  # column of `sums` with the gradient of the first channel
    # Out:
    sh_out: wp.array2d[wp.vec3],  # [N, K] zero where no tile was reached and above the degree
    means_out: wp.array[wp.vec3],  # [N] added to
    offsets_out: wp.array2d[float],  # [N, 3] gradient of centre minus camera centre, zero where unseen; or empty
):
    """Differentiate the colour of 16 Gaussians; a channel that was clamped at zero has no gradient."""
    shade_group_backward(base + wp.tid(), means, sh, degree, camera, sums, at_color, sh_out, means_out, offsets_out)
