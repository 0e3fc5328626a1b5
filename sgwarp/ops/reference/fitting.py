"""Float64 oracles of what fitting needs: the photometric loss and Adam, written from their equations."""

from __future__ import annotations

import torch
from torch import Tensor

WINDOW, DEVIATION = 11, 1.5  # of SSIM [pixels]
STABILISERS = 0.01**2, 0.03**2


def photometric_loss(image: Tensor, truth: Tensor, similarity_share: float = 0.2) -> Tensor:
    """(1 - s) mean |x - y| + s (1 - SSIM), with whole two-dimensional windows; float64, differentiable.

    Args:
        image, truth: [H, W, 3].
        similarity_share: s.
    """
    x, y = (t.to(torch.float64).permute(2, 0, 1)[:, None] for t in (image, truth))
    offsets = torch.arange(WINDOW, dtype=torch.float64) - WINDOW // 2
    squared = offsets[:, None] ** 2 + offsets[None, :] ** 2
    window = torch.exp(-0.5 * squared / DEVIATION**2)
    window = (window / window.sum())[None, None]

    def mean(values: Tensor) -> Tensor:
        return torch.nn.functional.conv2d(values, window, padding=WINDOW // 2)

    mean_x, mean_y = mean(x), mean(y)
    variance_x, variance_y = mean(x * x) - mean_x**2, mean(y * y) - mean_y**2
    covariance = mean(x * y) - mean_x * mean_y
    c1, c2 = STABILISERS
    luminance = (2 * mean_x * mean_y + c1) / (mean_x**2 + mean_y**2 + c1)
    structure = (2 * covariance + c2) / (variance_x + variance_y + c2)
    similarity = (luminance * structure).mean()
    return (1 - similarity_share) * (x - y).abs().mean() + similarity_share * (1 - similarity)


def adam(
    parameters: Tensor,
    gradients: Tensor,
    rate: float,
    betas: tuple[float, float] = (0.9, 0.999),
    epsilon: float = 1e-15,
) -> Tensor:
    """Parameters after one step of Adam for each gradient, float64.

    Args:
        parameters: [...].
        gradients: [steps, ...], of the parameters.
    """
    first, second = torch.zeros_like(parameters), torch.zeros_like(parameters)
    for step, gradient in enumerate(gradients, start=1):
        first = betas[0] * first + (1 - betas[0]) * gradient
        second = betas[1] * second + (1 - betas[1]) * gradient**2
        mean = first / (1 - betas[0] ** step)
        spread = second / (1 - betas[1] ** step)
        parameters = parameters - rate * mean / (spread.sqrt() + epsilon)
    return parameters
