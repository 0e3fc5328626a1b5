"""Fitting a scene: Adam on the parameters of those Gaussians that a view has seen, and noise on the rest of the way.

One thread per Gaussian, the same kernels on CPU and CUDA. A Gaussian that no pixel saw has no gradient; its parameters
and moments stay as they are, so that a step costs what the view shows and not what the scene holds. Each counts its
own steps, so that bias correction is right for Gaussians that are young or seldom seen.
"""

import warp as wp

from sgwarp.kernels.gaussian import EXACT_OPTIONS, rotation_from_quaternion

wp.set_module_options(EXACT_OPTIONS)

BETA_1 = wp.constant(0.9)
BETA_2 = wp.constant(0.999)
EPSILON = wp.constant(1.0e-15)
# What a stored parameter is of the value that is rendered.
PLAIN = wp.constant(0)
LOGARITHM = wp.constant(1)
LOGIT = wp.constant(2)
# Noise: only the faint move, and sharply so (Kheradmand et al. 2024, eq. 9).
FAINTNESS = wp.constant(0.995)  # 1 - opacity at which half the noise is left
STEEPNESS = wp.constant(100.0)
OPAQUE = wp.constant(0.17)  # here exp(-STEEPNESS (opacity - 0.005)) is below float32's resolution of 1


@wp.kernel
def count_steps(
    # In:
    base: int,  # first Gaussian of this launch
    opacities: wp.array[float],  # [N] gradient
    sh: wp.array2d[wp.vec3],  # [N, K] gradient
    every: int,  # 1 = all take a step, seen or not
    # Out:
    steps_out: wp.array[int],  # [N] added to
    taken_out: wp.array[wp.uint8],  # [N] 1 = takes this step
):
    """Who takes this step: a Gaussian that changes a pixel has a gradient of its opacity or of its colour."""
    i = base + wp.tid()
    v = sh[i, 0]
    seen = opacities[i] != 0.0 or v[0] != 0.0 or v[1] != 0.0 or v[2] != 0.0
    if seen or every != 0:
        steps_out[i] = steps_out[i] + 1
        taken_out[i] = wp.uint8(1)
    else:
        taken_out[i] = wp.uint8(0)


@wp.kernel
def update_rows(
    # In:
    base: int,  # first Gaussian of this launch
    taken: wp.array[wp.uint8],  # [N] 1 = takes this step
    steps: wp.array[int],  # [N] including this one
    gradient: wp.array2d[float],  # [N, P] of the values
    form: int,  # PLAIN, LOGARITHM or LOGIT
    rate: float,  # of the first `leading` columns
    leading: int,
    rate_of_rest: float,
    pull: float,  # added to the gradient: a regulariser that is the sum of the values
    # Out:
    parameters_out: wp.array2d[float],  # [N, P] changed
    first_out: wp.array2d[float],  # [N, P] mean of the gradient, changed
    second_out: wp.array2d[float],  # [N, P] mean of its square, changed
    values_out: wp.array2d[float],  # [N, P] what is rendered; the same memory as the parameters if PLAIN
):
    """One step of Adam (Kingma and Ba 2015) on the parameters behind the values."""
    i = base + wp.tid()
    if taken[i] == wp.uint8(0):
        return
    count = float(steps[i])
    by_first = 1.0 / (1.0 - wp.pow(BETA_1, count))
    by_second = 1.0 / (1.0 - wp.pow(BETA_2, count))
    for j in range(gradient.shape[1]):
        g = gradient[i, j] + pull
        if form == LOGARITHM:
            g *= values_out[i, j]
        elif form == LOGIT:
            g *= values_out[i, j] * (1.0 - values_out[i, j])
        first = first_out[i, j] + (1.0 - BETA_1) * (g - first_out[i, j])
        second = second_out[i, j] + (1.0 - BETA_2) * (g * g - second_out[i, j])
        first_out[i, j] = first
        second_out[i, j] = second
        step = wp.where(j < leading, rate, rate_of_rest)
        parameter = parameters_out[i, j] - step * first * by_first / (wp.sqrt(second * by_second) + EPSILON)
        parameters_out[i, j] = parameter
        if form == LOGARITHM:
            values_out[i, j] = wp.exp(parameter)
        elif form == LOGIT:
            values_out[i, j] = 1.0 / (1.0 + wp.exp(-parameter))


@wp.kernel
def note_gradients(
    # In:
    base: int,  # first Gaussian of this launch
    taken: wp.array[wp.uint8],  # [N] 1 = was seen
    means2d: wp.array[wp.vec2],  # [N] gradient of the projected centres [1 / pixels]
    half_size: wp.vec2,  # of the image [pixels]
    # Out:
    sums_out: wp.array[float],  # [N] of the length of the gradient in half images, added to
    views_out: wp.array[int],  # [N] added to
):
    """What densification looks at: how much the loss wants a projected centre to move, on average over views."""
    i = base + wp.tid()
    if taken[i] == wp.uint8(0):
        return
    sums_out[i] = sums_out[i] + wp.length(wp.cw_mul(means2d[i], half_size))
    views_out[i] = views_out[i] + 1


@wp.kernel
def add_noise(
    # In:
    base: int,  # first Gaussian of this launch
    quats: wp.array[wp.vec4],  # [N]
    scales: wp.array[wp.vec3],  # [N] [m]
    opacities: wp.array[float],  # [N]
    seed: int,
    size: float,  # rate of the centres times the noise's own
    # Out:
    means_out: wp.array[wp.vec3],  # [N] moved [m]
):
    """Move faint Gaussians at random within their own extent, so that they find something to show."""
    i = base + wp.tid()
    if opacities[i] > OPAQUE:
        return
    state = wp.rand_init(seed, i)
    random = wp.vec3(wp.randn(state), wp.randn(state), wp.randn(state))
    faint = 1.0 / (1.0 + wp.exp(-STEEPNESS * (1.0 - opacities[i] - FAINTNESS)))
    scale = scales[i]
    # Sigma = R S S R^T.
    rotation = rotation_from_quaternion(quats[i])
    local = wp.cw_mul(wp.cw_mul(scale, scale), wp.transpose(rotation) * random)
    means_out[i] = means_out[i] + faint * size * (rotation * local)
