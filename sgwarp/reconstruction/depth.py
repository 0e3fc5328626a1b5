"""A Gaussian scene from posed RGB-D views: every Gaussian matches the moments of one small patch of surface.

Each pixel is a flat parallelogram in the world, spanned by how its point moves from one pixel to the next. The
parallelograms of all views are sorted into an octree, finely where depth or colour change within few pixels and
coarsely where they do not, and those in a leaf are summed up by their mean, covariance and mean colour. That fuses
views, makes the Gaussians flat along the normal, and keeps them inside thin objects and silhouettes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sgwarp.errors import InputError
from sgwarp.reconstruction.rgbd import Pixels, observe
from sgwarp.runs.isolation import isolated
from sgwarp.runs.progress import Report
from sgwarp.scene import Gaussians, View

Array = NDArray[Any]

SH_C0 = 0.28209479177387814  # constant of SH degree 0: colour = SH_C0 c + 0.5
LEVELS = 8  # sizes of cells in which pixels are added up, each twice the one before
BITS = 20  # of a cell's index along one axis; three of them and the level make 63
MERGE_ROWS = 2_000_000  # rows that wait before those of one cell are added up
OVERLAP_DETAIL, OVERLAP_FLAT = 1.8, 2.4  # deviations of a Gaussian in those of its patch, near edges and far from any
PIXEL_BLUR = 0.6  # variance taken off for the low-pass filter of a renderer and the overlap of its pixels [pixels^2]
LEAST_SHRINK = 0.5  # of a deviation, by which PIXEL_BLUR may reduce it
FLATNESS = 0.1  # least deviation along the normal, in the largest one


@isolated
def gaussians_from_depth(
    views: Sequence[View],
    depths: Callable[[View], Any],
    images: Callable[[View], Any] | None = None,
    *,
    count: int = 200_000,
    planarity: float = 0.5,
    contrast: float = 0.12,
    opacity: float = 0.99,
    progress: Report | None = None,
) -> Gaussians:
    """Initialise a scene from posed RGB-D views.

    Views are read twice (depth) and once (image), one at a time; memory grows with the surface, not with the views.

    Args:
        views: Posed views.
        depths: Depth along the optical axis of a view [m], [H, W] of its camera; 0, negative, NaN or infinity is none.
        images: Colours of a view in [0, 1], [H, W, 3]; its photograph if None.
        count: Make no more Gaussians than this, and close to it if the pixels hold that much.
        planarity: A window is uniform if its points lie this close to a plane [pixel footprints].
        contrast: A window is uniform if its colours differ by no more than this.
        opacity: Of every Gaussian, in (0, 1].
        progress: Called as `progress(done, total, stem)` before the first view and after each.

    Returns:
        Flat Gaussians of SH degree 0; the local x axis is the normal, y and z span the surface.

    Raises:
        InputError: An argument is out of range, no view has any depth, or depth or colours do not fit a camera.
    """
    _check_arguments(views, count, planarity, contrast, opacity)
    report = progress or (lambda done, total, stem: None)
    grid = _Grid.around(views, depths)
    cells = _Cells(grid)
    report(0, len(views), "")
    for done, view in enumerate(views, start=1):
        rgb = _colours(view, images)
        cells.add(observe(view.camera, _depth(view, depths), rgb, planarity, contrast))
        report(done, len(views), view.stem)
    patches = cells.patches()
    return _gaussians(patches, _leaves_for_count(patches, grid.cell, count), opacity)


@dataclass(frozen=True)
class _Grid:
    """Cubic cells of level 0 to LEVELS - 1, of size cell * 2^level [m], from the corner `low` [m] on."""

    low: Array
    cell: float

    @classmethod
    def around(cls, views: Sequence[View], depths: Callable[[View], Any]) -> _Grid:
        """Cells as small as the finest pixels, around all points."""
        low, high, finest = np.full(3, np.inf), np.full(3, -np.inf), np.inf
        for view in views:
            depth = _depth(view, depths)
            known = depth[depth > 0]
            if not len(known):
                continue
            near, far = known.min(), known.max()
            # The corners of the frustum between the nearest and the farthest point bound the view.
            pixels = np.array([[x, y, 1.0] for x in (0, view.camera.width) for y in (0, view.camera.height)])
            rays = pixels @ torch.linalg.inv(view.camera.K).numpy().T
            corners = np.concatenate([rays * near, rays * far])
            world = corners @ view.camera.world_to_camera[:3, :3].numpy() + view.camera.position.numpy()
            low, high = np.minimum(low, world.min(axis=0)), np.maximum(high, world.max(axis=0))
            focal = float(torch.sqrt(view.camera.K[0, 0] * view.camera.K[1, 1]))
            finest = min(finest, float(np.quantile(known, 0.05)) / focal)
        if not np.isfinite(finest):
            raise InputError(f"none of the {len(views)} views has any depth; expected metres, 0 where there is none")
        return cls(low, max(finest, float((high - low).max()) / (2**BITS - 1)))

    def level(self, size: Array) -> Array:
        """Level of the smallest cells that are not smaller than `size` [m]."""
        return np.ceil(np.log2(size / self.cell)).clip(0, LEVELS - 1).astype(np.int64)


@dataclass(frozen=True, eq=False)
class _Patches:
    """Means of the pixels in a cell, by the pixels' weights, sorted by Morton code.

    Attributes:
        code: Morton code of the cell of level 0 at the mean, int64 [R].
        weight: [R].
        mean: [m], [R, 3].
        covariance: xx, xy, xz, yy, yz, zz [m^2], [R, 6].
        values: Colour, footprint [m], and log2 of the uniform window [pixels], [R, 5].
        finest: Smallest footprint, and smallest footprint times uniform window, of the pixels [m], [R, 2].
    """

    code: Array
    weight: Array
    mean: Array
    covariance: Array
    values: Array
    finest: Array


PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


class _Cells:
    """Sums over the pixels in each cell of the size of their footprint."""

    def __init__(self, grid: _Grid) -> None:
        self.grid = grid
        self.waiting: list[tuple[Array, Array, Array]] = []  # key, sums, smallest values; the first is the largest
        self.rows = 0

    def add(self, pixels: Pixels) -> None:
        """Add a view."""
        if not len(pixels.centres):  # no depth, as of the sky
            return
        cell = self.grid.cell
        level = self.grid.level(pixels.footprint)
        place = (pixels.centres - self.grid.low) / cell
        index = place.astype(np.int64).clip(0, 2**BITS - 1) >> level[:, None]
        key = level
        for axis in range(3):
            key = key << BITS | index[:, axis]
        offset = place - (index << level[:, None])
        right, down = pixels.right / cell, pixels.down / cell
        # The covariance of a parallelogram is a twelfth of its sides' squares.
        own = [(right[:, a] * right[:, b] + down[:, a] * down[:, b]) / 12 for a, b in PAIRS]
        squares = [offset[:, a] * offset[:, b] + o for (a, b), o in zip(PAIRS, own, strict=True)]
        values = [*pixels.colours.T, pixels.footprint, np.log2(pixels.uniform)]
        weight = (cell / pixels.footprint.astype(np.float64)) ** 2  # near views count most: they see sharpest
        sums = np.stack([weight, *(weight * column for column in (*offset.T, *squares, *values))])
        finest = np.stack([pixels.footprint, pixels.footprint * pixels.uniform])
        added = _add_up(key, sums, finest)
        self.waiting.append(added)
        self.rows += len(added[0])
        if self.rows > max(MERGE_ROWS, len(self.waiting[0][0])):
            self._merge()

    def _merge(self) -> None:
        self.waiting = [_add_up(*(np.concatenate(part, axis=-1) for part in zip(*self.waiting, strict=True)))]
        self.rows = 0

    def patches(self) -> _Patches:
        """The fused patches of all views; frees the sums."""
        self._merge()
        ((key, sums, finest),) = self.waiting
        self.waiting = []
        index = np.stack([key >> shift & 2**BITS - 1 for shift in (2 * BITS, BITS, 0)], axis=1)
        level = key >> 3 * BITS
        weight, means = sums[0], (sums[1:] / sums[0]).T
        offset, squares, values = means[:, :3], means[:, 3:9], means[:, 9:]
        spread = squares - np.stack([offset[:, a] * offset[:, b] for a, b in PAIRS], axis=1)
        place = (index << level[:, None]) + offset
        code = _morton(place.astype(np.int64))
        mean, covariance = self.grid.low + place * self.grid.cell, spread * self.grid.cell**2
        order = np.argsort(code)
        return _Patches(*(part[order] for part in (code, weight, mean, covariance, values, finest.T)))


def _add_up(key: Array, sums: Array, finest: Array) -> tuple[Array, Array, Array]:
    """Columns of equal keys added up, and the smallest of `finest` among them; columns are in the last axis."""
    order = np.argsort(key)
    ordered = key[order]
    starts = _changes(ordered)
    group = np.empty(len(key), dtype=np.int64)
    group[order] = np.repeat(np.arange(len(starts)), np.diff(np.r_[starts, len(key)]))
    added = np.stack([np.bincount(group, row, len(starts)) for row in sums])  # many times faster than add.reduceat
    return ordered[starts], added, np.stack([np.minimum.reduceat(row[order], starts) for row in finest])


def _morton(index: Array) -> Array:
    """Bits of the three indices in turn, so that the cell one level up is the code without its last 3 bits."""
    code = np.zeros(len(index), dtype=np.int64)
    for bit in range(BITS):
        for axis in range(3):
            code |= (index[:, axis] >> bit & 1) << (3 * bit + axis)
    return code


def _leaves_for_count(patches: _Patches, cell: float, count: int) -> Array:
    """First patch of each leaf of the finest octree that has no more than `count` leaves.

    A leaf is no larger than `coarseness` times the smallest uniform window seen in it, and than the finest pixel where
    that is larger. Coarseness is found by bisection.
    """
    fine, coarse = 2.0**-6, 2.0**BITS
    starts = _leaves(patches, cell, fine)
    if len(starts) <= count:
        return starts
    starts = _leaves(patches, cell, coarse)
    while coarse > 1.01 * fine:
        middle = np.sqrt(fine * coarse)
        tried = _leaves(patches, cell, middle)
        if len(tried) > count:
            fine = middle
            continue
        coarse, starts = middle, tried
        if len(tried) > 0.99 * count:
            break
    return starts


def _leaves(patches: _Patches, cell: float, coarseness: float) -> Array:
    """First patch of each leaf of the octree of one coarseness."""
    pixel, window = patches.finest.T
    wanted = np.log2(np.maximum(pixel, coarseness * window) / cell).astype(np.int64).clip(0, BITS)
    level = np.zeros_like(wanted)
    for tried in range(1, BITS + 1):
        starts = _changes(patches.code >> 3 * tried)
        smallest = np.minimum.reduceat(wanted, starts)
        if smallest.max() < tried:
            break
        level[np.repeat(smallest >= tried, np.diff(np.r_[starts, len(wanted)]))] = tried
    # Leaves are contiguous, so one that starts here differs from its neighbour at its own level.
    before = np.r_[-1, patches.code[:-1]]
    return np.flatnonzero(patches.code >> 3 * level != before >> 3 * level)


def _changes(values: Array) -> Array:
    return np.flatnonzero(np.r_[True, values[1:] != values[:-1]])


def _gaussians(patches: _Patches, starts: Array, opacity: float) -> Gaussians:
    """One Gaussian per leaf, of the moments of its patches, and wide enough to leave no gap to the next."""
    mean, covariance, values = _moments(patches, starts)
    matrices = np.empty((len(starts), 3, 3))
    for column, (a, b) in enumerate(PAIRS):
        matrices[:, a, b] = matrices[:, b, a] = covariance[:, column]
    variances, axes = np.linalg.eigh(matrices)  # the smallest first: the normal
    axes[np.linalg.det(axes) < 0, :, 0] *= -1
    rgb, footprint, log_uniform = values[:, None, :3], values[:, 3:4], values[:, 4:5]
    # Overlap hides gaps in even surfaces; near edges it would smear what is in front over what is behind.
    overlap = OVERLAP_DETAIL + (OVERLAP_FLAT - OVERLAP_DETAIL) * ((log_uniform - 0.5) / 2).clip(0, 1)
    wide = overlap**2 * variances.clip(min=0)
    variances = np.maximum(wide - PIXEL_BLUR * footprint**2, LEAST_SHRINK**2 * wide)
    variances = np.maximum(variances, FLATNESS**2 * variances[:, 2:])
    fields = mean, _quaternions(axes), np.sqrt(variances), np.full(len(mean), opacity), (rgb - 0.5) / SH_C0
    return Gaussians(*(torch.from_numpy(field.astype(np.float32)) for field in fields))


def _moments(patches: _Patches, starts: Array) -> tuple[Array, Array, Array]:
    """Mean, covariance (law of total covariance) and values of each leaf."""
    leaf = np.repeat(np.arange(len(starts)), np.diff(np.r_[starts, len(patches.code)]))
    weight = np.bincount(leaf, patches.weight)

    def average(columns: Array) -> Array:
        return np.stack([np.bincount(leaf, patches.weight * c) / weight for c in columns.T], axis=1)

    mean = average(patches.mean)
    apart = patches.mean - mean[leaf]
    between = np.stack([apart[:, a] * apart[:, b] for a, b in PAIRS], axis=1)
    return mean, average(patches.covariance + between), average(patches.values)


def _quaternions(rotations: Array) -> Array:
    """Unit quaternions (w, x, y, z) of rotation matrices, [N, 4] of [N, 3, 3]."""
    r = rotations
    outer = np.empty((len(r), 4, 4))  # 4 q q^T; its row of the largest diagonal is the most precise multiple of q
    diagonal = np.diagonal(r, axis1=1, axis2=2)
    outer[:, 0, 0] = 1 + diagonal.sum(axis=1)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        outer[:, i + 1, i + 1] = 1 + diagonal[:, i] - diagonal[:, j] - diagonal[:, k]
        outer[:, 0, i + 1] = outer[:, i + 1, 0] = r[:, k, j] - r[:, j, k]
        outer[:, j + 1, k + 1] = outer[:, k + 1, j + 1] = r[:, j, k] + r[:, k, j]
    best = np.diagonal(outer, axis1=1, axis2=2).argmax(axis=1)
    rows = np.take_along_axis(outer, best[:, None, None], axis=1)[:, 0]
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def _depth(view: View, depths: Callable[[View], Any]) -> Array:
    depth = np.asarray(depths(view), dtype=np.float32)
    if depth.shape != view.camera.size:
        raise InputError(f"view {view.stem}: depth has shape {list(depth.shape)}, its camera {list(view.camera.size)}")
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0.0))


def _colours(view: View, images: Callable[[View], Any] | None) -> Array:
    rgb = np.asarray(images(view) if images is not None else view.image(), dtype=np.float32)
    if rgb.shape != (*view.camera.size, 3):
        raise InputError(f"view {view.stem}: colours have shape {list(rgb.shape)}, its camera {list(view.camera.size)}")
    if not np.isfinite(rgb).all():
        raise InputError(f"view {view.stem}: colours hold NaN or infinity")
    return rgb


def _check_arguments(views: Sequence[View], count: int, planarity: float, contrast: float, opacity: float) -> None:
    if not views:
        raise InputError("there are no views to make Gaussians from")
    if count < 1:
        raise InputError(f"count: expected at least one Gaussian, got {count}")
    if not (planarity > 0 and contrast > 0):
        raise InputError(f"planarity and contrast must be positive, got {planarity} and {contrast}")
    if not 0 < opacity <= 1:
        raise InputError(f"opacity: expected a value in (0, 1], got {opacity}")
