"""Convolution of sparse voxels on the CPU: gather, multiply and add without a copy in between.

A block of targets is owned by one thread. For each offset its pairs are multiplied eight at a time: 8 rows times 32
channels of the result are 16 vectors, which stay in registers while the channels of the sources pass by. A target
stands at most once within an offset and offsets come in order, so the result does not depend on threads.
"""

import warp as wp

from sgwarp.kernels.native import snippet

# No fast maths: NaN has to reach the neighbours of its voxel.
OPTIONS = {
    "enable_backward": False,
    "fast_math": False,
    "cpu_compiler_flags": "-march=native -ffp-contract=fast -mprefer-vector-width=512 -mllvm=-inline-threshold=9000",
}
wp.set_module_options(OPTIONS)

COLUMNS = 32  # channels of the result that are accumulated at a time
GRADIENT_GROUP = 64  # channels of the sources that one thread owns of the weight's gradient

FORWARD = """
    const int inputs = features.shape[1], outputs = out.shape[1], tiles = outputs / 32;
    const long long first = block * rows, end = first + rows < out.shape[0] ? first + rows : out.shape[0];
    // Pairs whose targets lie in the block.
    const auto not_below = [&](int low, int high, long long target) {
        while (low < high) {
            const int middle = (low + high) / 2;
            if (targets.data[middle] < target) low = middle + 1;
            else high = middle;
        }
        return low;
    };
    const auto multiply = [&](int offset, int start, int stop, const long long* from, const long long* to, bool add) {
        for (int tile = 0; tile < tiles; ++tile) {
            const float* const w = weight.data + (size_t)(offset * tiles + tile) * inputs * 32;
            for (int p = start; p < stop; p += 8) {
                const float* x[8];
                for (int r = 0; r < 8; ++r) {
                    const int q = p + r < stop ? p + r : stop - 1;
                    x[r] = features.data + (from ? from[q] : q) * (size_t)inputs;
                    const int ahead = q + 8 < stop ? q + 8 : stop - 1;
                    const float* const next = features.data + (from ? from[ahead] : ahead) * (size_t)inputs;
                    if (tile == 0) for (int c = 0; c < inputs; c += 16) __builtin_prefetch(next + c);
                }
                Row a[8], b[8];
#pragma clang loop unroll(full)
                for (int r = 0; r < 8; ++r) a[r] = zero, b[r] = zero;
                for (int c = 0; c < inputs; ++c) {
                    const Row w0 = *reinterpret_cast<const Row*>(w + 32 * c);
                    const Row w1 = *reinterpret_cast<const Row*>(w + 32 * c + 16);
#pragma clang loop unroll(full)
                    for (int r = 0; r < 8; ++r) a[r] += x[r][c] * w0, b[r] += x[r][c] * w1;
                }
#pragma clang loop unroll(full)
                for (int r = 0; r < 8; ++r) {
                    if (p + r >= stop) break;
                    const size_t row = to ? to[p + r] : p + r;
                    Row* const y = reinterpret_cast<Row*>(out.data + row * outputs + 32 * tile);
                    if (add) y[0] += a[r], y[1] += b[r];
                    else y[0] = a[r], y[1] = b[r];
                }
            }
        }
    };
    if (identity >= 0) multiply(identity, first, end, nullptr, nullptr, false);
    else for (size_t i = first * outputs; i < end * (size_t)outputs; ++i) out.data[i] = 0.0f;
    for (int offset = 0; offset + 1 < starts.shape[0]; ++offset) {
        const int start = not_below(starts.data[offset], starts.data[offset + 1], first);
        const int stop = not_below(start, starts.data[offset + 1], end);
        if (start < stop) multiply(offset, start, stop, sources.data, targets.data, true);
    }
"""

