"""Where surfaces are, from posed photographs alone: a plane sweep (Collins 1996) over small copies of them.

Every photograph is compared with neighbors that were warped as if all they show lay on one plane parallel to its
image, for many depths of the plane. Where the windows around a pixel agree best is its depth. On larger copies it is
then made finer, averaged over the photographs that agree, and dropped where others contradict it. No features, no
network: what remains in even surfaces is a guess.
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
from sgwarp.reconstruction.stereo_refinement import enlarged, refined
from sgwarp.reconstruction.stereo_smoothing import smoothed
from sgwarp.runs.progress import Report
from sgwarp.scene import Camera

Array = NDArray[Any]

LONGEST = 160  # of the copies that planes are compared on, width or height [pixels]
FINE = 320  # of those on which depth is made finer
FINE_PIXELS = 8_000_000  # of all fine copies: they become smaller where photographs are many
NEAREST, FARTHEST = 0.1, 30.0  # of the planes [extent of the cameras]
RATIO = 1.055  # between the depths of two planes
RANKS = (0, 1, 2, 4, 7, 11)  # of the neighbors among those that look the same way, by distance
LEAST_BASELINE = 0.02  # of a neighbor [extent of the cameras]
LEAST_COSINE = 0.6  # between the directions of view of two neighbors
AGREE, BEYOND = 0.04, 0.12  # relative differences of depth that confirm a point, and that contradict it
LEAST_CONFIRMED = 2  # other photographs
NEAR_JUDGES, FAR_JUDGES = 32, 16  # photographs that may confirm or contradict: the nearest, and some of the others


@dataclass(frozen=True, eq=False)
class DepthMap:
    """Depth of the pixels of a small photograph.

    Attributes:
        camera: At the size of the map.
        depth: Along the optical axis, the mean of the photographs that agree [world units], float32 [h, w].
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
        A map per photograph, at most 320 pixels wide and high, and at most 160 if there are hundreds.
    """
    report = progress or (lambda done, total, text: None)
    swept = [_small_size(camera, LONGEST) for camera in cameras]
    sizes = [_small_size(camera, _fine_length(cameras)) for camera in cameras]
    # Room for all copies first: each one between two large images would keep the memory of those from being reused.
    colors = [np.empty((*size, 3), np.float32) for size in sizes]
    coarse = [np.empty(size, np.float32) for size in swept]
    for small, gray, image in zip(colors, coarse, images, strict=True):
        small[:] = _shrink(image, small.shape[:2])
        gray[:] = _shrink(image, gray.shape).mean(axis=2)
    fine = [image.mean(axis=2) for image in colors]
    coarse_cameras = [camera.resized(*size) for camera, size in zip(cameras, swept, strict=True)]
    cameras = [camera.resized(*size) for camera, size in zip(cameras, sizes, strict=True)]
    neighbors = choose_neighbors(cameras, extent)
    planes = extent * np.exp(np.arange(math.log(NEAREST), math.log(FARTHEST), math.log(RATIO)))

    def depth_of(index: int) -> Array:
        others = [(coarse[other], coarse_cameras[other]) for other in neighbors[index]]
        depth = _best(smoothed(_costs(coarse[index], coarse_cameras[index], others, planes)), planes)
        others = [(fine[other], cameras[other]) for other in neighbors[index]]
        return refined(enlarged(depth, sizes[index]), fine[index], cameras[index], others)

    depths: list[Array] = []
    with ThreadPoolExecutor(get_threads()) as pool:  # NumPy and OpenCV let go of the interpreter
        for depth in pool.map(depth_of, range(len(fine))):
            report(len(depths), len(fine), "comparing photographs")
            depths.append(depth)
        judges = _choose_judges(cameras)
        judged = list(pool.map(lambda index: _judge(index, judges[index], depths, cameras), range(len(fine))))
    return [
        DepthMap(camera, depth, image, known)
        for camera, image, (depth, known) in zip(cameras, colors, judged, strict=True)
    ]


def _fine_length(cameras: Sequence[Camera]) -> int:
    """Width or height of the fine copies, whichever is more [pixels]."""
    shape = sum(min(camera.size) / max(camera.size) for camera in cameras)
    return int(min(FINE, max(LONGEST, math.sqrt(FINE_PIXELS / max(shape, 1e-9)))))


def _small_size(camera: Camera, longest: int) -> tuple[int, int]:
    """(height, width) of the copy of a photograph."""
    factor = min(1.0, longest / max(camera.size))
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


def _choose_judges(cameras: Sequence[Camera]) -> list[Array]:
    """Of each camera, those that may confirm or contradict its depth: the nearest, and some of all the others."""
    places = np.stack([camera.position.numpy() for camera in cameras])
    chosen = []
    for index, place in enumerate(places):
        order = np.argsort(np.linalg.norm(places - place, axis=1), kind="stable")
        order = order[order != index]
        far = np.linspace(NEAR_JUDGES, len(order) - 1, FAR_JUDGES) if len(order) > NEAR_JUDGES else np.empty(0)
        chosen.append(np.concatenate([order[:NEAR_JUDGES], order[np.unique(far.astype(np.int64))]]))
    return chosen


def _judge(index: int, judges: Array, depths: Sequence[Array], cameras: Sequence[Camera]) -> tuple[Array, Array]:
    """Depth averaged over the maps that agree with a map, and the pixels that more of them confirm than see through."""
    own = depths[index].reshape(-1).astype(np.float64)
    points = unproject(cameras[index], depths[index])
    total, agreeing, beyond = own.copy(), np.zeros(len(own), np.int32), np.zeros(len(own), np.int32)
    for other in judges:
        depth, camera = depths[other], cameras[other]
        pose = camera.world_to_camera.numpy()
        seen = points @ pose[:3, :3].T + pose[:3, 3]
        front = np.flatnonzero(seen[:, 2] > 0)
        pixels = seen[front] @ camera.K.numpy().T
        column, row = (np.floor(pixels[:, axis] / pixels[:, 2]).astype(np.int64) for axis in (0, 1))
        inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        front, column, row = front[inside], column[inside], row[inside]
        ratio = seen[front, 2] / depth[row, column]
        beyond[front] += ratio < 1 - BEYOND
        near = np.abs(ratio - 1) < AGREE
        agrees = front[near]
        total[agrees] += own[agrees] / ratio[near]  # as if the surface were parallel to both images
        agreeing[agrees] += 1
    shape = depths[index].shape
    known = (agreeing >= LEAST_CONFIRMED) & (beyond <= agreeing)
    return (total / (1 + agreeing)).astype(np.float32).reshape(shape), known.reshape(shape)
