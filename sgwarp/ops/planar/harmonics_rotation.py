"""Rotating real spherical harmonics: each degree by a matrix of its own (Wigner's D in the real basis)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from sgwarp.ops.planar.harmonics import harmonics_basis

DIRECTIONS = 64  # spread over the sphere; the harmonics up to degree 3 are 16


def rotation_of_harmonics(rotation: Tensor, degree: int) -> Tensor:
    """Matrix D that turns coefficients with the function: sum_k Y_k(d) (D c)_k = sum_k Y_k(R^T d) c_k.

    Harmonics of one degree turn among themselves, so D consists of blocks of 2 l + 1. Each is the exact solution of
    Y(d) D = Y(R^T d) at directions spread over the sphere, where Y has full rank.

    Args:
        rotation: R, [3, 3].
        degree: Highest degree.

    Returns:
        float64 [(degree + 1)^2, (degree + 1)^2]; right to 1e-14.
    """
    rotation = rotation.detach().to("cpu", torch.float64)
    place = torch.arange(DIRECTIONS, dtype=torch.float64) + 0.5
    z = 1.0 - 2.0 * place / DIRECTIONS
    angle = math.pi * (1.0 + math.sqrt(5.0)) * place  # the golden angle: no two directions share a plane
    radius = (1.0 - z * z).sqrt()
    directions = torch.stack([radius * angle.cos(), radius * angle.sin(), z], dim=1)
    before, after = (harmonics_basis(d, degree) for d in (directions, directions @ rotation))
    matrix = torch.zeros((degree + 1) ** 2, (degree + 1) ** 2, dtype=torch.float64)
    for order in range(degree + 1):
        block = slice(order * order, (order + 1) ** 2)
        matrix[block, block] = torch.linalg.lstsq(before[:, block], after[:, block]).solution
    return matrix


def rotate_harmonics(sh: Tensor, rotation: Tensor) -> Tensor:
    """Coefficients [N, K, C] of functions on the sphere, turned by R [3, 3]; in the type of `sh`."""
    degree = math.isqrt(sh.shape[1]) - 1
    if degree == 0:
        return sh.clone()
    matrix = rotation_of_harmonics(rotation, degree).to(sh.device)
    return torch.einsum("kj,njc->nkc", matrix, sh.double()).to(sh.dtype)
