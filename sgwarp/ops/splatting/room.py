"""Room for tile lists before their length is known: nobody waits for it, and a CUDA graph can hold a step."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sgwarp.errors import InputError

MOST = 2**30 - 1  # a sort takes twice the room, and Warp counts in int32
SPARE = 1.25  # of the room after growing over what was needed


@dataclass(eq=False)
class ListRoom:
    """How many intersections of splats with tiles the lists of a rendering may hold; it only grows.

    On CUDA a rendering waits once for the host, to learn how long its lists become. With a room it does not: the lists
    get this length, and what they would have needed is kept on the device, to be looked at later, between two steps.
    Where the room was too small, the farthest splats are missing from that image and its gradients, so the step has to
    be done again after `grow`. On the CPU lists are always as long as they need to be.

    Attributes:
        size: Intersections that fit.

    Raises:
        InputError: The size is not positive, or more than can be sorted.
    """

    size: int

    def __post_init__(self) -> None:
        if not 0 < self.size <= MOST:
            raise InputError(f"ListRoom: expected 1 to {MOST} intersections, got {self.size}")
        self._needed: Tensor | None = None

    def note(self, total: Tensor) -> None:
        """Remember on the device that a rendering has this many intersections, int64 []."""
        if self._needed is None or self._needed.device != total.device:
            self._needed = torch.zeros_like(total)
        torch.maximum(self._needed, total, out=self._needed)

    @property
    def needed(self) -> int:
        """The most intersections of a rendering so far; on CUDA the host waits for it."""
        return 0 if self._needed is None else int(self._needed)

    @property
    def overflowed(self) -> bool:
        """Whether some rendering had more intersections than fit; on CUDA the host waits for it."""
        return self.needed > self.size

    def grow(self) -> bool:
        """Make room for what was needed, and a quarter more; returns whether it had been too small.

        A graph that was captured keeps its old lists: capture it again.

        Raises:
            InputError: More is needed than can be sorted.
        """
        needed = self.needed
        if needed <= self.size:
            return False
        if needed > MOST:
            raise InputError(f"{needed} tile intersections exceed {MOST}; render at a lower resolution")
        self.size = min(int(SPARE * needed), MOST)
        return True
