"""Parameters that every photograph has of its own, fitted along with the scene."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from sgwarp.ops.adam import BETAS, Group, Taken, update


class PerPhotograph:
    """One row of parameters per photograph; a step of Adam moves the row of the photograph that was looked at.

    Args:
        start: Rows to start from, float32 [photographs, ...].
        rate, last_rate: Of the first and the last step; it falls exponentially.
    """

    def __init__(self, start: Tensor, rate: float, last_rate: float) -> None:
        self.group = Group.starting(start)
        self.steps = torch.zeros(len(start), dtype=torch.int32, device=start.device)
        self._rates = rate, last_rate

    def update(self, index: int, gradient: Tensor, share: float) -> None:
        """One step for one photograph; `share` of all steps are done."""
        marks = torch.zeros(len(self.steps), dtype=torch.uint8, device=self.steps.device)
        marks[index] = 1
        self.steps[index] += 1
        none, count = torch.zeros_like(self.steps), self.steps.float()
        unchanged = torch.ones_like(count)  # no photograph makes up for steps of others
        by_first, by_second = (1 / (1 - beta**count) for beta in BETAS)
        factors = torch.stack([by_first, by_second, unchanged, unchanged], dim=1)
        taken = Taken(marks, self.steps, none, count.new_zeros(len(count), 2), factors)
        gradients = torch.zeros_like(self.group.parameters)
        gradients[index] = gradient
        rate, last_rate = self._rates
        update(self.group, gradients, taken, math.exp((1 - share) * math.log(rate) + share * math.log(last_rate)))

    def state(self) -> dict[str, Tensor]:
        """Tensors by name, for a checkpoint."""
        return {"maps": self.group.parameters, "first": self.group.first, "second": self.group.second} | {
            "steps": self.steps
        }

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Go on from `state()`.

        Raises:
            KeyError, ValueError: The state is not of as many photographs.
        """
        maps, first, second, steps = (state[name] for name in ("maps", "first", "second", "steps"))
        shape = self.group.parameters.shape
        if any(rows.shape != shape or rows.dtype != torch.float32 for rows in (maps, first, second)):
            raise ValueError("parameters of other photographs")
        if steps.shape != self.steps.shape or steps.dtype != torch.int32:
            raise ValueError("steps of other photographs")
        self.group = Group(maps, maps, first, second, "plain")
        self.steps = steps
