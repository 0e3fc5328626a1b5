"""Gradients between the stages of the rasterizer's backward pass."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class ImageGradients:
    """Gradient of the loss with respect to what compositing returns; None is zero.

    Attributes:
        features: float32 [H, W, C].
        alpha: Of the accumulated opacity, float32 [H, W].
        depth_sum: Of sum alpha T z, float32 [H, W].
        surface: Of the surface depth, float32 [H, W].
    """

    features: Tensor | None = None
    alpha: Tensor | None = None
    depth_sum: Tensor | None = None
    surface: Tensor | None = None

    def images(self, transmittance: Tensor, channels: int) -> tuple[Tensor, Tensor, Tensor]:
        """Gradients of features, alpha and depth sum; zeros of their shape where there are none."""
        zeros = torch.zeros((), device=transmittance.device)
        v_image = zeros.expand(*transmittance.shape, channels) if self.features is None else self.features
        others = (self.alpha, self.depth_sum)
        v_alpha, v_depth = (zeros.expand_as(transmittance) if t is None else t for t in others)
        return v_image, v_alpha, v_depth


def gradient_of_alpha(v_alpha: Tensor | None, v_transmittance: Tensor | None) -> Tensor | None:
    """The gradient of alpha from its own and that of the transmittance, 1 - alpha; None is zero."""
    if v_transmittance is None:
        return v_alpha
    return -v_transmittance if v_alpha is None else v_alpha - v_transmittance


@dataclass(frozen=True, eq=False)
class SplatGradients:
    """Gradients of the splats from compositing; zero for Gaussians that reached no tile.

    Attributes:
        sums: Moments of g under 1, u, v, u^2, u v, v^2 (see kernels/projection_backward.py), then others, [N, 16].
        at_depth: Column of `sums` with the gradient of the depth, -1 if there is none.
        features: Gradient of the composited features, [N, C].
        absolute: Sum over the pixels of the magnitude of each one's gradient of the projected centre, [N, 2]; or None.
    """

    sums: Tensor
    at_depth: int
    features: Tensor
    absolute: Tensor | None


@dataclass(frozen=True, eq=False)
class GaussianGradients:
    """Gradients with respect to what projection reads, float32 [N, ...]; `poses` [N, 12] is empty unless asked for."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    means2d: Tensor
    poses: Tensor
