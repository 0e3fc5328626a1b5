"""Colors of points and Gaussians in whatever numbers a file holds them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

RGB_NAMES = (
    ("red", "green", "blue"),
    ("r", "g", "b"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
)
TOPS = (1.0, 255.0, 65535.0)  # what white is, in the ranges that tools write


def rgb_names(names: Any) -> tuple[str, str, str] | None:
    """The three columns of a file that hold colors, in whatever letter case, or None."""
    folded = {str(name).lower(): str(name) for name in reversed(list(names))}
    for red, green, blue in RGB_NAMES:
        if red in folded and green in folded and blue in folded:
            return folded[red], folded[green], folded[blue]
    return None


def unit_colors(values: NDArray[Any]) -> NDArray[np.float32]:
    """Colors in [0, 1], float32, from numbers of any type and range.

    Bytes reach 255. Other numbers reach 1, 255 or 65535, whichever is the first that none exceeds; whole numbers of
    more than 8 bits never mean 1. What is negative becomes black. Only finite numbers decide.

    Args:
        values: Colors as the file has them, any shape.
    """
    wide = values.astype(np.float64)
    if values.dtype == np.uint8:
        top = 255.0
    else:
        finite = wide[np.isfinite(wide)]
        most = float(finite.max()) if len(finite) else 0.0
        tops = TOPS if values.dtype.kind == "f" else TOPS[1:]
        top = next((top for top in tops if most <= top), most)
    return (wide / top).clip(0, None).astype(np.float32)
