"""Image quality."""

from __future__ import annotations

import math

from torch import Tensor


def psnr(image: Tensor, truth: Tensor, mask: Tensor | None = None) -> float:
    """Peak signal-to-noise ratio of an image, clipped to [0, 1], against the truth [dB], where a mask lets it count."""
    squares = (image.clamp(0.0, 1.0) - truth).square()
    error = float((squares if mask is None else squares[mask]).mean())
    return math.inf if error == 0.0 else -10.0 * math.log10(error)
