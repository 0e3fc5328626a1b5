"""Exposure compensation: an affine map of the colours for every photograph, fitted along with the scene."""

from __future__ import annotations

import torch
from torch import Tensor

from sgwarp.reconstruction.fitting.per_photograph import PerPhotograph

RATE, LAST_RATE = 0.01, 0.001  # of the reference implementation


class Exposure(PerPhotograph):
    """Maps [A | b], from the scene's colours to those of a photograph: A c + b.

    A factor that all photographs share belongs to the scene, so their mean is held at the identity.
    """

    def __init__(self, count: int, device: torch.device) -> None:
        self.identity = torch.eye(3, 4, device=device)
        super().__init__(self.identity.expand(count, 3, 4).contiguous(), RATE, LAST_RATE)

    def leaf(self, index: int) -> Tensor:
        """The map of one photograph, [3, 4], to take a gradient of."""
        maps = self.group.parameters
        return (maps[index] - maps.mean(dim=0) + self.identity).requires_grad_()

    @staticmethod
    def apply(leaf: Tensor, image: Tensor) -> Tensor:
        """The image [H, W, 3] as that photograph shows it."""
        return image @ leaf[:, :3].T + leaf[:, 3]