GRADIENT = """
    const int inputs = features.shape[1], outputs = gradient.shape[1], groups = (inputs + GROUP - 1) / GROUP;
    const int offset = task / groups, low = task % groups * GROUP, high = low + GROUP < inputs ? low + GROUP : inputs;
    const bool self = offset == identity;
    const int start = self ? 0 : starts.data[offset], stop = self ? gradient.shape[0] : starts.data[offset + 1];
    float* const out = out_.data + (size_t)offset * inputs * outputs;
    for (size_t i = (size_t)low * outputs; i < (size_t)high * outputs; ++i) out[i] = 0.0f;
    // A chunk's rows are copied first: read where they lie, few of them would fit the cache at once.
    float x[64 * GROUP] __attribute__((aligned(64))), v[64 * 32] __attribute__((aligned(64)));
    for (int chunk = start; chunk < stop; chunk += 64) {
        const int count = chunk + 64 < stop ? 64 : stop - chunk;
        for (int p = 0; p < count; ++p) {
            const size_t row = self ? chunk + p : sources.data[chunk + p];
            const float* const from = features.data + row * inputs + low;
            for (int c = 0; c < GROUP; ++c) x[GROUP * p + c] = c < high - low ? from[c] : 0.0f;
            const int q = chunk + p + 64 < stop ? chunk + p + 64 : stop - 1;
            const float* const next = features.data + (self ? q : sources.data[q]) * (size_t)inputs + low;
            for (int c = 0; c < GROUP; c += 16) __builtin_prefetch(next + c);
        }
        for (int tile = 0; tile < outputs; tile += 32) {
            for (int p = 0; p < count; ++p) {
                const size_t row = self ? chunk + p : targets.data[chunk + p];
                const Row* const from = reinterpret_cast<const Row*>(gradient.data + row * outputs + tile);
                Row* const to = reinterpret_cast<Row*>(v + 32 * p);
                to[0] = from[0], to[1] = from[1];
                const int q = chunk + p + 64 < stop ? chunk + p + 64 : stop - 1;
                const float* const next = gradient.data + (self ? q : targets.data[q]) * (size_t)outputs + tile;
                __builtin_prefetch(next), __builtin_prefetch(next + 16);
            }
            for (int first = 0; first < high - low; first += 8) {
                Row a[8], b[8];
                const int valid = high - low - first < 8 ? high - low - first : 8;
                Row* const kept = reinterpret_cast<Row*>(out + (size_t)(low + first) * outputs + tile);
                const int stride = outputs / 16;
#pragma clang loop unroll(full)
                for (int r = 0; r < 8; ++r) a[r] = zero, b[r] = zero;
                for (int p = 0; p < count; ++p) {
                    const Row* const vp = reinterpret_cast<const Row*>(v + 32 * p);
                    const Row v0 = vp[0], v1 = vp[1];
#pragma clang loop unroll(full)
                    for (int r = 0; r < 8; ++r) {
                        const float value = x[GROUP * p + first + r];
                        a[r] += value * v0, b[r] += value * v1;
                    }
                }
#pragma clang loop unroll(full)
                for (int r = 0; r < 8; ++r)
                    if (r < valid) kept[r * stride] += a[r], kept[r * stride + 1] += b[r];
            }
        }
    }
"""


@wp.func_native(snippet(FORWARD))
def convolve_block(
    block: int,
    rows: int,  # of a block
    features: wp.array2d[float],
    weight: wp.array[float],
    sources: wp.array[wp.int64],
    targets: wp.array[wp.int64],
    starts: wp.array[int],
    identity: int,
    out: wp.array2d[float],
): ...


@wp.func_native(snippet(GRADIENT.replace("out_.data", "weight_gradient.data"), GROUP=GRADIENT_GROUP))
def sum_products(
    task: int,
    features: wp.array2d[float],
    gradient: wp.array2d[float],
    sources: wp.array[wp.int64],
    targets: wp.array[wp.int64],
    starts: wp.array[int],
    identity: int,
    weight_gradient: wp.array3d[float],
): ...


@wp.kernel
def convolve_voxels(
    # In:
    base: int,  # first block of this launch
    rows: int,  # targets of a block
    features: wp.array2d[float],  # [N, C_in]
    weight: wp.array[float],  # [offsets, C_out / 32, C_in, 32], flat
    sources: wp.array[wp.int64],  # [pairs] row of features, offset by offset
    targets: wp.array[wp.int64],  # [pairs] row of the result, increasing within an offset
    starts: wp.array[int],  # [offsets + 1] first pair of each
    identity: int,  # offset that connects every voxel with itself and has no pairs, or -1
    # Out:
    features_out: wp.array2d[float],  # [M, C_out], C_out a multiple of 32
):
    """y[target] = sum over the pairs of offset k of x[source] W[k]. One thread per block of targets."""
    convolve_block(base + wp.tid(), rows, features, weight, sources, targets, starts, identity, features_out)


@wp.kernel
def sum_weight_gradient(
    # In:
    base: int,
    features: wp.array2d[float],  # [N, C_in]
    gradient: wp.array2d[float],  # [M, C_out] of the result, C_out a multiple of 32
    sources: wp.array[wp.int64],  # [pairs]
    targets: wp.array[wp.int64],  # [pairs]
    starts: wp.array[int],  # [offsets + 1]
    identity: int,
    # Out:
    weight_out: wp.array3d[float],  # [offsets, C_in, C_out]
):
    """x[sources]^T v_y[targets] of each offset. One thread per offset and `GRADIENT_GROUP` channels of the sources."""
    sum_products(base + wp.tid(), features, gradient, sources, targets, starts, identity, weight_out)
