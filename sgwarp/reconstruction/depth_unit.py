"""Whether depth images and poses are in one unit, measured by how well the views agree on where surfaces are.

Nothing in a depth image says what one step is: millimeters, meters, 1/6553.5 m, or the depth of a sensor beside poses
from structure from motion, whose unit is arbitrary. Points of one view lie on the surfaces that others see for one
factor alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sgwarp.reconstruction.stereo import choose_neighbors, unproject
from sgwarp.scene import Camera

Array = NDArray[Any]

LONGEST = 64  # of the small copies, width or height [pixels]
MOST_VIEWS, MOST_POINTS = 10, 250  # whose points are compared, and of each
REACH, RATIO, FINE_RATIO = 1e5, 1.08, 1.005  # of the factors that are tried, and between two of them
CLOSE = 0.04  # relative difference of depth that counts as agreement
NEARLY = 0.95  # of the best agreement, from which on a factor is as good, and a round one is meant
STAYS = 0.75  # of the best agreement, from which on depth stays as given: at huge factors parallax is lost, and what
# contradicts the views with it; depth in a wrong unit has less than 0.3
LEAST_POINTS = 200  # that fall into other views, to say anything


@dataclass(frozen=True)
class DepthUnit:
    """What depth has to be multiplied by to fit the poses.

    Attributes:
        factor: The measured one; 1 or a power of ten where that is as good.
        agreement: Share of points that other views confirm at this factor.
        as_given: The same share for depth as it was given.
    """

    factor: float
    agreement: float
    as_given: float


def shrink_depth(depth: Array, camera: Camera) -> tuple[Array, Camera]:
    """A small copy of depth [H, W] without mixing its values, and the camera that belongs to it."""
    step = max(1, math.ceil(max(depth.shape) / LONGEST))
    height, width = (max(1, size // step) for size in depth.shape)
    rows, columns = (
        (2 * np.arange(few) + 1) * size // (2 * few) for few, size in zip((height, width), depth.shape, strict=True)
    )
    return depth[rows[:, None], columns], camera.resized(height, width)


def measure_depth_unit(depths: Sequence[Array], cameras: Sequence[Camera], extent: float) -> DepthUnit | None:
    """Find the factor at which views agree best.

    Args:
        depths: Along the optical axis, 0 where there is none, small [h, w] of each camera.
        cameras: At the size of the depth.
        extent: Of the cameras [world units].

    Returns:
        None if too little of one view shows in others to say anything.
    """
    pairs = _Pairs(depths, cameras, extent)
    if len(pairs) < LEAST_POINTS:
        return None
    as_given = pairs.agreement(1.0)
    factor, most = _widest(pairs, np.exp(np.arange(-math.log(REACH), math.log(REACH), math.log(RATIO))))
    factor, fine = _widest(pairs, factor * FINE_RATIO ** np.arange(-20.0, 21.0))
    most = max(most, fine)
    for simple, least in ((1.0, STAYS), (10.0 ** round(math.log10(factor)), NEARLY)):
        if (agreement := pairs.agreement(simple)) >= least * most:
            return DepthUnit(simple, agreement, as_given)
    return DepthUnit(factor, pairs.agreement(factor), as_given)


def _widest(pairs: _Pairs, factors: Array) -> tuple[float, float]:
    """The middle of the factors around the best one that are nearly as good, and the agreement of the best.

    Little parallax, or surfaces parallel to the images, leave a range of them.
    """
    agreement = np.array([pairs.agreement(factor) for factor in factors])
    best = int(agreement.argmax())
    poor = np.flatnonzero(agreement < NEARLY * agreement[best])
    low, high = poor[poor < best].max(initial=-1) + 1, poor[poor > best].min(initial=len(factors)) - 1
    return float(np.sqrt(factors[low] * factors[high])), float(agreement[best])


class _Pairs:
    """Points of some views, to be looked at by their neighbors."""

    def __init__(self, depths: Sequence[Array], cameras: Sequence[Camera], extent: float) -> None:
        self.depths, self.cameras = depths, cameras
        neighbors = choose_neighbors(cameras, extent)
        chosen = np.unique(np.linspace(0, len(depths) - 1, min(MOST_VIEWS, len(depths))).round().astype(int))
        self.rays = {i: _rays(depths[i], cameras[i]) for i in chosen}
        self.pairs = [(i, other) for i in chosen for other in neighbors[i] if (depths[other] > 0).any()]

    def __len__(self) -> int:
        """Most points that can be compared."""
        return sum(len(self.rays[i]) for i, _ in self.pairs)

    def agreement(self, factor: float) -> float:
        """Share of the points that fall into other views, or of a tenth of all, that lie on what these see."""
        close = judged = total = 0
        for i, other in self.pairs:
            total += len(self.rays[i])
            points = factor * self.rays[i] + self.cameras[i].position.numpy()
            ratio = _ratios(points, factor, self.depths[other], self.cameras[other])
            close += int((np.abs(ratio - 1) < CLOSE).sum())
            judged += len(ratio)
        return close / max(judged, total / 10, 1)


def _rays(depth: Array, camera: Camera) -> Array:
    """From a camera to some of the points that it sees, [N, 3]."""
    rays = (unproject(camera, depth) - camera.position.numpy())[depth.reshape(-1) > 0]
    return np.asarray(rays[:: max(1, len(rays) // MOST_POINTS)])


def _ratios(points: Array, factor: float, depth: Array, camera: Camera) -> Array:
    """Depth of points [N, 3] in a view over that of the surface it sees there, where it sees one."""
    pose = camera.world_to_camera.numpy()
    seen = points @ pose[:3, :3].T + pose[:3, 3]
    seen = seen[seen[:, 2] > 0]
    pixels = seen @ camera.K.numpy().T
    x, y = (np.floor((pixels[:, axis] / pixels[:, 2]).clip(-1, 1e6)).astype(np.int64) for axis in (0, 1))
    inside = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    surface = factor * depth[y[inside], x[inside]]
    return np.asarray(seen[inside, 2][surface > 0] / surface[surface > 0])
