"""Exposure compensation: an affine map of the colours for every photograph, fitted along with the scene."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from sgwarp.ops.adam import BETAS, Group, Taken, update

RATE, LAST_RATE = 0.01, 0.001  # of the reference implementation


class Exposure:
    """Maps [A | b], from the scene's colours to those of a photograph: A c + b.

    A factor that all photographs share belongs to the scene, so their mean is held at the identity.
    """

    def __init__(self, count: int, device: torch.device) -> None:
        self.identity = torch.eye(3, 4, device=device)
        self.group = Group.starting(self.identity.expand(count, 3, 4).contiguous())
        self.steps = torch.zeros(count, dtype=torch.int32, device=device)

    def leaf(self, index: int) -> Tensor:
        """The map of one photograph, [3, 4], to take a gradient of."""
        maps = self.group.parameters
        return (maps[index] - maps.mean(dim=0) + self.identity).requires_grad_()

    @staticmethod
    def apply(leaf: Tensor, image: Tensor) -> Tensor:
        """The image [H, W, 3] as that photograph shows it."""
        return image @ leaf[:, :3].T + leaf[:, 3]

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
        rate = math.exp((1 - share) * math.log(RATE) + share * math.log(LAST_RATE))
        update(self.group, gradients, taken, rate)

    def state(self) -> dict[str, Tensor]:
        return {"maps": self.group.parameters, "first": self.group.first, "second": self.group.second} | {
            "steps": self.steps
        }

    def restore(self, state: Mapping[str, Tensor]) -> None:
        self.group = Group(state["maps"], state["maps"], state["first"], state["second"], "plain")
        self.steps = state["steps"]
