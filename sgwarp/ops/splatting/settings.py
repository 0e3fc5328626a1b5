"""The rasterizer's knobs: every approximation by name, with its default."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sgwarp.errors import InputError


@dataclass(frozen=True)
class RasterSettings:
    """Approximations of the rasterizer, each with its default.

    Attributes:
        alpha_min: A Gaussian is left out of a pixel where its opacity is below this; 2^-16 to 1.
        alpha_max: Opacity at a pixel is clamped to this.
        transmittance_min: A pixel is closed before its transmittance falls to this.
        dilation: Added to both projected variances [pixels^2] (low-pass filter).
        surface_opacity: The depth is z where accumulated opacity passes this (alpha_d of the paper).
        sh_degree: Evaluate spherical harmonics up to this degree; None for all there are.
        antialiased: Scale opacities by the area the dilation added (Mip-Splatting's 2D filter).
    """

    alpha_min: float = 1.0 / 255.0
    alpha_max: float = 0.999
    transmittance_min: float = 1e-4
    dilation: float = 0.3
    surface_opacity: float = 0.5
    sh_degree: int | None = None
    antialiased: bool = False

    def __post_init__(self) -> None:
        checks = {
            "alpha_min": 2.0**-16 <= self.alpha_min < self.alpha_max,
            "alpha_max": 0.0 < self.alpha_max < 1.0,
            "transmittance_min": 0.0 <= self.transmittance_min < 1.0,
            "dilation": 0.0 <= self.dilation < math.inf,
            "surface_opacity": 0.0 < self.surface_opacity < 1.0 - self.transmittance_min,
            "sh_degree": self.sh_degree is None or 0 <= self.sh_degree <= 3,
        }
        for name, holds in checks.items():
            if not holds:
                raise InputError(f"RasterSettings.{name} = {getattr(self, name)} is out of range")
