"""Where surfaces are, from posed photographs alone: a plane sweep (Collins 1996) over small copies of them.

Every photograph is compared with neighbors that were warped as if all they show lay on one plane parallel to its
image, for many depths of the plane. Where the windows around a pixel agree best is its depth. Depths that other
photographs contradict are dropped. No features, no network: what remains in even surfaces is a guess.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sgwarp.ops.launcher import get_threads
from sgwarp.reconstruction.stereo_agreement import UNSEEN, WINDOW, difference, least, together
from sgwarp.reconstruction.stereo_refinement import refined
from sgwarp.reconstruction.stereo_smoothing import smoothed
from sgwarp.runs.progress import Report
from sgwarp.scene import Camera

Array = NDArray[Any]

LONGEST = 160  # of the small copies, width or height [pixels]
NEAREST, FARTHEST = 0.1, 30.0  # of the planes [extent of the cameras]
RATIO = 1.055  # between the depths of two planes
RANKS = (0, 1, 2, 4, 7, 11)  # of the neighbors among those that look the same way, by distance
LEAST_BASELINE = 0.02  # of a neighbor [extent of the cameras]
LEAST_COSINE = 0.6  # between the directions of view of two neighbors
AGREE, BEYOND = 0.04, 0.12  # relative differences of depth that confirm a point, and that contradict it
LEAST_CONFIRMED = 2  # other photographs


@dataclass(frozen=True, eq=False)
class DepthMap:
    """Depth of the pixels of a small photograph.

    Attributes:
        camera: At the size of the map.
        depth: Along the optical axis [world units], float32 [h, w].
        colors: In [0, 1], float32 [h, w, 3].
        known: Pixels whose depth other photographs confirm and do not contradict, bool [h, w].
    """

    camera: Camera
    depth: Array
    colors: Array
    known: Array

    @property
    def points(self) -> Array:
        """Places of all pixels, [h * w, 3]."""
        return unproject(self.camera, self.depth)


def estimate_depth(
    images: Iterable[Array], cameras: Sequence[Camera], extent: float, progress: Report | None = None
) -> list[DepthMap]:
    """Estimate depth of photographs whose poses are known.

    Args:
        images: Colors in [0, 1], float32 [H, W, 3] of each camera; read one at a time.
        cameras: Their cameras.
        extent: Of the cameras, to which depths are relative [world units].
        progress: Called as `progress(done, total, text)`.

    Returns:
        A map per photograph, at most 160 pixels wide and high.
    """
    report = progress or (lambda done, total, text: None)
    # Room for all copies first: each one between two large images would keep the memory of those from being reused.
    small = [np.empty((*_small_size(camera), 3), np.float32) for camera in cameras]
    for copy, image in zip(small, images, strict=True):
        copy[:] = _shrink(image, copy.shape[:2])
    cameras = [camera.resized(*image.shape[:2]) for image, camera in zip(small, cameras, strict=True)]
    gray = [np.ascontiguousarray(image.mean(axis=2)) for image in small]
    neighbors = choose_neighbors(cameras, extent)
    planes = extent * np.exp(np.arange(math.log(NEAREST), math.log(FARTHEST), math.log(RATIO)))

    def depth_of(index: int) -> Array:
        others = [(gray[other], cameras[other]) for other in neighbors[index]]
        depth = _best(smoothed(_costs(gray[index], cameras[index], others, planes)), planes)
        return refined(depth, gray[index], cameras[index], others)

    depths: list[Array] = []
    with ThreadPoolExecutor(get_threads()) as pool:  # NumPy and OpenCV let go of the interpreter
        for depth in pool.map(depth_of, range(len(small))):
            report(len(depths), len(small), "comparing photographs")
            depths.append(depth)
    return [
        DepthMap(camera, depth, image, _confirmed(index, depths, cameras))
        for index, (camera, depth, image) in enumerate(zip(cameras, depths, small, strict=True))
    ]


def _small_size(camera: Camera) -> tuple[int, int]:
    """(height, width) of the copy of a photograph."""
    factor = min(1.0, LONGEST / max(camera.size))
    height, width = (max(WINDOW, round(factor * size)) for size in camera.size)
    return height, width


def _shrink(image: Array, size: tuple[int, ...]) -> Array:
    """A small copy, float32 [h, w, 3]."""
    import cv2

    return np.asarray(cv2.resize(image, size[::-1], interpolation=cv2.INTER_AREA), np.float32)


def choose_neighbors(cameras: Sequence[Camera], extent: float) -> list[list[int]]:
    """Of each camera, others that look about the same way from a little beside, near ones and farther ones."""
    places = np.stack([camera.position.numpy() for camera in cameras])
    axes = np.stack([camera.world_to_camera[2, :3].numpy() for camera in cameras])
    distances = np.linalg.norm(places[:, None] - places[None], axis=2)
    distances[(distances < LEAST_BASELINE * extent) | (axes @ axes.T < LEAST_COSINE)] = math.inf
    chosen = []
    for row in distances:
        order = np.argsort(row, kind="stable")
        able = order[np.isfinite(row[order])]
        chosen.append([int(able[rank]) for rank in RANKS if rank < len(able)])
    return chosen


def _costs(image: Array, camera: Camera, others: Sequence[tuple[Array, Camera]], planes: Array) -> Array:
    """Disagreement with the better half of the neighbors, for each plane, float32 [D, h, w]."""
    if not others:
        return np.full((len(planes), *image.shape), UNSEEN, np.float32)
    costs = np.full((len(others), len(planes), *image.shape), np.inf, np.float32)
    for number, (other, its_camera) in enumerate(others):
        for level, depth in enumerate(planes):
            warped = _warp(other, its_camera, camera, depth)
            if warped is not None:
                costs[number, level] = difference(image, warped)
    return together(costs)


def _warp(other: Array, its_camera: Camera, camera: Camera, depth: float) -> Array | None:
    """What a camera would see of its neighbor's photograph on a plane at a depth, below -1 where nothing; or None."""
    import cv2

    relative = (its_camera.world_to_camera @ camera.world_to_camera.inverse()).numpy()
    plane = relative[:3, :3] + np.outer(relative[:3, 3], (0, 0, 1 / depth))
    shift = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])  # OpenCV counts pixel centers from 0
    to_pixels = np.linalg.inv(shift) @ its_camera.K.numpy()
    homography = to_pixels @ plane @ np.linalg.inv(camera.K.numpy()) @ shift
    corners = np.array([[x, y, 1.0] for x in (0, camera.width) for y in (0, camera.height)]) @ homography[2]
    if corners.max() <= 0:
        return None
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    warped = cv2.warpPerspective(other, homography, camera.size[::-1], flags=flags, borderValue=-1e3)
    if corners.min() <= 0:  # part of the plane lies behind the neighbor
        y, x = np.mgrid[: camera.height, : camera.width]
        warped[homography[2, 0] * x + homography[2, 1] * y + homography[2, 2] <= 0] = -1e3
    return np.asarray(warped)


