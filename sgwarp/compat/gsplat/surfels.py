"""gsplat's 2D Gaussians, which are not rendered here: each function says so in one line."""

from __future__ import annotations

from typing import Any, NoReturn

from sgwarp.errors import InputError

INSTEAD = (
    "2D Gaussians are not intersected with rays by sgwarp; load_gaussians reads 2DGS scenes as flat 3D Gaussians, "
    "which rasterization renders (scales[:, 2] = 0)"
)


def rasterization_2dgs(*arguments: Any, **keywords: Any) -> NoReturn:
    """Not supported.

    Raises:
        InputError: Always; it says what there is instead.
    """
    raise InputError(f"rasterization_2dgs: {INSTEAD}")


def rasterize_to_pixels_2dgs(*arguments: Any, **keywords: Any) -> NoReturn:
    """Not supported.

    Raises:
        InputError: Always; it says what there is instead.
    """
    raise InputError(f"rasterize_to_pixels_2dgs: {INSTEAD}")


def fully_fused_projection_2dgs(*arguments: Any, **keywords: Any) -> NoReturn:
    """Not supported.

    Raises:
        InputError: Always; it says what there is instead.
    """
    raise InputError(f"fully_fused_projection_2dgs: {INSTEAD}")
