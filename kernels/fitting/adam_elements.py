"""Adam on CUDA: a thread per element, so that neighbouring threads read neighbouring memory.

The mathematics is that of `adam.update_rows`, where a thread owns a Gaussian.
"""

import warp as wp

from sgwarp.kernels.fitting.adam import BETA_1, BETA_2, EPSILON, LOGARITHM, LOGIT, PLAIN
from sgwarp.kernels.gaussian import EXACT_OPTIONS

wp.set_module_options(EXACT_OPTIONS)


@wp.func
def element_step(
    gradient: float,
    value: float,
    parameter: float,
    first: float,
    second: float,
    form: int,
    step: float,
    pull: float,
    behind: float,
    move: wp.vec2,
    factor: wp.vec4,
    half_way: wp.vec2,
):
    """Parameter and moments after one step and those it makes up for; `half_way` is of `second_half_way`."""
    slope = float(1.0)
    if form == LOGARITHM:
        slope = value
    elif form == LOGIT:
        slope = value * (1.0 - value)
    if behind > 0.0:
        parameter -= step * first * move[0] / (wp.sqrt(second) + EPSILON)
        constant = pull * slope  # all the gradient there was
        if constant != 0.0:
            size = (second * half_way[0] + constant * constant * (1.0 - half_way[0])) * half_way[1]
            parameter -= step * move[1] * constant / (wp.sqrt(size) + EPSILON)
        first = first * factor[2] + constant * (1.0 - factor[2])
        second = second * factor[3] + constant * constant * (1.0 - factor[3])
    g = (gradient + pull) * slope
    first += (1.0 - BETA_1) * (g - first)
    second += (1.0 - BETA_2) * (g * g - second)
    parameter -= step * first * factor[0] / (wp.sqrt(second * factor[1]) + EPSILON)
    return parameter, first, second


@wp.func
def second_half_way(steps: int, behind: float, pull: float, factor: wp.vec4) -> wp.vec2:
    """By how much the mean square fell in half of the steps waited for, and what corrects its bias there."""
    if pull == 0.0 or behind == 0.0:
        return wp.vec2(1.0, 1.0)
    return wp.vec2(wp.sqrt(factor[3]), 1.0 / (1.0 - wp.pow(BETA_2, float(steps) - 1.0 - 0.5 * behind)))


@wp.func
def value_of(parameter: float, form: int) -> float:
    """What is rendered for a parameter that is not PLAIN."""
    return wp.where(form == LOGARITHM, wp.exp(parameter), 1.0 / (1.0 + wp.exp(-parameter)))


@wp.kernel
def update_elements(
    # In:
    taken: wp.array[wp.uint8],  # [N] 0 = does not take this step; all arguments are those of `update_rows`
    steps: wp.array[int],  # [N]
    waited: wp.array[int],  # [N]
    moves: wp.array[wp.vec2],  # [N]
    factors: wp.array[wp.vec4],  # [N]
    gradient: wp.array2d[float],  # [N, P]
    form: int,
    rate: float,
    leading: int,
    rate_of_rest: float,
    pull: float,
    # Out:
    parameters_out: wp.array2d[float],  # [N, P] changed
    first_out: wp.array2d[float],  # [N, P] changed
    second_out: wp.array2d[float],  # [N, P] changed
    values_out: wp.array2d[float],  # [N, P] changed
):
    """One step of Adam (Kingma and Ba 2015) on the parameters behind the values, and those it has waited for."""
    e = wp.tid()
    i = e / gradient.shape[1]
    j = e % gradient.shape[1]
    if taken[i] == wp.uint8(0):
        return
    behind = float(waited[i])
    half_way = second_half_way(steps[i], behind, pull, factors[i])
    step = wp.where(j < leading, rate, rate_of_rest)
    parameter, first, second = element_step(
        gradient[i, j],
        values_out[i, j],
        parameters_out[i, j],
        first_out[i, j],
        second_out[i, j],
        form,
        step,
        pull,
        behind,
        moves[i],
        factors[i],
        half_way,
    )
    first_out[i, j] = first
    second_out[i, j] = second
    parameters_out[i, j] = parameter
    if form != PLAIN:
        values_out[i, j] = value_of(parameter, form)
