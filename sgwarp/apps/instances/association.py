"""Which masks of different views show the same thing: the ones that claim the same Gaussians.

With s_a(i) the share of a Gaussian's weight in its view that mask a claims, two masks of views u and v share
O = sum_i s_a(i) s_b(i) sqrt(m_u(i) m_v(i)). The mass m = w^3 / (w^2 + p^2) of a Gaussian in a view is its weight w, and
next to nothing where only a fraction of a pixel p shines through something else. What a claims of all that v shows,
V(a, v), is the same sum with s_b = 1. Masks are compared only by what both views show, in
IoU = O / (V(a, v) + V(b, u) - O), which neither occlusion nor the borders of the images lower.

Groups of masks are joined by average linkage: O and V of groups are sums over their pairs. In each round the pairs that
are each other's best partner are joined, if no view has a mask in both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sgwarp.apps.instances.evidence import ViewEvidence
from sgwarp.apps.instances.settings import InstanceSettings

BLOCK = 1024  # masks whose overlaps with all others are in memory at a time
PAIRS = 1 << 18  # pairs of groups compared at a time
FAINT = 0.01  # overlaps below this share of the smaller mask are not kept


@dataclass(frozen=True, eq=False)
class MaskGraph:
    """Masks of all views with what they share.

    Attributes:
        first, second: Pairs of masks of different views that share something, first < second, int64 [E].
        shared: O of each pair, float64 [E].
        visible: V(mask, view), float64 [M, views].
        view_of: View of each mask, int64 [M].
        features: Sum of the features of a mask's Gaussians, float64 [M, C], or None.
    """

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    shared: NDArray[np.float64]
    visible: NDArray[np.float64]
    view_of: NDArray[np.int64]
    features: NDArray[np.float64] | None = None


def priorities(count: int) -> NDArray[np.float64]:
    """A number in (0, 1] for every Gaussian that looks random and is always the same (splitmix64 of its index)."""
    with np.errstate(over="ignore"):
        z = np.arange(1, count + 1, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return ((z ^ (z >> np.uint64(31))) >> np.uint64(11)).astype(np.float64) * 2.0**-53 + 2.0**-54


def sampling_rates(views: Sequence[ViewEvidence], level: str, count: int, samples: int) -> NDArray[np.float64]:
    """How likely each Gaussian is to be looked at, float64 [N]; 0 where no mask shows it.

    Every mask keeps its `samples` Gaussians of lowest priority (Cohen and Kaplan, Summarizing data using bottom-k
    sketches, 2007). All masks share the priorities, so masks of one object keep the same Gaussians.
    """
    rates = np.zeros(count)
    chance = priorities(count)
    for view in views:
        owner, mask, _ = view.mask_pairs(view.masks_of(level))
        order = np.lexsort((chance[owner], mask))
        sorted_masks = mask[order]
        starts = np.flatnonzero(np.r_[True, sorted_masks[1:] != sorted_masks[:-1]]) if len(order) else order
        sizes = np.diff(np.r_[starts, len(order)])
        last = chance[owner[order[np.minimum(starts + samples, len(order)) - 1]]]
        limit = np.where((sizes <= samples) | (samples == 0), 1.0, last)
        np.maximum.at(rates, owner[order], np.repeat(limit, sizes))
    return rates


def build_graph(
    views: Sequence[ViewEvidence],
    level: str,
    count: int,
    settings: InstanceSettings,
    features: NDArray[np.float32] | None = None,
) -> MaskGraph:
    """Overlaps of all masks of a level, from a sample of the Gaussians.

    Args:
        views: Evidence.
        level: Of the masks.
        count: Number N of Gaussians.
        settings: `samples_per_mask` and `pixel_weight`.
        features: Of the Gaussians, [N, C], for the mean feature of each mask.
    """
    from scipy import sparse

    rates = sampling_rates(views, level, count, settings.samples_per_mask)
    rows = np.flatnonzero((priorities(count) <= rates) & (rates > 0))
    row_of = np.full(count, -1)
    row_of[rows] = np.arange(len(rows))
    scale = 1.0 / np.sqrt(rates[rows])  # a Gaussian kept with probability p stands for 1 / p of its kind
    parts: list[Any] = []  # sparse matrices: as lists of pairs they would take three times the memory
    totals: list[Any] = []
    view_of: list[int] = []
    for number, view in enumerate(views):
        weight_of = view.totals(count)[rows]
        total = np.sqrt(weight_of**3 / (weight_of**2 + settings.pixel_weight**2))
        masks = view.masks_of(level)
        owner, mask, weight = view.mask_pairs(masks)
        owner, kept = row_of[owner], row_of[owner] >= 0
        owner = owner[kept]
        claim = weight[kept] / weight_of[owner] * total[owner]
        parts.append(sparse.csc_matrix((claim * scale[owner], (owner, mask[kept])), shape=(len(rows), len(masks))))
        totals.append(sparse.csc_matrix((total * scale)[:, None]))
        view_of += [number] * len(masks)
    claims = sparse.hstack(parts, format="csc")
    parts.clear()
    visible = (claims.T @ sparse.hstack(totals, format="csc")).toarray()
    first, second, shared = _overlaps(claims, np.array(view_of, np.int64), visible)
    means = None
    if features is not None:
        means = np.asarray(claims.T @ sparse.diags(scale) @ features[rows].astype(np.float64))
    return MaskGraph(first, second, shared, visible, np.array(view_of, np.int64), means)


def _overlaps(
    claims: Any, view_of: NDArray[np.int64], visible: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Pairs of masks of different views and what they share, a block of masks at a time."""
    own = visible[np.arange(len(view_of)), view_of]
    found: list[tuple[NDArray[Any], ...]] = []
    by_mask = claims.T.tocsr()
    claims = claims.tocsr()
    for start in range(0, len(view_of), BLOCK):
        block = (by_mask[start : start + BLOCK] @ claims).tocoo()
        first, second, value = block.row.astype(np.int64) + start, block.col.astype(np.int64), block.data
        kept = (first < second) & (view_of[first] != view_of[second])
        kept &= value > FAINT * np.minimum(own[first], own[second])
        found.append((first[kept], second[kept], value[kept]))
    first, second, shared = (np.concatenate(part) for part in zip(*found, strict=True))
    return first, second, shared


