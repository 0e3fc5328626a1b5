"""From groups of masks to Gaussians: how many views speak for each group, and what follows from it.

A Gaussian's counts n_k are those of a Dirichlet posterior. Pixels of one view are no independent observations, so a
view counts once at most: with w the Gaussian's weight in the view and p `pixel_weight` it adds w^2 / (w^2 + p^2),
divided among the groups as the weight is divided among their masks. The square keeps what shines through something else
from being counted as seen. What lies in no mask counts for "nothing", which is column 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sgwarp.apps.instances.evidence import ViewEvidence
from sgwarp.apps.instances.settings import InstanceSettings

VIEWS_AT_ONCE = 16  # views whose counts are in memory before they are added up
SURE = 0.8  # Gaussians whose best group has this share are not refined


def count_groups(
    views: Sequence[ViewEvidence], level: str, groups: NDArray[np.int64], count: int, pixel_weight: float
) -> Any:
    """Counts of every group, scipy CSR float32 [N, 1 + groups]; column 0 is nothing.

    Args:
        views: Evidence.
        level: Of the masks.
        groups: Group of every mask of the level, in the order of the views, int64 [M].
        count: Number N of Gaussians.
        pixel_weight: Weight that makes a view half an observation [pixels].
    """
    from scipy import sparse

    columns = 1 + int(groups.max(initial=-1)) + 1
    counts = sparse.csr_matrix((count, columns), dtype=np.float32)
    parts: list[Any] = []
    first = 0
    for view in views:
        masks = view.masks_of(level)
        shares = set_shares(view, masks, groups[first : first + len(masks)], columns)
        first += len(masks)
        total = view.totals(count)
        scale = total / (total**2 + pixel_weight**2)
        value = (view.weights * scale[view.gaussians]).astype(np.float32)
        rows = sparse.csr_matrix((value, (view.gaussians, view.sets)), shape=(count, shares.shape[0]))
        parts.append(rows @ shares)
        if len(parts) == VIEWS_AT_ONCE:
            counts, parts = sum(parts, counts), []
    return sum(parts, counts).tocsr()


def set_shares(view: ViewEvidence, masks: NDArray[np.int64], groups: NDArray[np.int64], columns: int) -> Any:
    """How each set of masks of a view is divided among the groups, scipy CSR [S, 1 + groups]; rows add up to 1."""
    from scipy import sparse

    members = view.members[:, masks]
    sets, mask = np.nonzero(members)
    covered = members.sum(axis=1)
    empty = np.flatnonzero(covered == 0)
    value = np.concatenate([1.0 / covered[sets], np.ones(len(empty))]).astype(np.float32)
    place = np.concatenate([1 + groups[mask], np.zeros(len(empty), np.int64)])
    return sparse.csr_matrix((value, (np.concatenate([sets, empty]), place)), shape=(len(members), columns))


def refine(counts: Any, means: NDArray[np.float32], scales: NDArray[np.float32], neighbors: int) -> Any:
    """Let the neighbors of unsure Gaussians speak: half an observation from the mean of those that lie nearby.

    A neighbor counts exp(-d^2 / (2 r^2)) with d its distance and r the larger of the two largest scales. A Gaussian
    that no view saw stays so: neighbors sharpen boundaries, they are no evidence.

    Args:
        counts: As of `count_groups`.
        means: Centers [m], float32 [N, 3].
        scales: Standard deviations [m], float32 [N, 3].
        neighbors: How many nearest ones are asked.
    """
    from scipy import sparse
    from scipy.spatial import cKDTree

    total = np.asarray(counts.sum(axis=1)).ravel()
    best = counts.max(axis=1).toarray().ravel()
    finite = np.isfinite(means).all(axis=1)
    able = np.flatnonzero((total > 0) & finite)
    unsure = able[best[able] < SURE * total[able]]
    if not len(unsure) or len(able) <= neighbors:
        return counts
    distance, place = cKDTree(means[able]).query(means[unsure], k=neighbors + 1)
    other = able[place]
    size = scales.max(axis=1)
    radius = np.maximum(size[unsure][:, None], size[other])
    weight = np.exp(-0.5 * (distance / np.maximum(radius, 1e-30)) ** 2)
    weight[other == unsure[:, None]] = 0.0
    weight = 0.5 * weight / np.maximum(weight.sum(axis=1, keepdims=True), 1.0) / total[other]
    rows = np.repeat(unsure, place.shape[1])
    mixing = sparse.csr_matrix((weight.ravel().astype(np.float32), (rows, other.ravel())), shape=(len(total),) * 2)
    return (counts + mixing @ counts).tocsr()


def best_candidates(counts: Any, keep: int) -> tuple[NDArray[np.int32], NDArray[np.float32], NDArray[np.float32]]:
    """The columns with the largest counts.

    Returns:
        columns: int32 [N, keep], -1 where there are no more.
        shares: Their shares of the whole count, float32 [N, keep].
        observations: The whole count, float32 [N].
    """
    count = counts.shape[0]
    total = np.asarray(counts.sum(axis=1), np.float32).ravel()
    row = np.repeat(np.arange(count), np.diff(counts.indptr))
    order = np.lexsort((counts.indices, -counts.data, row))
    rank = np.arange(len(order)) - counts.indptr[row[order]]
    kept = (rank < keep) & (counts.data[order] > 0)
    columns = np.full((count, keep), -1, np.int32)
    shares = np.zeros((count, keep), np.float32)
    where = row[order][kept], rank[kept]
    columns[where] = counts.indices[order][kept]
    shares[where] = counts.data[order][kept] / total[where[0]]
    return columns, shares, total


def confidence(shares: NDArray[np.float32], observations: NDArray[np.float32]) -> NDArray[np.float32]:
    """Posterior mean of the first candidate, as `InstanceMap.confidence`."""
    mean: NDArray[np.float32] = (observations * shares[:, 0] + 1.0) / (observations + 2.0)
    return mean


def drop_small(
    columns: NDArray[np.int32],
    shares: NDArray[np.float32],
    observations: NDArray[np.float32],
    groups: int,
    settings: InstanceSettings,
) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Candidates without the groups that own too few Gaussians, the others numbered from the largest on.

    Returns:
        candidates: Columns replaced by ids from 1 on, 0 for nothing, -1 for what was dropped, int32 [N, T].
        kept: Group behind each id, int64 [K].
    """
    sure = confidence(shares, observations) >= settings.least_confidence
    sizes = np.bincount(columns[sure & (columns[:, 0] > 0), 0] - 1, minlength=groups)
    kept = np.flatnonzero(sizes >= settings.least_gaussians)
    kept = kept[np.lexsort((kept, -sizes[kept]))]
    number = np.full(groups + 2, -1, np.int32)  # the last entry is for -1
    number[0] = 0
    number[kept + 1] = np.arange(1, len(kept) + 1)
    return number[columns], kept
