"""Real spherical harmonics up to degree 3, in the sign convention of 3D Gaussian Splatting files."""

import warp as wp

from sgwarp.kernels.gaussian import EXACT_OPTIONS, Pinhole

wp.set_module_options(EXACT_OPTIONS)


AHEAD = wp.constant(8)  # ranks between the one at work and the one that is fetched
BRIGHTEST = wp.constant(1.0e30)


@wp.func
def harmonics_color(sh: wp.array2d[wp.vec3], i: int, degree: int, direction: wp.vec3) -> wp.vec3:
    """Colour of Gaussian i seen along a unit direction: max(0, sum_k Y_k(direction) sh_k + 1/2)."""
    x = direction[0]
    y = direction[1]
    z = direction[2]
    color = 0.28209479177387814 * sh[i, 0]
    if degree > 0:
        color += 0.4886025119029199 * (z * sh[i, 2] - y * sh[i, 1] - x * sh[i, 3])
    if degree > 1:
        color += 1.0925484305920792 * (x * y * sh[i, 4] - y * z * sh[i, 5] - x * z * sh[i, 7])
        color += 0.31539156525252005 * (3.0 * z * z - 1.0) * sh[i, 6]
        color += 0.5462742152960396 * (x * x - y * y) * sh[i, 8]
    if degree > 2:
        five = 5.0 * z * z - 1.0
        color += -0.5900435899266435 * (y * (3.0 * x * x - y * y) * sh[i, 9] + x * (x * x - 3.0 * y * y) * sh[i, 15])
        color += 2.890611442640554 * x * y * z * sh[i, 10]
        color += -0.4570457994644658 * five * (y * sh[i, 11] + x * sh[i, 13])
        color += 0.3731763325901154 * z * (5.0 * z * z - 3.0) * sh[i, 12]
        color += 1.445305721320277 * z * (x * x - y * y) * sh[i, 14]
    color += wp.vec3(0.5, 0.5, 0.5)
    # Coefficients near the end of float32 overflow: an infinite colour would be NaN where its weight is zero.
    return wp.min(wp.max(color, wp.vec3(0.0, 0.0, 0.0)), wp.vec3(BRIGHTEST, BRIGHTEST, BRIGHTEST))


@wp.func_native("""
#if !defined(__CUDA_ARCH__)
    __builtin_prefetch(means.data + i);
    const auto* const first = sh.data + i * sh.shape[1];
    for (int k = 0; k < coefficients; k += 5) __builtin_prefetch(first + k);  // 5 colours to a line of the cache
    __builtin_prefetch(first + coefficients - 1);
#endif
""")
def prefetch_harmonics(
    means: wp.array[wp.vec3], sh: wp.array2d[wp.vec3], i: int, coefficients: int
): ...  # a hint for the CPU's cache


@wp.kernel
def evaluate_harmonics(
    # In:
    base: int,  # first rank of this launch
    order: wp.array[int],  # [V] visible Gaussians
    means: wp.array[wp.vec3],  # [N] centres [m]
    sh: wp.array2d[wp.vec3],  # [N, K] coefficients
    degree: int,
    camera: Pinhole,
    # Out:
    colors_out: wp.array[wp.vec3],  # [V]
):
    """View-dependent colour of the visible Gaussians, in depth order; others are not read."""
    k = base + wp.tid()
    i = order[k]
    ahead = order[wp.min(k + AHEAD, order.shape[0] - 1)]
    prefetch_harmonics(means, sh, ahead, (degree + 1) * (degree + 1))
    away = (means[i] - camera.center) - camera.center_rest
    colors_out[k] = harmonics_color(sh, i, degree, wp.normalize(away))
