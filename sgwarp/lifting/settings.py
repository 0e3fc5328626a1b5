"""Lift modes and their settings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from sgwarp.errors import InputError

LiftMode = Literal["weighted", "center", "squared", "strongest", "robust", "solve"]


@dataclass(frozen=True)
class LiftSettings:
    """Settings of the lift modes; the defaults were chosen on one room, see docs/lifting-modes.md.

    Attributes:
        tau: Relative depth tolerance of "center".
        border: Pixels along the image edge that "center" ignores.
        passes: Times that "robust" walks over the views after the first.
        smoothing: Distance from the median below which "robust" takes a view's feature for equal to it.
        ridge: Weight of the prior of "solve"; 0 chooses it by views that are held out.
        iterations: Steps of "solve" by conjugate gradients, for each channel.
        reliability: Count a view less, the less the others agree with it.
        fill: Give Gaussians that no view saw the mean of so many seen neighbors; 0 leaves them empty.

    Raises:
        InputError: A setting is out of range.
    """

    tau: float = 0.05
    border: int = 10
    passes: int = 4
    smoothing: float = 1e-3
    ridge: float = 0.0
    iterations: int = 4
    reliability: bool = False
    fill: int = 0

    def __post_init__(self) -> None:
        if not self.tau > 0 or self.border < 0:
            raise InputError(f"tau must be positive and border not negative, got {self.tau} and {self.border}")
        for name, least in (("passes", 1), ("iterations", 1), ("fill", 0), ("ridge", 0)):
            if not least <= getattr(self, name) < float("inf"):
                raise InputError(f"{name}: expected {least} or more, got {getattr(self, name)}")
        if not 0 < self.smoothing < float("inf"):
            raise InputError(f"smoothing: expected a positive distance, got {self.smoothing}")


def check_mode(mode: str) -> None:
    """Refuse an unknown mode.

    Raises:
        InputError: `mode` is none of LiftMode.
    """
    if mode not in get_args(LiftMode):
        raise InputError(f"mode: '{mode}' is not one of {', '.join(get_args(LiftMode))}")
