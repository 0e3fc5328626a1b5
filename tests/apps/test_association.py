"""Association against the same rules written as loops, and the sample of a mask against a sort."""

import numpy as np
import pytest

from sgwarp.apps.instances import association
from sgwarp.apps.instances.association import MaskGraph, _sample_limits, join_masks
from sgwarp.apps.instances.evidence import ViewEvidence
from sgwarp.apps.instances.settings import InstanceSettings


def join_in_loops(graph: MaskGraph, settings: InstanceSettings) -> list[list[int]]:
    """Average linkage with everything computed anew in every round: lists of masks, in the order of their first."""
    shared = {}
    for a, b, value in zip(graph.first.tolist(), graph.second.tolist(), graph.shared.tolist(), strict=True):
        shared[a, b] = shared[b, a] = value
    own = [graph.visible[mask, view] for mask, view in enumerate(graph.view_of)]
    groups = [[mask] for mask in range(len(graph.view_of))]

    def likeness(one, other):
        pairs = [(a, b) for a in one for b in other]
        overlap = sum(shared.get(pair, 0.0) for pair in pairs)
        both = sum(graph.visible[a, graph.view_of[b]] + graph.visible[b, graph.view_of[a]] for a, b in pairs)
        strongest = max(shared.get((a, b), 0.0) / min(own[a], own[b]) for a, b in pairs)
        if {graph.view_of[a] for a in one} & {graph.view_of[b] for b in other} or overlap <= 0:
            return 0.0
        if overlap / (both - overlap) < settings.least_iou or strongest < settings.least_shared:
            return 0.0
        if settings.least_cosine is not None:
            u, v = (graph.features[group].sum(axis=0) for group in (one, other))
            if u @ v / np.linalg.norm(u) / np.linalg.norm(v) < settings.least_cosine:
                return 0.0
        return overlap / (both - overlap)

    while True:
        best = []
        for one in groups:
            values = [0.0 if one is other else likeness(one, other) for other in groups]
            best.append(int(np.argmax(values)) if max(values) > 0 else -1)
        mutual = [(a, b) for a, b in enumerate(best) if a < b and best[b] == a]
        if not mutual:
            return groups
        gone = {b for _, b in mutual}
        for a, b in mutual:
            groups[a] = groups[a] + groups[b]
        groups = [group for place, group in enumerate(groups) if place not in gone]


def random_graph(seed: int, objects: int = 4, views: int = 7) -> MaskGraph:
    """Masks of objects that views show in part, with overlaps between objects and views that see one twice."""
    random = np.random.default_rng(seed)
    masks = [(view, thing) for view in range(views) for thing in range(objects) for _ in range(random.integers(0, 3))]
    view_of = np.array([view for view, _ in masks])
    visible = random.uniform(0.2, 1.0, (len(masks), views))
    visible[np.arange(len(masks)), view_of] = 1.0
    first, second, shared = [], [], []
    for a in range(len(masks)):
        for b in range(a + 1, len(masks)):
            same = masks[a][1] == masks[b][1]
            if view_of[a] != view_of[b] and random.random() < (0.9 if same else 0.3):
                first.append(a)
                second.append(b)
                limit = min(visible[a, view_of[b]], visible[b, view_of[a]])
                shared.append(limit * random.uniform(0.3, 1.0) * (1.0 if same else 0.4))
    order = random.permutation(len(first))  # the order of pairs must not matter
    features = random.normal(size=(len(masks), 3)) + 1.0
    first, second = np.array(first, np.int64)[order], np.array(second, np.int64)[order]
    return MaskGraph(first, second, np.array(shared)[order], visible, view_of, features)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("least_cosine", [None, 0.6])
def test_masks_are_joined_as_by_loops(seed, least_cosine, monkeypatch):
    """With few pairs at a time, so that every loop runs more than once."""
    monkeypatch.setattr(association, "PAIRS", 5)
    graph = random_graph(seed)
    settings = InstanceSettings(least_iou=0.25, least_shared=0.3, least_cosine=least_cosine)
    copies = [graph.shared.copy(), graph.visible.copy(), graph.features.copy()]
    groups = join_masks(graph, settings)
    wanted = join_in_loops(graph, settings)
    assert [sorted(np.flatnonzero(groups == k).tolist()) for k in range(groups.max() + 1)] == [
        sorted(group) for group in wanted
    ]
    assert 1 < len(wanted) < len(groups)
    for array, copy in zip((graph.shared, graph.visible, graph.features), copies, strict=True):
        np.testing.assert_array_equal(array, copy, "the graph stays as it was")


def test_masks_that_share_nothing_stay_alone():
    nothing = np.zeros(0, np.int64)
    graph = MaskGraph(nothing, nothing, np.zeros(0), np.ones((3, 2)), np.array([0, 0, 1]))
    assert join_masks(graph, InstanceSettings()).tolist() == [0, 1, 2]


def test_of_equally_good_partners_the_first_is_taken():
    pairs = np.array([[0, 2], [1, 2]]).T
    graph = MaskGraph(*pairs, np.array([0.9, 0.9]), np.ones((3, 2)), np.array([0, 0, 1]))
    assert join_masks(graph, InstanceSettings()).tolist() == [0, 1, 0]


@pytest.mark.parametrize("samples", [0, 1, 7, 400])
def test_the_limit_of_a_sample_is_its_largest_priority(samples):
    """Masks of 0 to 3,000 Gaussians; one holds the largest priorities alone, where a guess must fail."""
    random = np.random.default_rng(samples)
    sizes = [0, 1, 7, 8, 400, 401, 3000, 900]
    mask = np.repeat(np.arange(len(sizes)), sizes)
    chance = random.uniform(0.0, 1.0, len(mask))
    chance[mask == 7] = random.uniform(0.95, 1.0, 900)
    order = random.permutation(len(mask))
    found = _sample_limits(chance[order], mask[order], len(sizes), samples)
    for number, size in enumerate(sizes):
        ascending = np.sort(chance[mask == number])
        assert found[number] == (1.0 if size <= samples or not samples else ascending[samples - 1])


@pytest.mark.parametrize("overlapping", [True, False])
def test_pairs_of_masks_are_those_of_the_table(overlapping):
    random = np.random.default_rng(3)
    members = random.random((6, 4)) < 0.5 if overlapping else np.eye(6, 4, dtype=bool)
    gaussians, sets = random.integers(0, 9, 50).astype(np.int32), random.integers(0, 6, 50).astype(np.int16)
    view = ViewEvidence("v", gaussians, sets, random.random(50, np.float32), members, np.full(4, -1), ())
    wanted = random.random(9) < 0.5
    for masks in (np.arange(4), np.array([2, 0]), np.zeros(0, np.int64)):
        for rows in (None, wanted):
            loop = [
                (g, place, w)
                for g, s, w in zip(gaussians.tolist(), sets.tolist(), view.weights.tolist(), strict=True)
                for place, mask in enumerate(masks)
                if members[s, mask] and (rows is None or rows[g])
            ]
            found = list(zip(*(part.tolist() for part in view.mask_pairs(masks, rows)), strict=True))
            assert sorted(found) == sorted(loop)
