"""Fitting a scene: Adam on the parameters of those Gaussians that a view has seen, and noise on the rest of the way.

One thread per Gaussian, the same kernels on CPU and CUDA. A Gaussian that no pixel saw has no gradient, but Adam would
still move it: along what is left of its mean gradient, while the mean of the squares decays. Such steps are not taken,
so that a step costs what the view shows and not what the scene holds; when the Gaussian is seen again, it makes up for
all of them at once. The sum of the moves has a closed form, because their size falls geometrically.
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


UNSEEN = wp.constant(1)  # takes the step without a gradient
SEEN = wp.constant(3)
YOUNG = wp.constant(100)  # steps after which the bias of the mean gradient is gone


@wp.func
def waited_moves(age: int, waited: int) -> wp.vec2:
    """Adam's next `waited` moves without a gradient, added up; and with a constant one, what comes of it.

    The mean gradient of step s is (beta_1^s first + (1 - beta_1^s) constant) / (1 - beta_1^(age + s)), the mean square
    beta_2^s second / (1 - beta_2^(age + s)). First come the moves in units of first / sqrt(second), then the sum of the
    weights of the constant.
    """
    ratio = BETA_1 / wp.sqrt(BETA_2)
    count = float(waited)
    if age >= YOUNG:
        bias = 1.0 - wp.pow(BETA_2, float(age + wp.min(waited, 8)))
        falling = wp.sqrt(bias) * ratio * (1.0 - wp.pow(ratio, count)) / (1.0 - ratio)
        return wp.vec2(falling, count - BETA_1 * (1.0 - wp.pow(BETA_1, count)) / (1.0 - BETA_1))
    total = wp.vec2(0.0, 0.0)
    first = wp.pow(BETA_1, float(age))
    young = first
    second = wp.pow(BETA_2, float(age))
    size = float(1.0)
    looked_at = wp.min(waited, 200)
    for _ in range(looked_at):
        first *= BETA_1
        second *= BETA_2
        size *= ratio
        total[0] = total[0] + size * wp.sqrt(1.0 - second) / (1.0 - first)
        total[1] = total[1] + (1.0 - first / young) / (1.0 - first)
    total[1] = total[1] + float(waited - looked_at)
    return total


@wp.kernel
def count_steps(
    # In:
    base: int,  # first Gaussian of this launch
    opacities: wp.array[float],  # [N] gradient
    sh: wp.array2d[wp.vec3],  # [N, K] gradient
    every: int,  # 1 = all take a step, seen or not
    # Out:
    steps_out: wp.array[int],  # [N] since the Gaussian came, added to
    skipped_out: wp.array[int],  # [N] of these, how many it waits for; changed
    taken_out: wp.array[wp.uint8],  # [N] 0, UNSEEN or SEEN
    waited_out: wp.array[int],  # [N] steps to make up for, where this one is taken
    moves_out: wp.array[wp.vec2],  # [N] `waited_moves` of them
    factors_out: wp.array[wp.vec4],  # [N] that correct the bias of both means, and by which both fell while it waited
):
    """Count the steps: a Gaussian that changes a pixel has a gradient of its opacity or of its color."""
    i = base + wp.tid()
    v = sh[i, 0]
    seen = opacities[i] != 0.0 or v[0] != 0.0 or v[1] != 0.0 or v[2] != 0.0
    age = steps_out[i]
    steps_out[i] = age + 1
    if not seen and every == 0:
        skipped_out[i] = skipped_out[i] + 1
        taken_out[i] = wp.uint8(0)
        return
    waited = skipped_out[i]
    skipped_out[i] = 0
    taken_out[i] = wp.uint8(wp.where(seen, SEEN, UNSEEN))
    waited_out[i] = waited
    by_first = 1.0 / (1.0 - wp.pow(BETA_1, float(age + 1)))
    by_second = 1.0 / (1.0 - wp.pow(BETA_2, float(age + 1)))
    moves_out[i] = wp.vec2(0.0, 0.0)
    factors_out[i] = wp.vec4(by_first, by_second, 1.0, 1.0)
    if waited > 0:
        moves_out[i] = waited_moves(age - waited, waited)
        behind = float(waited)
        factors_out[i] = wp.vec4(by_first, by_second, wp.pow(BETA_1, behind), wp.pow(BETA_2, behind))


@wp.kernel
def update_rows(
    # In:
    base: int,  # first Gaussian of this launch
    taken: wp.array[wp.uint8],  # [N] 0 = does not take this step
    steps: wp.array[int],  # [N] since the Gaussian came, including this one
    waited: wp.array[int],  # [N] steps before this one that are still to be taken
    moves: wp.array[wp.vec2],  # [N] `waited_moves` of them
    factors: wp.array[wp.vec4],  # [N] of `count_steps`
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
    """One step of Adam (Kingma and Ba 2015) on the parameters behind the values, and those it has waited for."""
    i = base + wp.tid()
    if taken[i] == wp.uint8(0):
        return
    by_first = factors[i][0]
    by_second = factors[i][1]
    decay_1 = factors[i][2]
    decay_2 = factors[i][3]
    behind = float(waited[i])
    half_way = float(1.0)
    by_half_way = float(1.0)
    if pull != 0.0 and behind > 0.0:
        half_way = wp.sqrt(decay_2)
        by_half_way = 1.0 / (1.0 - wp.pow(BETA_2, float(steps[i]) - 1.0 - 0.5 * behind))
    for j in range(gradient.shape[1]):
        slope = float(1.0)
        if form == LOGARITHM:
            slope = values_out[i, j]
        elif form == LOGIT:
            slope = values_out[i, j] * (1.0 - values_out[i, j])
        step = wp.where(j < leading, rate, rate_of_rest)
        parameter = parameters_out[i, j]
        first = first_out[i, j]
        second = second_out[i, j]
        if behind > 0.0:
            parameter -= step * first * moves[i][0] / (wp.sqrt(second) + EPSILON)
            constant = pull * slope  # all the gradient there was
            if constant != 0.0:
                size = (second * half_way + constant * constant * (1.0 - half_way)) * by_half_way
                parameter -= step * moves[i][1] * constant / (wp.sqrt(size) + EPSILON)
            first = first * decay_1 + constant * (1.0 - decay_1)
            second = second * decay_2 + constant * constant * (1.0 - decay_2)
        g = (gradient[i, j] + pull) * slope
        first += (1.0 - BETA_1) * (g - first)
        second += (1.0 - BETA_2) * (g * g - second)
        first_out[i, j] = first
        second_out[i, j] = second
        parameter -= step * first * by_first / (wp.sqrt(second * by_second) + EPSILON)
        parameters_out[i, j] = parameter
        if form == LOGARITHM:
            values_out[i, j] = wp.exp(parameter)
        elif form == LOGIT:
            values_out[i, j] = 1.0 / (1.0 + wp.exp(-parameter))


@wp.kernel
def note_gradients(
    # In:
    base: int,  # first Gaussian of this launch
    taken: wp.array[wp.uint8],  # [N] of `count_steps`
    means2d: wp.array[wp.vec2],  # [N] gradient of the projected centres [1 / pixels]
    half_size: wp.vec2,  # of the image [pixels]
    # Out:
    sums_out: wp.array[float],  # [N] of the length of the gradient in half images, added to
    views_out: wp.array[int],  # [N] added to
):
    """Statistics for densification: gradient of the projected center, averaged over views."""
    i = base + wp.tid()
    if int(taken[i]) != SEEN:
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