def _best(costs: Array, planes: Array) -> Array:
    """Depth of the least cost of each pixel, float32 [h, w]."""
    return (planes[len(planes) // 2] * RATIO ** least(costs)).astype(np.float32)


def unproject(camera: Camera, depth: Array) -> Array:
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) @ np.linalg.inv(camera.K.numpy()).T
    pose = camera.world_to_camera.numpy()
    return (rays * depth.reshape(-1, 1) - pose[:3, 3]) @ pose[:3, :3]


def _confirmed(index: int, depths: Sequence[Array], cameras: Sequence[Camera]) -> Array:
    """Which pixels of a map other maps confirm, more of them than see through the point."""
    points = unproject(cameras[index], depths[index])
    agreeing, beyond = np.zeros(len(points), np.int32), np.zeros(len(points), np.int32)
    for other, (depth, camera) in enumerate(zip(depths, cameras, strict=True)):
        if other == index:
            continue
        pose = camera.world_to_camera.numpy()
        seen = points @ pose[:3, :3].T + pose[:3, 3]
        front = np.flatnonzero(seen[:, 2] > 0)
        pixels = seen[front] @ camera.K.numpy().T
        column, row = (np.floor(pixels[:, axis] / pixels[:, 2]).astype(np.int64) for axis in (0, 1))
        inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        front, column, row = front[inside], column[inside], row[inside]
        ratio = seen[front, 2] / depth[row, column]
        agreeing[front] += np.abs(ratio - 1) < AGREE
        beyond[front] += ratio < 1 - BEYOND
    return ((agreeing >= LEAST_CONFIRMED) & (beyond <= agreeing)).reshape(depths[index].shape)
