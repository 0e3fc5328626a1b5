"""Central differences of a float64 loss, against gradients that somebody claims."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

LOSS_STEP = 1e-6  # how much one entry moves the loss
RELATIVE_TOLERANCE = 1e-3
SMALLEST_STRIDE = 0.1  # of the strongest entry's gradient: bounds how far a weak entry moves
LARGEST_STEP = 1e-3  # of the largest entry: where nothing depends much on a tensor, and differences stay differences
LOSS_ROUNDING = 1e-12  # of a loss of this size, in float64


def assert_central_differences(
    loss: Callable[[dict[str, Tensor]], Tensor],
    point: dict[str, Tensor],
    gradients: dict[str, Tensor],
    groups: int = 2,
    tolerance: float = RELATIVE_TOLERANCE,
) -> None:
    """Compare each gradient with differences of `loss` along one direction for every `groups`-th of its rows.

    A direction goes uphill in every entry, so that nothing cancels, and further in entries of small gradient, so that
    all count alike. Entries whose gradient is claimed to be zero move at random: the loss must not notice.

    Args:
        loss: Of named float64 tensors; must not depend on anything random.
        point: Where it is differentiated.
        gradients: Claimed, under the names of all tensors to compare, each of the shape of its tensor.
    """
    rng = torch.Generator().manual_seed(0)
    for name, claimed in gradients.items():
        claimed = claimed.detach().double()
        size = claimed.abs()
        assert size.max() > 0, f"{name}: nothing to compare"
        typical = torch.maximum(size[size > 0].mean(), SMALLEST_STRIDE * size.max())
        random = torch.rand(claimed.shape, generator=rng, dtype=torch.float64)
        sign = torch.where(size > 0, claimed.sign(), (random - 0.5).sign())
        largest = LARGEST_STEP * point[name].abs().max().clamp(min=1e-2)
        stride = torch.minimum(LOSS_STEP / typical, largest)
        step = stride * (0.5 + 0.5 * random) * sign * (typical / size).clamp(max=1.0)
        count = groups if len(claimed) > 4 else 1  # a pose or a background is one piece
        for first in range(count):
            moved = torch.zeros_like(step)
            moved[first::count] = step[first::count]
            front, back = point[name] + moved, point[name] - moved
            with torch.no_grad():
                high, low = loss({**point, name: front}), loss({**point, name: back})
            rise, rounding = high - low, LOSS_ROUNDING * high.abs().clamp(min=1.0)
            expected = (claimed * (front - back)).sum()  # with the difference as it was rounded
            error = abs(expected - rise)
            assert error <= tolerance * abs(rise) + rounding, f"{name}, rows {first}::{count}: {expected} for {rise}"
