"""The step of `adam.py` for many plain columns, lane schedule (CPU): 16 at a time, in C++ (`native.py`)."""

import warp as wp

from sgwarp.kernels.fitting.adam import BETA_1, BETA_2, EPSILON
from sgwarp.kernels.gaussian import EXACT_OPTIONS
from sgwarp.kernels.native import snippet
from sgwarp.kernels.transmittance import Lanes

wp.set_module_options(EXACT_OPTIONS)

UPDATE = """
    const auto& factor = factors.data[i];
    const float by_first = factor[0], by_second = factor[1], decay_1 = factor[2], decay_2 = factor[3];
    const float moves_0 = moves.data[i][0];
    const int vectors = gradient.shape[1];
    for (int j = 0; j < vectors; ++j) {
        const int at = i * vectors + j;
        const Row rate = reinterpret_cast<const Row*>(rates.data)[j];
        const Row g = reinterpret_cast<const Row*>(gradient.data)[at];
        Row first = reinterpret_cast<const Row*>(first_out.data)[at];
        Row second = reinterpret_cast<const Row*>(second_out.data)[at];
        Row parameter = reinterpret_cast<const Row*>(parameters_out.data)[at];
        if (moves_0 > 0.0f) {
            parameter -= rate * first * moves_0 / (__builtin_elementwise_sqrt(second) + ADAM_EPSILON);
            first *= decay_1;
            second *= decay_2;
        }
        first += (1.0f - BETA_1) * (g - first);
        second += (1.0f - BETA_2) * (g * g - second);
        parameter -= rate * first * by_first / (__builtin_elementwise_sqrt(second * by_second) + ADAM_EPSILON);
        reinterpret_cast<Row*>(first_out.data)[at] = first;
        reinterpret_cast<Row*>(second_out.data)[at] = second;
        reinterpret_cast<Row*>(parameters_out.data)[at] = parameter;
    }
"""


@wp.func_native(snippet(UPDATE, BETA_1=float(BETA_1), BETA_2=float(BETA_2), ADAM_EPSILON=float(EPSILON)))
def update_row(
    i: int,
    moves: wp.array[wp.vec2],
    factors: wp.array[wp.vec4],
    gradient: wp.array2d[Lanes],
    rates: wp.array[Lanes],
    parameters_out: wp.array2d[Lanes],
    first_out: wp.array2d[Lanes],
    second_out: wp.array2d[Lanes],
): ...


@wp.kernel
def update_wide_rows(
    # In:
    base: int,  # first Gaussian of this launch
    taken: wp.array[wp.uint8],  # [N] 0 = does not take this step
    moves: wp.array[wp.vec2],  # [N] of `count_steps`
    factors: wp.array[wp.vec4],  # [N] of `count_steps`
    gradient: wp.array2d[Lanes],  # [N, P / 16]
    rates: wp.array[Lanes],  # [P / 16]
    # Out:
    parameters_out: wp.array2d[Lanes],  # [N, P / 16] changed, as the next
    first_out: wp.array2d[Lanes],  # mean of the gradient
    second_out: wp.array2d[Lanes],  # mean of its square
):
    """`update_rows` of plain parameters without a pull, whose columns are a multiple of 16."""
    i = base + wp.tid()
    if taken[i] == wp.uint8(0):
        return
    update_row(i, moves, factors, gradient, rates, parameters_out, first_out, second_out)
