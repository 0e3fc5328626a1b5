"""Depth of a plane sweep made finer: windows follow the surface that was found, and steps become small.

A plane parallel to the image is right for the middle of a window only, where the surface is slanted. So neighbors are
warped by the depth map itself, moved a little nearer and farther as a whole, and where that fits best each pixel takes
the move. Single wrong pixels are taken out beforehand; smoothing more would round off edges.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sgwarp.reconstruction.stereo_agreement import difference, least, together
from sgwarp.reconstruction.stereo_smoothing import smoothed
from sgwarp.scene import Camera

Array = NDArray[Any]

STEPS = (0.012, 0.004)  # between two moves, of each pass, relative to the depth
MOVES = 3  # to either side
MEDIAN = 5  # of pixels beside each other, width


def refined(depth: Array, image: Array, camera: Camera, others: Sequence[tuple[Array, Camera]]) -> Array:
    """The depth of each pixel where its surroundings fit the neighbors best, float32 [h, w].

    Args:
        depth: To begin with, float32 [h, w].
        image: Brightness in [0, 1], float32 [h, w].
        camera: Of the image.
        others: Brightness and camera of each neighbor.
    """
    import cv2

    if not others:
        return depth
    for step in STEPS:
        surface = cv2.medianBlur(depth, MEDIAN)
        moves = 1 + step * np.arange(-MOVES, MOVES + 1)
        costs = np.full((len(others), len(moves), *depth.shape), np.inf, np.float32)
        for number, (other, its_camera) in enumerate(others):
            for place, warped in enumerate(_warped(other, its_camera, camera, surface, moves)):
                costs[number, place] = difference(image, warped)
        depth = (surface * (1 + step * least(smoothed(together(costs))))).astype(np.float32)
    return depth


def enlarged(depth: Array, size: tuple[int, int]) -> Array:
    """A depth map of another size, float32 [h, w], without its single wrong pixels."""
    import cv2

    return np.asarray(cv2.resize(cv2.medianBlur(depth, MEDIAN), size[::-1], interpolation=cv2.INTER_LINEAR))


def _warped(other: Array, its_camera: Camera, camera: Camera, surface: Array, moves: Array) -> Any:
    """What a neighbor shows of the surface at each move, below -1 where nothing."""
    import cv2

    relative = (its_camera.world_to_camera @ camera.world_to_camera.inverse()).numpy()
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    to_pixels = its_camera.K.numpy()
    turned = to_pixels @ relative[:3, :3] @ np.linalg.inv(camera.K.numpy())
    ways = (np.stack([x, y, np.ones_like(x)], axis=-1) @ turned.T * surface[..., None]).astype(np.float32)
    shift = (to_pixels @ relative[:3, 3]).astype(np.float32)
    for move in moves.astype(np.float32):
        along = ways * move + shift
        deep = np.where(along[..., 2] > 0, along[..., 2], np.float32(np.nan))
        u, v = along[..., 0] / deep - 0.5, along[..., 1] / deep - 0.5
        lost = ~((u > -1) & (u < other.shape[1]) & (v > -1) & (v < other.shape[0]))
        u[lost] = v[lost] = -10
        yield cv2.remap(other, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=-1e3)
