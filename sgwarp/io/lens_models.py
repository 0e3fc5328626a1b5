"""Where a lens puts a ray: the camera models of COLMAP 4 and nerfstudio, from pinhole to distorted coordinates.

A ray (x, y, 1) in camera axes arrives at (u, v) in units of the focal lengths around the principal point. Each model is
one function of x, y and its coefficients; formulas are those of COLMAP's src/colmap/sensor/models.h.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
LensModel = Literal[
    "perspective",  # k1 k2 p1 p2 k3 k4 k5 k6 of OpenCV, or fewer
    "fisheye",  # k1 k2 k3 k4 of OpenCV's equidistant model
    "fov",  # omega
    "thin_prism_fisheye",  # k1 k2 p1 p2 k3 k4 sx1 sy1
    "rad_tan_thin_prism_fisheye",  # k0 to k5, p0 p1, s0 to s3
    "division",  # k
    "eucm",  # alpha beta
]
TINY = 1e-12
PANORAMA = "EQUIRECTANGULAR"  # shows all around, which no pinhole image can
PANORAMA_REMEDY = "cut the panoramas into perspective images first (pycolmap's example panorama_sfm.py does)"
# As other tools call such lenses, in capitals.
PANORAMAS = (
    PANORAMA,
    "SPHERICAL",
    "PANORAMA",
    "OMNIDIRECTIONALSTEREO_L",
    "OMNIDIRECTIONALSTEREO_R",
    "VR180_L",
    "VR180_R",
)
# COLMAP's name: model here, number of focal lengths, number of coefficients.
COLMAP_MODELS: dict[str, tuple[LensModel, int, int]] = {
    "SIMPLE_PINHOLE": ("perspective", 1, 0),
    "PINHOLE": ("perspective", 2, 0),
    "SIMPLE_RADIAL": ("perspective", 1, 1),
    "RADIAL": ("perspective", 1, 2),
    "OPENCV": ("perspective", 2, 4),
    "OPENCV_FISHEYE": ("fisheye", 2, 4),
    "FULL_OPENCV": ("perspective", 2, 8),
    "FOV": ("fov", 2, 1),
    "SIMPLE_RADIAL_FISHEYE": ("fisheye", 1, 1),
    "RADIAL_FISHEYE": ("fisheye", 1, 2),
    "THIN_PRISM_FISHEYE": ("thin_prism_fisheye", 2, 8),
    "RAD_TAN_THIN_PRISM_FISHEYE": ("rad_tan_thin_prism_fisheye", 2, 12),
    "SIMPLE_DIVISION": ("division", 1, 1),
    "DIVISION": ("division", 2, 1),
    "SIMPLE_FISHEYE": ("fisheye", 1, 0),
    "FISHEYE": ("fisheye", 2, 0),
    "EUCM": ("eucm", 2, 2),
}


def distort(model: LensModel, coefficients: Any, x: Array, y: Array) -> tuple[Array, Array]:
    """Distorted coordinates (u, v) of rays (x, y, 1), in units of the focal lengths.

    Rays that the model cannot see come out as NaN.

    Args:
        model: One of `LensModel`.
        coefficients: In the model's order; missing ones are zero.
        x, y: float64, any shape.
    """
    c = np.zeros(12)
    c[: len(coefficients)] = coefficients
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        return _MODELS[model](x, y, c)


def _perspective(x: Array, y: Array, c: Array) -> tuple[Array, Array]:
    k1, k2, p1, p2, k3, k4, k5, k6 = c[:8]
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return u, v


def _equidistant(x: Array, y: Array) -> tuple[Array, Array]:
    """The angle from the optical axis in place of its tangent."""
    r = np.sqrt(x * x + y * y)
    share = np.where(r > TINY, np.arctan(r) / np.maximum(r, TINY), 1.0)
    return x * share, y * share


def _fisheye(x: Array, y: Array, c: Array) -> tuple[Array, Array]:
    u, v = _equidistant(x, y)
    t2 = u * u + v * v
    radial = 1 + t2 * (c[0] + t2 * (c[1] + t2 * (c[2] + t2 * c[3])))
    return u * radial, v * radial


def _fov(x: Array, y: Array, c: Array) -> tuple[Array, Array]:
    omega = c[0]
    if abs(omega) < 1e-6:  # no distortion in the limit
        return x, y
    r = np.sqrt(x * x + y * y)
    widening = 2 * np.tan(omega / 2)
    share = np.where(r > TINY, np.arctan(r * widening) / (np.maximum(r, TINY) * omega), widening / omega)
    return x * share, y * share


def _thin_prism_fisheye(x: Array, y: Array, c: Array) -> tuple[Array, Array]:
    k1, k2, p1, p2, k3, k4, s1, s2 = c[:8]
    u, v = _equidistant(x, y)
    r2 = u * u + v * v
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    du = 2 * p1 * u * v + p2 * (r2 + 2 * u * u) + s1 * r2
    dv = 2 * p2 * u * v + p1 * (r2 + 2 * v * v) + s2 * r2
    return u * radial + du, v * radial + dv


def _rad_tan_thin_prism_fisheye(x: Array, y: Array, c: Array) -> tuple[Array, Array]:
    u, v = _equidistant(x, y)
    t2 = u * u + v * v
    radial = np.ones_like(t2)
    power = np.ones_like(t2)
    for k in c[:6]:
        power = power * t2
        radial = radial + k * power
    u, v = u * radial, v * radial
    p0, p1, s0, s1, s2, s3 = c[6:12]
    r2 = u * u + v * v
    du = (2 * u * u + r2) * p0 + 2 * u * v * p1 + (s0 + s1 * r2) * r2
    dv = (2 * v * v + r2) * p1 + 2 * u * v * p0 + (s2 + s3 * r2) * r2
    return u + du, v + dv


def _division(x: Array, y: Array, c: Array) -> tuple[Array, Array]:
    root = np.sqrt(1 - 4 * c[0] * (x * x + y * y))
    return 2 * x / (1 + root), 2 * y / (1 + root)


def _eucm(x: Array, y: Array, c: Array) -> tuple[Array, Array]:
    alpha, beta = c[:2]
    depth = alpha * np.sqrt(beta * (x * x + y * y) + 1) + 1 - alpha
    depth = np.where(depth > TINY, depth, np.nan)
    return x / depth, y / depth


_MODELS: dict[str, Callable[[Array, Array, Array], tuple[Array, Array]]] = {
    "perspective": _perspective,
    "fisheye": _fisheye,
    "fov": _fov,
    "thin_prism_fisheye": _thin_prism_fisheye,
    "rad_tan_thin_prism_fisheye": _rad_tan_thin_prism_fisheye,
    "division": _division,
    "eucm": _eucm,
}
assert set(_MODELS) == set(get_args(LensModel))
