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
SPARE = 0.25  # share of dropped pairs from which on the others are moved together
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
        masks = view.masks_of(level)
        owner, mask, _ = view.mask_pairs(masks)
        np.maximum.at(rates, owner, _sample_limits(chance[owner], mask, len(masks), samples)[mask])
    return rates


def _sample_limits(
    chance: NDArray[np.float64], mask: NDArray[np.int64], count: int, samples: int
) -> NDArray[np.float64]:
    """Largest priority in the sample of each mask, float64 [count]; 1 where the sample is the whole mask.

    Args:
        chance: Priority of each pair of a Gaussian and a mask.
        mask: Mask of each pair.
        count: Number of masks.
        samples: Size of a sample; 0 for the whole mask.
    """
    sizes = np.bincount(mask, minlength=count)
    limits = np.ones(count)
    sampled = (sizes > samples) & (samples > 0)
    if not sampled.any():
        return limits
    # Priorities are uniform, so the wanted one is near samples / size: only pairs below a generous guess are sorted.
    guess = np.where(sampled, (samples + 8 * samples**0.5) / np.maximum(sizes, 1), -1.0)
    low = chance <= guess[mask]
    guess[sampled & (np.bincount(mask[low], minlength=count) < samples)] = 1.0
    wanted = np.flatnonzero(chance <= guess[mask])
    order = wanted[np.lexsort((chance[wanted], mask[wanted]))]
    starts = np.searchsorted(mask[order], np.flatnonzero(sampled))
    limits[sampled] = chance[order[starts + samples - 1]]
    return limits


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
    row_of = np.full(count, -1, np.int32)
    row_of[rows] = np.arange(len(rows), dtype=np.int32)
    scale = 1.0 / np.sqrt(rates[rows])  # a Gaussian kept with probability p stands for 1 / p of its kind
    parts: list[Any] = []  # sparse matrices: as lists of pairs they would take three times the memory
    totals: list[Any] = []
    view_of: list[int] = []
    for number, view in enumerate(views):
        weight_of = view.totals(count)[rows]
        total = np.sqrt(weight_of**3 / (weight_of**2 + settings.pixel_weight**2))
        masks = view.masks_of(level)
        owner, mask, weight = view.mask_pairs(masks, row_of >= 0)
        owner = row_of[owner]
        claim = weight / weight_of[owner] * total[owner] * scale[owner]
        parts.append(sparse.csc_matrix((claim, (owner, mask)), shape=(len(rows), len(masks))))
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
    rest = claims.tocsr()
    for start in range(0, len(view_of), BLOCK):
        block = (by_mask[start : start + BLOCK] @ rest).tocoo()
        rest = rest[:, BLOCK:]  # each pair of masks once
        first, second, value = block.row.astype(np.int64) + start, block.col.astype(np.int64) + start, block.data
        kept = (first < second) & (view_of[first] != view_of[second])
        kept &= value > FAINT * np.minimum(own[first], own[second])
        found.append((first[kept], second[kept], value[kept]))
    first, second, shared = (np.concatenate(part) for part in zip(*found, strict=True))
    return first, second, shared


def join_masks(graph: MaskGraph, settings: InstanceSettings) -> NDArray[np.int64]:
    """Group of every mask, int64 [M]; groups are numbered in the order of their first masks."""
    groups = _Groups.single(graph, settings)
    while len(pairs := groups.partners()):
        groups.merge(pairs, settings)
    return np.unique(groups.of_mask, return_inverse=True)[1].astype(np.int64)


