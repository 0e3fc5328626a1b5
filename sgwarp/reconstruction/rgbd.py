"""Posed RGB-D views as oriented surface patches, one per pixel, in world coordinates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sgwarp.scene import Camera

Array = NDArray[Any]

WINDOWS = (1, 2, 4, 8, 16)  # half sides of the windows in which a pixel's surroundings may be uniform [pixels]
# Largest change of depth between pixels of one surface [footprints]: where three pixels are on a line (to a share of
# its slope) nearly any, else it may be a jump.
STRAIGHT, STEEPEST, STEEPEST_ALONE = 0.3, 20.0, 3.0


@dataclass(frozen=True, eq=False)
class Pixels:
    """The pixels of a view that have depth, as patches of surface in the world.

    Attributes:
        centres: Points [m], float64 [P, 3].
        right, down: How a point moves to the next column, and to the next row, on its surface [m], [P, 3].
        colours: In [0, 1], [P, 3].
        footprint: Side of a pixel at its depth, z / f [m], [P].
        uniform: Side of the uniform window around the pixel [pixels], at least 1, [P].
    """

    centres: Array
    right: Array
    down: Array
    colours: Array
    footprint: Array
    uniform: Array


def observe(camera: Camera, depth: Array, rgb: Array, planarity: float = 0.5, contrast: float = 0.12) -> Pixels:
    """Back-project a view.

    Args:
        camera: The view.
        depth: Along the optical axis [m], 0 where there is none, float32 [H, W].
        rgb: Colours in [0, 1], float32 [H, W, 3].
        planarity: A window is uniform if its points lie this close to a plane [footprints].
        contrast: A window is uniform if its colours differ by no more than this.
    """
    fx, fy, cx, cy = (float(camera.K[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    rotation = camera.world_to_camera[:3, :3].numpy()
    known = depth > 0
    focal = np.float32(np.sqrt(fx * fy))
    footprint = depth / focal
    # Inverse depth of a plane is linear in the pixel, so it has exact slopes and no second differences.
    inverse = np.divide(1.0, depth, out=np.zeros_like(depth), where=known)
    x, y = np.meshgrid((np.arange(camera.width) + 0.5 - cx) / fx, (np.arange(camera.height) + 0.5 - cy) / fy)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    right, down = (_depth_slope(inverse, depth, footprint, axis)[..., None] * rays for axis in (1, 0))
    right[..., 0] += depth / fx
    down[..., 1] += depth / fy
    uniform = _uniform_window(inverse, depth * focal, rgb, planarity, contrast)
    return Pixels(
        centres=(rays * depth[..., None])[known] @ rotation + camera.position.numpy(),
        right=right[known] @ rotation,
        down=down[known] @ rotation,
        colours=rgb[known],
        footprint=footprint[known],
        uniform=uniform[known],
    )


def _depth_slope(inverse: Array, depth: Array, footprint: Array, axis: int) -> Array:
    """Change of depth per pixel along `axis`, on the side where it is smaller: the other may be another surface."""
    after = np.diff(inverse, axis=axis)
    end = np.full_like(np.take(inverse, [0], axis), np.inf)
    after, before = np.concatenate([after, end], axis), np.concatenate([end, after], axis)
    slope = np.where(np.abs(after) < np.abs(before), after, before)
    with np.errstate(invalid="ignore"):  # both ends of a single pixel are infinite
        straight = np.abs(after - before) < STRAIGHT * np.abs(slope)
    limit = np.where(straight, STEEPEST, STEEPEST_ALONE) * footprint
    change = -depth * depth * np.where(np.isfinite(slope), slope, 0.0)
    return np.where(np.abs(change) < limit, change, 0.0)


def _uniform_window(inverse: Array, per_footprint: Array, rgb: Array, planarity: float, contrast: float) -> Array:
    """Side of the largest window around each pixel that is planar and of one colour [pixels], 1 if there is none.

    `per_footprint` turns a difference of inverse depth into one of depth in footprints: z^2 over z / f.
    """
    import cv2

    passed = inverse > 0
    side = np.ones(inverse.shape, np.float32)
    for reach in WINDOWS:
        if 2 * reach >= min(inverse.shape):
            break
        bent = np.zeros(inverse.shape, np.uint8)
        for axis in (0, 1):
            margin = [(reach, reach) if axis == k else (0, 0) for k in (0, 1)]
            padded = np.pad(inverse, margin, mode="reflect", reflect_type="odd")
            before, after = (np.take(padded, np.arange(inverse.shape[axis]) + s, axis) for s in (0, 2 * reach))
            bent |= 0.5 * per_footprint * np.abs(before - 2 * inverse + after) > planarity
        window = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
        spread = (cv2.dilate(rgb, window) - cv2.erode(rgb, window)).max(axis=2)
        passed &= (cv2.dilate(bent, window) == 0) & (spread <= contrast)
        side[passed] = 2 * reach
    return side
