"""Quality of a fit at one step."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Measurement:
    """Quality at one step.

    Attributes:
        step: Steps taken.
        seconds: Spent on them, without reading and measuring.
        psnr: Mean over the held-out views [dB], NaN without any.
        loss: Running mean of the loss.
        count: Gaussians.
    """

    step: int
    seconds: float
    psnr: float
    loss: float
    count: int
