"""Running sums of lifted features."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sgwarp.ops.splatting.forward import LANE


@dataclass(eq=False)
class LiftSums:
    """Running sums over the lifted views.

    Attributes:
        slices: Sum of weighted features, channels in slices of 16 padded with zeros, float32 [N, S, 16].
        channels: How many of them are real.
        weight: Sum of weights (weighted) or number of views (center), float32 [N].
        weight_squared: Sum over the views of the squared weight of a view, float32 [N].
    """

    slices: Tensor
    channels: int
    weight: Tensor
    weight_squared: Tensor

    @classmethod
    def zeros(cls, count: int, channels: int, device: torch.device | str = "cpu") -> LiftSums:
        """Sums of no view at all."""
        slices = torch.zeros(count, -(-channels // LANE), LANE, device=device)
        return cls(slices, channels, torch.zeros(count, device=device), torch.zeros(count, device=device))

    @property
    def features(self) -> Tensor:
        """Sum of weighted features, float32 [N, C]; shares memory with `slices`."""
        return self.slices.flatten(1)[:, : self.channels]
