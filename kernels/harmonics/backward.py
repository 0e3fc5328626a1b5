"""Backward pass of view-dependent colour: to the coefficients and, through the viewing direction, to the centres."""

import warp as wp

from sgwarp.kernels.gaussian import EXACT_OPTIONS, Pinhole
from sgwarp.kernels.harmonics.forward import harmonics_color
from sgwarp.kernels.projection.backward import SEEN

wp.set_module_options(EXACT_OPTIONS)


@wp.func
def spread_coefficients(degree: int, direction: wp.vec3, v: wp.vec3, i: int, sh_out: wp.array2d[wp.vec3]):
    """Gradient of the coefficients: the basis at `direction` times that of the colour."""
    x = direction[0]
    y = direction[1]
    z = direction[2]
    sh_out[i, 0] = 0.28209479177387814 * v
    if degree > 0:
        sh_out[i, 1] = -0.4886025119029199 * y * v
        sh_out[i, 2] = 0.4886025119029199 * z * v
        sh_out[i, 3] = -0.4886025119029199 * x * v
    if degree > 1:
        sh_out[i, 4] = 1.0925484305920792 * x * y * v
        sh_out[i, 5] = -1.0925484305920792 * y * z * v
        sh_out[i, 6] = 0.31539156525252005 * (3.0 * z * z - 1.0) * v
        sh_out[i, 7] = -1.0925484305920792 * x * z * v
        sh_out[i, 8] = 0.5462742152960396 * (x * x - y * y) * v
    if degree > 2:
        five = 5.0 * z * z - 1.0
        sh_out[i, 9] = -0.5900435899266435 * y * (3.0 * x * x - y * y) * v
        sh_out[i, 10] = 2.890611442640554 * x * y * z * v
        sh_out[i, 11] = -0.4570457994644658 * y * five * v
        sh_out[i, 12] = 0.3731763325901154 * z * (5.0 * z * z - 3.0) * v
        sh_out[i, 13] = -0.4570457994644658 * x * five * v
        sh_out[i, 14] = 1.445305721320277 * z * (x * x - y * y) * v
        sh_out[i, 15] = -0.5900435899266435 * x * (x * x - 3.0 * y * y) * v


@wp.func
def direction_gradient(sh: wp.array2d[wp.vec3], i: int, degree: int, direction: wp.vec3, v: wp.vec3) -> wp.vec3:
    """Gradient of the direction, up to a part along it, which normalisation takes away."""
    x = direction[0]
    y = direction[1]
    z = direction[2]
    g = wp.vec3(0.0, 0.0, 0.0)
    if degree > 0:
        g += 0.4886025119029199 * wp.vec3(-wp.dot(sh[i, 3], v), -wp.dot(sh[i, 1], v), wp.dot(sh[i, 2], v))
    if degree > 1:
        s4 = 1.0925484305920792 * wp.dot(sh[i, 4], v)
        s5 = -1.0925484305920792 * wp.dot(sh[i, 5], v)
        s6 = 1.8923493915151204 * wp.dot(sh[i, 6], v)
        s7 = -1.0925484305920792 * wp.dot(sh[i, 7], v)
        s8 = 1.0925484305920792 * wp.dot(sh[i, 8], v)
        g += wp.vec3(y * s4 + z * s7 + x * s8, x * s4 + z * s5 - y * s8, y * s5 + x * s7 + z * s6)
    if degree > 2:
        five = 5.0 * z * z - 1.0
        s9 = -1.7701307697799305 * wp.dot(sh[i, 9], v)
        s10 = 2.890611442640554 * wp.dot(sh[i, 10], v)
        s11 = -0.4570457994644658 * wp.dot(sh[i, 11], v)
        s12 = 1.1195289977703462 * wp.dot(sh[i, 12], v)
        s13 = -0.4570457994644658 * wp.dot(sh[i, 13], v)
        s14 = 1.445305721320277 * wp.dot(sh[i, 14], v)
        s15 = -1.7701307697799305 * wp.dot(sh[i, 15], v)
        lean = x * x - y * y
        g += wp.vec3(
            2.0 * x * y * s9 + y * z * s10 + five * s13 + 2.0 * x * z * s14 + lean * s15,
            lean * s9 + x * z * s10 + five * s11 - 2.0 * y * z * s14 - 2.0 * x * y * s15,
            x * y * s10 + 10.0 * z * (y * s11 + x * s13) + five * s12 + lean * s14,
        )
    return g


@wp.kernel
def harmonics_backward(
    # In:
    base: int,  # first Gaussian of this launch
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
    """Differentiate `evaluate_harmonics`; a channel that was clamped at zero has no gradient."""
    i = base + wp.tid()
    for k in range((degree + 1) * (degree + 1), sh.shape[1]):
        sh_out[i, k] = wp.vec3(0.0, 0.0, 0.0)
    if sums[i, SEEN] == 0.0:
        for k in range((degree + 1) * (degree + 1)):
            sh_out[i, k] = wp.vec3(0.0, 0.0, 0.0)
        if offsets_out.shape[0] > 0:
            for j in range(3):
                offsets_out[i, j] = 0.0
        return
    away = (means[i] - camera.center) - camera.center_rest
    distance = wp.length(away)
    direction = away / distance
    color = harmonics_color(sh, i, degree, direction)
    v = wp.vec3(0.0, 0.0, 0.0)
    for j in range(3):
        v[j] = wp.where(color[j] > 0.0, sums[i, at_color + j], 0.0)
    spread_coefficients(degree, direction, v, i, sh_out)
    g = wp.vec3(0.0, 0.0, 0.0)
    if degree > 0:
        g = direction_gradient(sh, i, degree, direction, v)
        g = (g - direction * wp.dot(direction, g)) / distance
        means_out[i] = means_out[i] + g
    if offsets_out.shape[0] > 0:
        for j in range(3):
            offsets_out[i, j] = g[j]
