"""Real spherical harmonics of any degree in plain torch, in the sign convention of 3D Gaussian Splatting files."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def harmonics_basis(directions: Tensor, degree: int) -> Tensor:
    """Y_lm at unit directions [..., 3], at place l^2 + l + m of [..., (degree + 1)^2].

    By the recurrences of the associated Legendre functions, written as polynomials in x, y, z (P.-P. Sloan, Efficient
    Spherical Harmonic Evaluation, JCGT 2013), so that the poles are no special case. Differentiable.
    """
    x, y, z = directions.unbind(-1)
    columns: list[Tensor] = [z] * (degree + 1) ** 2
    cosine, sine = torch.ones_like(z), torch.zeros_like(z)  # real and imaginary part of (x + i y)^m
    start = math.sqrt(1.0 / (4.0 * math.pi))
    for m in range(degree + 1):
        before, legendre = torch.zeros_like(z), torch.full_like(z, start)
        for n in range(m, degree + 1):
            if n > m:
                grow = math.sqrt((4 * n * n - 1) / (n * n - m * m))
                shrink = math.sqrt(((n - 1) ** 2 - m * m) / (4 * (n - 1) ** 2 - 1)) if n > m + 1 else 0.0
                before, legendre = legendre, grow * (z * legendre - shrink * before)
            columns[n * n + n + m] = legendre * cosine
            if m > 0:
                columns[n * n + n - m] = legendre * sine
        cosine, sine = x * cosine - y * sine, x * sine + y * cosine
        start *= -math.sqrt((2 * m + 3) / (2 * m + 2)) * (math.sqrt(2.0) if m == 0 else 1.0)
    return torch.stack(columns, dim=-1)


def harmonic_colors(directions: Tensor, coefficients: Tensor, degree: int) -> tuple[Tensor, Tensor]:
    """Colors of spherical harmonics, 0.5 plus their sum and at least 0, and the rows in which all numbers are finite.

    The other rows are 0 and have no gradient: an infinity in one of them would leave a NaN in its direction's.

    Args:
        directions: Of any length, [N, 3].
        coefficients: [N, K, C].

    Returns:
        [N, C] and bool [N].
    """
    coefficients = coefficients[:, : (degree + 1) ** 2]
    total = coefficients.detach().sum(dim=(1, 2), dtype=torch.float64)
    finite = torch.isfinite(total + directions.detach().sum(dim=1, dtype=torch.float64))
    if finite.is_cuda or not bool(finite.all()):  # on CUDA to ask is to wait for the device
        directions = torch.where(finite[:, None], directions, 0.0)
        coefficients = torch.where(finite[:, None, None], coefficients, 0.0)
    colors = (harmonics_sum(directions, coefficients, degree) + 0.5).clamp(min=0.0)
    return torch.where(finite[:, None], colors, 0.0), finite


def harmonics_sum(directions: Tensor, coefficients: Tensor, degree: int) -> Tensor:
    """Sum over k < (degree + 1)^2 of Y_k times coefficients.

    Args:
        directions: Of any length, [N, 3]; a direction of length zero counts as (0, 0, 0).
        coefficients: [N, K, C].

    Returns:
        [N, C].
    """
    basis = harmonics_basis(torch.nn.functional.normalize(directions, dim=-1), degree)
    return (basis[:, None] @ coefficients[:, : basis.shape[1]])[:, 0]
