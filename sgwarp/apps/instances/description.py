"""The table of instances: size, place, what they are called, which of them may be one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from sgwarp.scene import Gaussians, Instance, InstanceMap

TRIMMED = 0.02  # share of the Gaussians beyond each side of the box
INSIDE = 0.5  # least share of a part's Gaussians in the instance that is its parent
ALIKE = 0.9  # least cosine of the mean features of instances that may be one


@dataclass(frozen=True, eq=False)
class GroupFacts:
    """What is known of the groups of masks behind the ids of one level.

    Attributes:
        masks, views: How many masks each was joined from, and from how many views, int64 [K].
        together: Whether some view has a mask of both, bool [K, K].
        compared: Whether they share what some view of one shows of the other, bool [K, K].
        names: Name of each; empty where its masks have none.
        name_shares: Share of the masks that bear it, [K].
    """

    masks: NDArray[np.int64]
    views: NDArray[np.int64]
    together: NDArray[np.bool_]
    compared: NDArray[np.bool_]
    names: tuple[str, ...]
    name_shares: NDArray[np.float64]


def oriented_box(
    points: NDArray[np.float64], weights: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Weighted mean [3], principal axes as columns of a rotation [3, 3], and side lengths [3] [m] of points [n, 3].

    The sides leave out the outermost 2 % of the points at either end.
    """
    mean = np.average(points, axis=0, weights=weights)
    away = points - mean
    _, axes = np.linalg.eigh((away * weights[:, None]).T @ away)
    axes = axes[:, ::-1].copy()
    axes *= np.where(axes[np.abs(axes).argmax(axis=0), np.arange(3)] < 0, -1.0, 1.0)  # eigenvectors have no sign
    if np.linalg.det(axes) < 0:
        axes[:, 2] *= -1
    low, high = np.quantile(away @ axes, [TRIMMED, 1 - TRIMMED], axis=0)
    return mean, axes, high - low


def quaternion(rotation: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """(w, x, y, z), w >= 0, of a rotation matrix [3, 3]: the eigenvector of Bar-Itzhack's matrix (2000)."""
    m = rotation
    K = np.array(
        [
            [m[0, 0] + m[1, 1] + m[2, 2], 0, 0, 0],
            [m[2, 1] - m[1, 2], m[0, 0] - m[1, 1] - m[2, 2], 0, 0],
            [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], 0],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1]],
        ]
    )
    found = np.linalg.eigh(K)[1][:, -1]  # reads the lower triangle
    found *= -1.0 if found[0] < 0 else 1.0
    w, x, y, z = (float(part) for part in found)
    return w, x, y, z


def describe(gaussians: Gaussians, found: InstanceMap, facts: Sequence[GroupFacts]) -> tuple[Instance, ...]:
    """The table with everything that follows from the Gaussians; `found.table` gives ids and levels."""
    means = gaussians.means.double().cpu().numpy()
    opacities = gaussians.opacities.double().cpu().numpy()
    ids = {level: found.instance(level).cpu().numpy() for level in found.levels}
    sure = {level: found.confidence(level).cpu().numpy() for level in found.levels}
    parents = _parents(found, ids)
    rows = []
    for level, fact in zip(found.levels, facts, strict=True):
        finite = np.isfinite(means).all(axis=1) & np.isfinite(opacities)
        own = np.where(finite, ids[level], 0)
        order = np.argsort(own, kind="stable")
        starts = np.searchsorted(own[order], np.arange(1, len(found.table) + 2))
        for place, row in enumerate(row for row in found.table if row.level == level):
            members = order[starts[row.id - 1] : starts[row.id]]
            mean, axes, sides = oriented_box(means[members], opacities[members] + 1e-6)
            rows.append(
                replace(
                    row,
                    parent=parents.get(row.id, 0),
                    gaussians=len(members),
                    masks=int(fact.masks[place]),
                    views=int(fact.views[place]),
                    confidence=float(sure[level][members].mean()),
                    centroid=tuple(mean.tolist()),
                    rotation=quaternion(axes),
                    extent=tuple(sides.tolist()),
                    label=fact.names[place],
                    label_score=float(fact.name_shares[place]),
                )
            )
    return tuple(rows)


def _parents(found: InstanceMap, ids: dict[str, NDArray[np.int64]]) -> dict[int, int]:
    """Instance of the next coarser level that holds most of each instance."""
    parents = {}
    size = len(found.table) + 1
    for fine, coarse in zip(found.levels[:-1], found.levels[1:], strict=True):
        child, parent = (np.maximum(ids[level], 0) for level in (fine, coarse))
        table = np.bincount(child * size + parent, minlength=size * size).reshape(size, size)
        for row in (row.id for row in found.table if row.level == fine):
            best = int(table[row, 1:].argmax()) + 1
            if table[row, best] >= INSIDE * table[row].sum():
                parents[row] = best
    return parents


def find_doubts(
    table: Sequence[Instance], facts: Sequence[GroupFacts], features: torch.Tensor | None
) -> list[Instance]:
    """The table with `may_be`: pairs near each other that no view shows together or lets be compared.

    Nothing speaks against the two being one object seen from two sides, and nothing but their word for it: they stay
    two. Where features are known they must agree as well.
    """
    rows = list(table)
    first = 0
    for fact in facts:
        count = len(fact.masks)
        part = rows[first : first + count]
        centers = np.array([row.centroid for row in part]).reshape(-1, 3)
        reach = np.array([np.linalg.norm(row.extent) / 2 for row in part])
        near = np.linalg.norm(centers[:, None] - centers[None], axis=2) <= reach[:, None] + reach[None]
        doubt = near & ~fact.together & ~fact.compared & ~np.eye(count, dtype=bool)
        if features is not None:
            unit = torch.nn.functional.normalize(features[first : first + count].double(), dim=1).cpu().numpy()
            doubt &= unit @ unit.T >= ALIKE
        for place in np.flatnonzero(doubt.any(axis=1)):
            others = tuple(int(other) + first + 1 for other in np.flatnonzero(doubt[place]))
            rows[first + place] = replace(part[place], may_be=others)
        first += count
    return rows
