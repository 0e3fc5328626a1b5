"""The optimiser of a scene's parameters, row by row, and the random walk of its faint Gaussians."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import warp as wp
from torch import Tensor

from sgwarp.kernels.fitting import adam as kernels
from sgwarp.kernels.fitting import adam_elements
from sgwarp.kernels.fitting import adam_lanes as optimizing_lanes
from sgwarp.kernels.transmittance import Lanes
from sgwarp.ops.arguments import view
from sgwarp.ops.launcher import launch, launch_plain

LANE = 16
BETAS = (float(kernels.BETA_1), float(kernels.BETA_2))
FORMS = {"plain": kernels.PLAIN, "logarithm": kernels.LOGARITHM, "logit": kernels.LOGIT}


@dataclass(eq=False)
class Group:
    """One kind of parameter of all Gaussians.

    Attributes:
        parameters: What is optimised, float32 [N, ...].
        values: What is rendered, float32 [N, ...]; the parameters themselves if `form` is "plain".
        first, second: Running means of the gradient and of its square, float32 [N, ...].
        form: What the parameters are of the values: "plain", "logarithm" or "logit".
    """

    parameters: Tensor
    values: Tensor
    first: Tensor
    second: Tensor
    form: str

    @classmethod
    def starting(cls, parameters: Tensor, form: str = "plain") -> Group:
        """Parameters that have taken no step."""
        zeros = torch.zeros_like(parameters)
        return cls(parameters, values_of(parameters, form), zeros, zeros.clone(), form)


def values_of(parameters: Tensor, form: str) -> Tensor:
    """The rendered (activated) values of these parameters."""
    if form == "plain":
        return parameters
    return parameters.exp() if form == "logarithm" else parameters.sigmoid()


@dataclass(frozen=True, eq=False)
class Taken:
    """The Gaussians that take an optimizer step.

    Attributes:
        marks: 0 for those that wait, else 1, and 3 for those that the view has seen, uint8 [N].
        steps: Of each Gaussian since it came, this one included, int32 [N].
        waited: How many it makes up for, int32 [N]; valid where it takes the step, as the next.
        moves: What becomes of them, see `waited_moves` in kernels/fitting/adam.py, float32 [N, 2].
        factors: That correct the bias of both means, and by which both fell meanwhile, float32 [N, 4].
    """

    marks: Tensor
    steps: Tensor
    waited: Tensor
    moves: Tensor
    factors: Tensor

    @property
    def seen(self) -> Tensor:
        """Gaussians that the view has seen, bool [N]."""
        return self.marks == int(kernels.SEEN)

    @property
    def count(self) -> int:
        """Number of Gaussians that take the step."""
        return int((self.marks > 0).sum())


def count_steps(v_opacities: Tensor, v_sh: Tensor, steps: Tensor, skipped: Tensor, *, sparse: bool) -> Taken:
    """Count this step, for those that take it and for those that will make up for it.

    Args:
        v_opacities, v_sh: Gradients, float32 [N] and [N, K, 3].
        steps: Of each Gaussian since it came, int32 [N]; added to.
        skipped: How many of them it has yet to make up for, int32 [N]; changed.
        sparse: Only Gaussians that the view has seen take the step, else all.
    """
    count, device = len(steps), steps.device
    taken = torch.empty(count, dtype=torch.uint8, device=device)
    waited = torch.empty_like(steps)
    moves, factors = torch.empty(count, 2, device=device), torch.empty(count, 4, device=device)
    inputs = [view(v_opacities, wp.float32), view(v_sh, wp.vec3), int(not sparse)]
    outputs = [*(view(t, wp.int32) for t in (steps, skipped)), view(taken, wp.uint8)]
    outputs += [view(waited, wp.int32), view(moves, wp.vec2), view(factors, wp.vec4)]
    launch(kernels.count_steps, count, inputs, outputs, device=device)
    return Taken(taken, steps, waited, moves, factors)


def update(
    group: Group,
    gradient: Tensor,
    taken: Taken,
    rate: float,
    *,
    leading: int | None = None,
    rate_of_rest: float = 0.0,
    pull: float = 0.0,
    by_element: bool | None = None,
) -> None:
    """One step of Adam (betas 0.9 and 0.999, epsilon 1e-15) for the rows that take it, and those they waited for.

    Rows end where they would if they had taken every step, with a gradient of zero where they were not seen; the rate
    is taken to have been today's, and a pull to have met the moments of half way.

    Args:
        group: Parameters, values and moments, changed in place.
        gradient: Of the values, float32 [N, ...].
        taken: Of `count_steps`.
        rate: Learning rate of the first `leading` columns, by default all.
        rate_of_rest: Of the others.
        pull: Added to the gradient.
        by_element: A thread per element instead of one per row; by default on CUDA.
    """
    count, device = len(taken.marks), taken.marks.device
    if not count:
        return
    columns = group.parameters[0].numel()
    if by_element is None:
        by_element = device.type == "cuda"
    if columns % LANE == 0 and group.form == "plain" and not pull and not by_element:
        _update_wide(group, gradient, taken, columns, rate, columns if leading is None else leading, rate_of_rest)
        return
    rows = [t.view(count, columns) for t in (group.parameters, group.first, group.second, group.values)]
    inputs = [
        view(taken.marks, wp.uint8),
        view(taken.steps, wp.int32),
        view(taken.waited, wp.int32),
        view(taken.moves, wp.vec2),
        view(taken.factors, wp.vec4),
        view(gradient.contiguous().view(count, columns), wp.float32),
        int(FORMS[group.form]),
        rate,
        columns if leading is None else leading,
        rate_of_rest,
        pull,
    ]
    outputs = [view(t, wp.float32) for t in rows]
    if by_element:
        launch_plain(adam_elements.update_elements, count * columns, inputs, outputs, device=device)
    else:
        launch(kernels.update_rows, count, inputs, outputs, device=device)


def _update_wide(
    group: Group, gradient: Tensor, taken: Taken, columns: int, rate: float, leading: int, rate_of_rest: float
) -> None:
    rates = torch.full((columns,), rate_of_rest, device="cpu")
    rates[:leading] = rate
    shape = (len(taken.marks), columns // LANE, LANE)
    inputs = [view(taken.marks, wp.uint8), view(taken.moves, wp.vec2), view(taken.factors, wp.vec4)]
    inputs += [view(gradient.contiguous().view(shape), Lanes), view(rates.view(-1, LANE), Lanes)]
    outputs = [view(t.view(shape), Lanes) for t in (group.parameters, group.first, group.second)]
    launch(optimizing_lanes.update_wide_rows, shape[0], inputs, outputs, device=gradient.device)


def note_gradients(v_means2d: Tensor, taken: Taken, width: int, height: int, sums: Tensor, views: Tensor) -> None:
    """Add the length of each seen centre's gradient, in halves of the image, to `sums` [N], and 1 to `views` [N]."""
    inputs = [view(taken.marks, wp.uint8), view(v_means2d, wp.vec2), wp.vec2(0.5 * width, 0.5 * height)]
    outputs = [view(sums, wp.float32), view(views, wp.int32)]
    launch(kernels.note_gradients, len(sums), inputs, outputs, device=sums.device)


def add_noise(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, seed: int, size: float) -> None:
    """Move faint Gaussians within their own extent, by a random number that depends on the seed and the row alone."""
    inputs = [
        view(quats, wp.vec4),
        view(scales, wp.vec3),
        view(opacities, wp.float32),
        seed,
        size,
    ]
    launch(kernels.add_noise, len(means), inputs, [view(means, wp.vec3)], device=means.device)
