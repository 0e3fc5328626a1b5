"""Scenes turned, scaled, mirrored and bent, with everything that belongs to a Gaussian following its centre."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.ops.deformation import deformed
from sgwarp.ops.planar.harmonics import harmonics_basis
from sgwarp.scene import Gaussians

LATTICE = 64  # nodes per axis of the bending field, which repeats beyond


def transformed(gaussians: Gaussians, matrix: Tensor) -> Gaussians:
    """The scene under x -> A x: centres, covariances (A Sigma A^T) and the directions that colours depend on.

    Args:
        gaussians: The scene.
        matrix: A, a rotation times a positive factor, mirrored or not, [3, 3].

    Raises:
        InputError: The matrix is something else.
    """
    A = matrix.detach().to("cpu", torch.float64)
    factor = float(A.square().sum() / 3) ** 0.5
    error = float((A @ A.T / factor**2 - torch.eye(3, dtype=torch.float64)).abs().max()) if factor else math.inf
    if A.shape != (3, 3) or not error < 1e-5:
        raise InputError(f"matrix: expected a rotation or mirroring times a factor, it is off by {error:.2g}")
    Q = A / factor
    device = gaussians.device
    # -Q gives a Gaussian the same covariance as Q, and of the two one is a rotation, which a quaternion can hold.
    turn = _quaternion(Q * torch.linalg.det(Q).sign())
    return replace(
        gaussians,
        means=(gaussians.means.double() @ A.T.to(device)).float(),
        quats=_product(turn.to(device), gaussians.quats.double()).float(),
        scales=gaussians.scales * factor,
        sh=torch.einsum("jk,nkc->njc", _harmonics_turn(Q, gaussians.sh_degree).to(device), gaussians.sh),
    )


def _quaternion(R: Tensor) -> Tensor:
    """(w, x, y, z) of a rotation: the eigenvector of Bar-Itzhack's matrix (J. Guidance 23, 2000), float64 [4]."""
    K = torch.empty(4, 4, dtype=torch.float64)
    K[1:, 1:] = R + R.T - torch.trace(R) * torch.eye(3, dtype=torch.float64)
    K[0, 0] = torch.trace(R)
    K[0, 1:] = K[1:, 0] = torch.stack([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    return torch.linalg.eigh(K).eigenvectors[:, -1]


def _product(p: Tensor, q: Tensor) -> Tensor:
    """Quaternion p times the quaternions q [N, 4]: first the turn of q, then that of p."""
    w, v = p[0], p[1:]
    scalar = w * q[:, :1] - q[:, 1:] @ v[:, None]
    vector = w * q[:, 1:] + q[:, :1] * v + torch.linalg.cross(v.expand_as(q[:, 1:]), q[:, 1:])
    return torch.cat([scalar, vector], dim=1)


def _harmonics_turn(Q: Tensor, degree: int) -> Tensor:
    """D with Y(Q^T d) = Y(d) D for all directions d, by least squares over more of them than D has rows, float32."""
    d = torch.nn.functional.normalize(torch.randn(64, 3, dtype=torch.float64, generator=_generator(0)), dim=1)
    D = torch.linalg.lstsq(harmonics_basis(d, degree), harmonics_basis(d @ Q, degree)).solution
    return D.float()


@dataclass(frozen=True)
class Augmentation:
    """Random changes of a training scene; the defaults are the paper's release's.

    Attributes:
        up: Axis that points up or down, 0, 1 or 2 for x, y, z: scenes are turned around it and mirrored across it.
        tilt: Largest turn around the other two axes [rad].
        turn: Largest turn around the axis up [rad].
        scale: Smallest and largest factor.
        mirror: Mirror each horizontal axis in half of the cases.
        elastic: Pairs of granularity [m] and magnitude [m] of smooth random displacements; in 95 % of the cases.
        shift: Largest shift along each axis, in voxels: it changes which points share a voxel.
    """

    up: int = 2
    tilt: float = math.pi / 64
    turn: float = math.pi
    scale: tuple[float, float] = (0.9, 1.1)
    mirror: bool = True
    elastic: tuple[tuple[float, float], ...] = ((0.2, 0.4), (0.8, 1.6))
    shift: float = 100.0

    def __call__(self, gaussians: Gaussians, voxel: float, generator: torch.Generator) -> Gaussians:
        """A changed scene; the same generator state gives the same changes."""
        if self.elastic and _uniform(generator, 0.0, 1.0) < 0.95:
            for granularity, magnitude in self.elastic:
                moved, gradient = bend(gaussians.means, granularity, magnitude, generator)
                jacobians = torch.eye(3, device=gradient.device) + gradient
                gaussians = deformed(gaussians, gaussians.means + moved, jacobians)
        A = torch.eye(3, dtype=torch.float64)
        for axis in (*(a for a in range(3) if a != self.up), self.up):
            most = self.turn if axis == self.up else self.tilt
            A = _rotation(axis, _uniform(generator, -most, most)) @ A
        for axis in range(3):
            if self.mirror and axis != self.up and _uniform(generator, 0.0, 1.0) < 0.5:
                A[axis] = -A[axis]
        gaussians = transformed(gaussians, A * _uniform(generator, *self.scale))
        shift = torch.rand(3, generator=generator) * self.shift * voxel
        return replace(gaussians, means=gaussians.means + shift.to(gaussians.device))


def bend(points: Tensor, granularity: float, magnitude: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Smooth random displacements of points [N, 3]: noise on a lattice, blurred, interpolated linearly.

    Args:
        points: [m], [N, 3]; where one is not finite, so is its displacement.
        granularity: Spacing of the lattice [m].
        magnitude: Standard deviation of the noise before it is blurred [m].
        generator: Of the noise.

    Returns:
        Displacements u [m], [N, 3], and their derivatives, [N, 3, 3] with du_i / dx_j in row i and column j.
    """
    noise = torch.randn(LATTICE, LATTICE, LATTICE, 3, generator=generator) * magnitude
    for axis in (0, 1, 2, 0, 1, 2):
        noise = (noise + noise.roll(1, axis) + noise.roll(-1, axis)) / 3
    noise = noise.to(points.device)
    place = points / granularity
    corner = place.floor()
    within = place - corner
    corner = torch.where(torch.isfinite(corner), corner.remainder(LATTICE), 0.0).long()
    moved, gradient = torch.zeros_like(points), points.new_zeros(len(points), 3, 3)
    for number in range(8):
        step = torch.tensor([number >> 2, number >> 1 & 1, number & 1], device=points.device)
        shares = torch.where(step.bool(), within, 1.0 - within)
        x, y, z = ((corner + step) % LATTICE).unbind(1)
        value = noise[x, y, z]
        moved += shares.prod(dim=1, keepdim=True) * value
        for axis in range(3):
            others = shares[:, [a for a in range(3) if a != axis]].prod(dim=1, keepdim=True)
            gradient[:, :, axis] += (2 * step[axis] - 1) * others * value
    return moved, gradient / granularity


def _rotation(axis: int, angle: float) -> Tensor:
    R = torch.eye(3, dtype=torch.float64)
    a, b = (axis + 1) % 3, (axis + 2) % 3
    R[a, a] = R[b, b] = math.cos(angle)
    R[b, a] = math.sin(angle)
    R[a, b] = -R[b, a]
    return R


def _uniform(generator: torch.Generator, low: float, high: float) -> float:
    return low + (high - low) * float(torch.rand((), generator=generator, dtype=torch.float64))


def _generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)