def join_masks(graph: MaskGraph, settings: InstanceSettings) -> NDArray[np.int64]:
    """Group of every mask, int64 [M]; groups are numbered in the order of their first masks."""
    from scipy import sparse
    from scipy.sparse import csgraph

    groups = _Groups.single(graph)
    of_mask = np.arange(len(graph.view_of))
    while True:
        pairs = groups.partners(settings)
        if not len(pairs):
            return of_mask
        count = len(groups.counts)
        links = sparse.coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
        _, joined = csgraph.connected_components(links, directed=False)
        groups = groups.merged(joined.astype(np.int64))
        of_mask = joined[of_mask]


@dataclass(eq=False)
class _Groups:
    """Groups of masks and the pairs of them that may be joined; `likeness` is negative where it is out of date."""

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    shared: NDArray[np.float64]
    strongest: NDArray[np.float64]  # largest share of the smaller mask that two of their masks have in common
    likeness: NDArray[np.float64]
    visible: NDArray[np.float64]  # [K, views] sum of V over the masks
    counts: NDArray[np.int32]  # [K, views] masks in each view
    features: NDArray[np.float64] | None

    @classmethod
    def single(cls, graph: MaskGraph) -> _Groups:
        """Every mask on its own."""
        masks = np.arange(len(graph.view_of))
        counts = np.zeros(graph.visible.shape, np.int32)
        counts[masks, graph.view_of] = 1
        own = graph.visible[masks, graph.view_of]
        share = graph.shared / np.minimum(own[graph.first], own[graph.second])
        old = np.full(len(graph.first), -1.0)
        return cls(graph.first, graph.second, graph.shared, share, old, graph.visible, counts, graph.features)

    def partners(self, settings: InstanceSettings) -> NDArray[np.int64]:
        """Pairs of groups that are each other's best partner, [P, 2]."""
        old = np.flatnonzero(self.likeness < 0)
        for start in range(0, len(old), PAIRS):
            self._compare(old[start : start + PAIRS], settings)
        able = np.flatnonzero(self.likeness > 0)
        one = np.concatenate([self.first[able], self.second[able]])
        other = np.concatenate([self.second[able], self.first[able]])
        order = np.lexsort((other, -np.tile(self.likeness[able], 2), one))
        one, other = one[order], other[order]
        best = np.full(len(self.counts), -1)
        leads = np.r_[True, one[1:] != one[:-1]] if len(one) else np.zeros(0, bool)
        best[one[leads]] = other[leads]
        group = np.flatnonzero(best >= 0)
        mutual = group[(best[best[group]] == group) & (group < best[group])]
        return np.stack([mutual, best[mutual]], axis=1)

    def _compare(self, pairs: NDArray[np.int64], settings: InstanceSettings) -> None:
        """IoU of some pairs; 0 where they must not be joined."""
        one, other, shared = self.first[pairs], self.second[pairs], self.shared[pairs]
        both = np.einsum("ij,ij->i", self.visible[one], self.counts[other])
        both += np.einsum("ij,ij->i", self.visible[other], self.counts[one])
        iou = shared / np.maximum(both - shared, 1e-300)
        fine = (iou >= settings.least_iou) & (self.strongest[pairs] >= settings.least_shared)
        fine &= ~((self.counts[one] > 0) & (self.counts[other] > 0)).any(axis=1)
        if self.features is not None and settings.least_cosine is not None:
            unit = self.features / np.maximum(np.linalg.norm(self.features, axis=1, keepdims=True), 1e-300)
            fine &= np.einsum("ij,ij->i", unit[one], unit[other]) >= settings.least_cosine
        self.likeness[pairs] = np.where(fine, iou, 0.0)

    def merged(self, joined: NDArray[np.int64]) -> _Groups:
        """The groups after joining; `joined` says in which of the new ones each of the old is."""
        count = int(joined.max()) + 1
        changed = np.bincount(joined, minlength=count) > 1
        first, second = joined[self.first], joined[self.second]
        first, second = np.minimum(first, second), np.maximum(first, second)
        keys, place = np.unique(first * count + second, return_inverse=True)
        shared = np.bincount(place, weights=self.shared, minlength=len(keys))
        strongest, likeness = np.zeros(len(keys)), np.zeros(len(keys))
        np.maximum.at(strongest, place, self.strongest)
        likeness[place] = self.likeness  # a pair of unchanged groups stands for itself alone
        first, second = keys // count, keys % count
        likeness[changed[first] | changed[second]] = -1.0
        apart = first != second
        return _Groups(
            first=first[apart],
            second=second[apart],
            shared=shared[apart],
            strongest=strongest[apart],
            likeness=likeness[apart],
            visible=_sum_rows(self.visible, joined, count),
            counts=_sum_rows(self.counts, joined, count),
            features=None if self.features is None else _sum_rows(self.features, joined, count),
        )


def _sum_rows(values: NDArray[Any], joined: NDArray[np.int64], count: int) -> NDArray[Any]:
    total = np.zeros((count, *values.shape[1:]), values.dtype)
    np.add.at(total, joined, values)
    return total


def name_groups(views: Sequence[ViewEvidence], level: str) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    """Groups of masks with the same name, int64 [M], and those names in the order of the alphabet."""
    names = [view.names[mask] for view in views for mask in view.masks_of(level)]
    distinct = tuple(sorted(set(names)))
    place = {name: number for number, name in enumerate(distinct)}
    return np.array([place[name] for name in names], np.int64), distinct