@dataclass(eq=False)
class _Groups:
    """Groups of masks, each in the row of its first mask, and the pairs of them that may be joined.

    A group stays in its row when another joins it, so that a round costs what it changes: the pairs of groups that were
    joined. Pairs with a view in common are dropped, for what joins them later has that view as well.
    """

    first: NDArray[np.int64]  # [E]; past the last mask where a pair was dropped, as `second`
    second: NDArray[np.int64]
    shared: NDArray[np.float64]
    strongest: NDArray[np.float64]  # largest share of the smaller mask that two of their masks have in common
    likeness: NDArray[np.float64]  # IoU; 0 where they must not be joined
    of_mask: NDArray[np.int64]  # row of each mask's group [M]
    visible: NDArray[np.float64]  # [M, views] sum of V over the masks
    members: NDArray[np.bool_]  # [M, views] whether they have a mask in the view
    features: NDArray[np.float64] | None
    dropped: int = 0

    @classmethod
    def single(cls, graph: MaskGraph, settings: InstanceSettings) -> _Groups:
        """Every mask on its own."""
        first, second, view_of = graph.first.copy(), graph.second.copy(), graph.view_of
        masks = np.arange(len(view_of))
        members = np.zeros(graph.visible.shape, bool)
        members[masks, view_of] = True
        own = graph.visible[masks, view_of]
        share = graph.shared / np.minimum(own[first], own[second])
        features = None if graph.features is None else graph.features.copy()
        blank = np.zeros(len(first))
        groups = cls(first, second, graph.shared.copy(), share, blank, masks, graph.visible.copy(), members, features)
        both = graph.visible[first, view_of[second]] + graph.visible[second, view_of[first]]
        groups._compare(np.arange(len(first)), both, settings)
        return groups

    def partners(self) -> NDArray[np.int64]:
        """Pairs of groups that are each other's best partner, [P, 2]; of equally good ones the first is the best."""
        count = len(self.of_mask)
        able = np.flatnonzero(self.likeness > 0)
        first, second, likeness = self.first[able], self.second[able], self.likeness[able]
        top = np.zeros(count)
        np.maximum.at(top, first, likeness)
        np.maximum.at(top, second, likeness)
        best = np.full(count, count)
        for one, other in ((first, second), (second, first)):
            wins = likeness == top[one]
            np.minimum.at(best, one[wins], other[wins])
        group = np.flatnonzero(best < count)
        mutual = group[(best[best[group]] == group) & (group < best[group])]
        return np.stack([mutual, best[mutual]], axis=1)

    def merge(self, pairs: NDArray[np.int64], settings: InstanceSettings) -> None:
        """Join pairs of groups; no group is in two of the pairs."""
        into, gone = pairs.T
        self.visible[into] += self.visible[gone]
        self.members[into] |= self.members[gone]
        if self.features is not None:
            self.features[into] += self.features[gone]
        count = len(self.of_mask)
        row = np.arange(count + 1)
        row[gone] = into
        self.of_mask = row[self.of_mask]
        changed = np.zeros(count + 1, bool)
        changed[pairs] = True
        touched = np.flatnonzero(changed[self.first] | changed[self.second])
        one, other = row[self.first[touched]], row[self.second[touched]]
        places = self._unite(touched, np.minimum(one, other), np.maximum(one, other))
        for start in range(0, len(places), PAIRS):
            part = places[start : start + PAIRS]
            part = part[self.strongest[part] >= settings.least_shared]  # before the costly sums
            one, other = self.first[part], self.second[part]
            both = np.einsum("ij,ij->i", self.visible[one], self.members[other])
            both += np.einsum("ij,ij->i", self.visible[other], self.members[one])
            self._compare(part, both, settings)

    def _unite(
        self, touched: NDArray[np.int64], first: NDArray[np.int64], second: NDArray[np.int64]
    ) -> NDArray[np.int64]:
        """Give pairs their new groups, and add up those that became one pair; gives the places of what is left."""
        count = len(self.of_mask)
        apart = np.flatnonzero(first != second)
        apart = apart[~(self.members[first[apart]] & self.members[second[apart]]).any(axis=1)]
        keys = first[apart] * count + second[apart]
        order = np.argsort(keys, kind="stable")
        keys, source = keys[order], touched[apart[order]]
        starts = np.flatnonzero(np.diff(keys, prepend=-1))
        places, free = touched[: len(starts)], touched[len(starts) :]
        if len(starts):
            shared, strongest = self.shared[source], self.strongest[source]
            self.shared[places] = np.add.reduceat(shared, starts)
            self.strongest[places] = np.maximum.reduceat(strongest, starts)
        self.first[places], self.second[places] = np.divmod(keys[starts], count)
        self.first[free] = self.second[free] = count
        self.likeness[touched] = 0.0
        self.dropped += len(free)
        return places if self.dropped < SPARE * len(self.first) else self._compact(places)

    def _compact(self, places: NDArray[np.int64]) -> NDArray[np.int64]:
        """Forget the pairs that were dropped; gives where the pairs at some places went."""
        alive = self.first < len(self.of_mask)
        for name in ("first", "second", "shared", "strongest", "likeness"):
            setattr(self, name, getattr(self, name)[alive])
        self.dropped = 0
        moved: NDArray[np.int64] = (np.cumsum(alive) - 1)[places]
        return moved

    def _compare(self, pairs: NDArray[np.int64], both: NDArray[np.float64], settings: InstanceSettings) -> None:
        """Set the likeness of some pairs; `both` is V of each in the views of the other, added up."""
        one, other, shared = self.first[pairs], self.second[pairs], self.shared[pairs]
        iou = shared / np.maximum(both - shared, 1e-300)
        fine = (iou >= settings.least_iou) & (self.strongest[pairs] >= settings.least_shared)
        if self.features is not None and settings.least_cosine is not None:
            unit = self.features / np.maximum(np.linalg.norm(self.features, axis=1, keepdims=True), 1e-300)
            fine[fine] = np.einsum("ij,ij->i", unit[one[fine]], unit[other[fine]]) >= settings.least_cosine
        self.likeness[pairs] = np.where(fine, iou, 0.0)


def name_groups(views: Sequence[ViewEvidence], level: str) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    """Groups of masks with the same name, int64 [M], and those names in the order of the alphabet."""
    names = [view.names[mask] for view in views for mask in view.masks_of(level)]
    distinct = tuple(sorted(set(names)))
    place = {name: number for number, name in enumerate(distinct)}
    return np.array([place[name] for name in names], np.int64), distinct
