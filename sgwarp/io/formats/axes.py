"""Directions of the coordinate axes of a scene file, and the change from one to another.

A frame is named by where x, y and z point: R or L, U or D, F or B. PLY scenes are RDF (y down, z forward, as OpenCV's
cameras), SPZ is RUB (y up, z back, as OpenGL's), glTF is LUF (y up, the front of things faces +z).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from sgwarp.errors import InputError
from sgwarp.scene import Gaussians

LETTERS = ("RL", "UD", "FB")
PLY_AXES = "RDF"
SPZ_AXES = "RUB"
GLTF_AXES = "LUF"
# Powers of x, y, z modulo 2 of the spherical harmonics of degree 1 to 3, in the order of the coefficients.
PARITIES = np.array(
    [
        *[(0, 1, 0), (0, 0, 1), (1, 0, 0)],
        *[(1, 1, 0), (0, 1, 1), (0, 0, 0), (1, 0, 1), (0, 0, 0)],
        *[(0, 1, 0), (1, 1, 1), (0, 1, 0), (0, 0, 1), (1, 0, 0), (0, 0, 1), (1, 0, 0)],
    ]
)


def parse_axes(text: str) -> str:
    """The name of a frame in capitals.

    Raises:
        InputError: It does not name one direction for each of x, y, z.
    """
    name = text.upper()
    if len(name) != 3 or any(letter not in both for letter, both in zip(name, LETTERS, strict=False)):
        raise InputError(f"axes '{text}': expected R or L, U or D, F or B, as in rdf (PLY), rub (SPZ) or luf (glTF)")
    return name


def signs_between(source: str, target: str) -> tuple[float, float, float]:
    """Factors of x, y, z that turn coordinates of one frame into those of another."""
    x, y, z = (1.0 if a == b else -1.0 for a, b in zip(parse_axes(source), parse_axes(target), strict=True))
    return x, y, z


def change_axes(gaussians: Gaussians, source: str, target: str) -> Gaussians:
    """The same scene in another frame; exact, as only signs change.

    A mirrored frame mirrors the scene, which is what the frames' names ask for.
    """
    signs = signs_between(source, target)
    if signs == (1.0, 1.0, 1.0):
        return gaussians
    x, y, z = signs
    from dataclasses import replace

    means = gaussians.means * gaussians.means.new_tensor(signs)
    # A mirrored rotation turns the other way about a mirrored axis: two signs each, and w stays.
    quats = gaussians.quats * gaussians.quats.new_tensor([1.0, y * z, x * z, x * y])
    return replace(gaussians, means=means, quats=quats, sh=gaussians.sh * harmonic_signs(signs, gaussians.sh)[:, None])


def harmonic_signs(signs: tuple[float, float, float], sh: Any) -> Any:
    """Factors of the coefficients [K] of `sh` [N, K, 3] when the axes change sign."""
    rest = np.prod(np.where(PARITIES == 1, np.array(signs), 1.0), axis=1)
    factors = np.concatenate([[1.0], rest])[: sh.shape[1]]
    return torch.from_numpy(factors).to(sh)


def move_gaussians(gaussians: Gaussians, matrix: Any) -> Gaussians:
    """The scene after a similarity transform of the world: rotation, uniform scale, translation.

    Args:
        gaussians: The scene.
        matrix: float64 [4, 4], points as columns; a positive uniform scale and no shear.

    Raises:
        InputError: The matrix is no such transform.
    """
    from dataclasses import replace

    matrix = np.asarray(matrix, np.float64)
    linear = matrix[:3, :3]
    scale = float(np.cbrt(np.linalg.det(linear))) if np.isfinite(matrix).all() else 0.0
    if scale <= 0 or np.abs(linear.T @ linear / scale**2 - np.eye(3)).max() > 1e-3:
        raise InputError(
            "the transform is not a rotation with one positive scale; scenes cannot be sheared or mirrored"
        )
    if np.array_equal(matrix, np.eye(4)):
        return gaussians
    rotation = linear / scale
    means = gaussians.means.double().cpu().numpy() @ linear.T + matrix[:3, 3]
    quats = _multiply(quaternion_of(rotation), gaussians.quats.double().cpu().numpy())
    return replace(
        gaussians,
        means=torch.from_numpy(means).to(gaussians.means),
        quats=torch.from_numpy(quats).to(gaussians.quats),
        scales=gaussians.scales * scale,
        sh=turn_harmonics(gaussians.sh, rotation),
    )


def turn_harmonics(sh: torch.Tensor, rotation: Any) -> torch.Tensor:
    """Coefficients [N, K, 3] of the colors after a rotation of the world, [3, 3].

    Each degree turns within itself. Its matrix follows from what the harmonics are in enough directions.
    """
    if sh.shape[1] == 1:
        return sh
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before, after = (harmonic_basis(d) for d in (directions @ np.asarray(rotation, np.float64), directions))
    blocks = [sh[:, :1]]
    for degree in range(1, int(np.sqrt(sh.shape[1]))):
        band = slice(degree**2, (degree + 1) ** 2)
        # Color at d afterwards is what it was at R^-1 d: after[:, band] turned = before[:, band] sh.
        turn = np.linalg.lstsq(after[:, band], before[:, band], rcond=None)[0]
        blocks.append(torch.einsum("ij,njc->nic", torch.from_numpy(turn).to(sh), sh[:, band]))
    return torch.cat(blocks, dim=1)


def harmonic_basis(directions: Any) -> Any:
    """Real spherical harmonics of degree 0 to 3 in the order and with the signs of 3DGS, [M, 16] of unit [M, 3]."""
    x, y, z = np.asarray(directions, np.float64).T
    xx, yy, zz = x * x, y * y, z * z
    root = np.sqrt
    columns = [
        root(1 / 4) * np.ones_like(x),
        *(root(3 / 4) * value for value in (-y, z, -x)),
        root(15 / 4) * x * y,
        -root(15 / 4) * y * z,
        root(5 / 16) * (2 * zz - xx - yy),
        -root(15 / 4) * x * z,
        root(15 / 16) * (xx - yy),
        -root(35 / 32) * y * (3 * xx - yy),
        root(105 / 4) * x * y * z,
        -root(21 / 32) * y * (4 * zz - xx - yy),
        root(7 / 16) * z * (2 * zz - 3 * xx - 3 * yy),
        -root(21 / 32) * x * (4 * zz - xx - yy),
        root(105 / 16) * z * (xx - yy),
        -root(35 / 32) * x * (xx - 3 * yy),
    ]
    return np.stack(columns, axis=1) / root(np.pi)


def quaternion_of(rotation: Any) -> Any:
    """Unit quaternion (w, x, y, z) of a rotation matrix, float64 [4]."""
    r = np.asarray(rotation, np.float64)
    # Eigenvector of the largest eigenvalue (Bar-Itzhack 2000), stable for every angle.
    k = np.array(
        [
            [r[0, 0] + r[1, 1] + r[2, 2], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
            [0, r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
            [0, 0, r[1, 1] - r[0, 0] - r[2, 2], r[1, 2] + r[2, 1]],
            [0, 0, 0, r[2, 2] - r[0, 0] - r[1, 1]],
        ]
    )
    return np.linalg.eigh(k, UPLO="U")[1][:, -1]


def _multiply(a: Any, b: Any) -> Any:
    """Product of quaternions (w, x, y, z), [4] and [N, 4]."""
    w, x, y, z = a
    bw, bx, by, bz = b.T
    product = (
        w * bw - x * bx - y * by - z * bz,
        w * bx + x * bw + y * bz - z * by,
        w * by - x * bz + y * bw + z * bx,
        w * bz + x * by - y * bx + z * bw,
    )
    return np.stack(product, axis=1)
