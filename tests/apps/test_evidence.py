"""Evidence, association and counts against dense float64 formulas; boxes and agreement against closed forms."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sgwarp.apps.instances import counts as counting
from sgwarp.apps.instances import evidence as evidence_module
from sgwarp.apps.instances.association import (
    MaskGraph,
    build_graph,
    join_masks,
    name_groups,
    priorities,
    sampling_rates,
)
from sgwarp.apps.instances.description import GroupFacts, _parents, find_doubts, oriented_box, quaternion
from sgwarp.apps.instances.evidence import ViewEvidence, view_evidence
from sgwarp.apps.instances.finder import mean_features
from sgwarp.apps.instances.naming import name_instances
from sgwarp.apps.instances.settings import InstanceSettings
from sgwarp.apps.instances.view_agreement import agreement
from sgwarp.encoders.calibration import Calibration
from sgwarp.encoders.masks.sources import ViewMasks
from sgwarp.errors import InputError
from sgwarp.ops.reference import lifting as reference
from sgwarp.ops.reference.rasterizer import rotation_matrices
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.scene import Instance, InstanceMap, Semantics, View

EXACT = InstanceSettings(samples_per_mask=0)


def random_masks(camera, count, seed) -> torch.Tensor:
    """Overlapping rectangles."""
    random = np.random.default_rng(seed)
    masks = torch.zeros(count, *camera.size, dtype=torch.bool)
    for mask in masks:
        y, x = random.integers(0, camera.height - 8), random.integers(0, camera.width - 8)
        mask[y : y + random.integers(4, 30), x : x + random.integers(4, 40)] = True
    return masks


@pytest.fixture(scope="module")
def seen(stage):
    """Evidence of three views with overlapping masks, and the dense weights behind it, float64 [N, M] and [N]."""
    evidence, dense = [], []
    for number, view in enumerate(stage.views[:3]):
        masks = random_masks(view.camera, 5 + number, number)
        found = ViewMasks.without_empty(masks, torch.full((len(masks),), -1))
        evidence.append(view_evidence(stage.gaussians, view, found, RasterSettings()))
        one = reference.lift_weighted(stage.gaussians, view.camera, masks.permute(1, 2, 0).double())
        dense.append((one.features.numpy(), one.weight.numpy()))
    return evidence, dense


@pytest.mark.slow
def test_evidence_is_the_transpose_of_the_renderer(stage, seen):
    for view, (weights, total) in zip(*seen, strict=True):
        owner, mask, weight = view.mask_pairs(view.masks_of("default"))
        found = np.zeros_like(weights)
        np.add.at(found, (owner, mask), weight)
        np.testing.assert_allclose(found, weights, rtol=1e-4, atol=2e-5 * weights.max())
        np.testing.assert_allclose(view.totals(len(stage.gaussians)), total, rtol=1e-4, atol=2e-5 * total.max())
        assert view.nbytes == 10 * len(view.gaussians)


def dense_overlaps(dense) -> tuple[np.ndarray, np.ndarray]:
    """O between all masks and V of all masks in all views, written out."""
    mass = [total**3 / (total**2 + 1.0) for _, total in dense]
    shares = [weights / np.maximum(total, 1e-300)[:, None] for weights, total in dense]
    blocks = [
        [np.einsum("ia,ib,i->ab", s, t, np.sqrt(m * n)) for t, n in zip(shares, mass, strict=True)]
        for s, m in zip(shares, mass, strict=True)
    ]
    visible = [[np.einsum("ia,i->a", s, np.sqrt(m * n)) for n in mass] for s, m in zip(shares, mass, strict=True)]
    return np.block(blocks), np.block([[np.stack(row, axis=1)] for row in visible])


def test_overlaps_are_those_of_the_formula(stage, seen):
    evidence, dense = seen
    graph = build_graph(evidence, "default", len(stage.gaussians), EXACT)
    shared, visible = dense_overlaps(dense)
    np.testing.assert_allclose(graph.visible, visible, rtol=1e-3, atol=1e-4 * visible.max())
    found = np.zeros_like(shared)
    found[graph.first, graph.second] = graph.shared
    own = visible[np.arange(len(shared)), graph.view_of]
    wanted = np.triu(shared, 1) * (graph.view_of[:, None] != graph.view_of)
    faint = wanted <= 0.0101 * np.minimum(own[:, None], own)
    np.testing.assert_allclose(found[~faint], wanted[~faint], rtol=1e-3)
    assert bool((found[wanted < 0.0099 * np.minimum(own[:, None], own)] == 0).all())


def test_the_first_gaussian_counts_like_any_other():
    """Two masks that hold Gaussian 0 alone share all of its mass: w^3 / (w^2 + 1) for two views of weight w."""
    views = [hand_made([0], [0], [2.0], [[1], [0]], ["a"]), hand_made([0], [0], [2.0], [[1], [0]], ["b"])]
    graph = build_graph(views, "default", 1, EXACT)
    assert (graph.first.tolist(), graph.second.tolist()) == ([0], [1])
    np.testing.assert_allclose(graph.shared, [8 / 5])


def test_a_sample_estimates_the_overlaps(stage, seen):
    """Each Gaussian is kept with a probability p and stands for 1 / p: the variance is sum x^2 (1 - p) / p."""
    evidence, dense = seen
    count = len(stage.gaussians)
    whole = build_graph(evidence, "default", count, EXACT)
    part = build_graph(evidence, "default", count, InstanceSettings(samples_per_mask=200))
    rates = sampling_rates(evidence, "default", count, 200)
    assert int((rates < 1).sum()) > count / 4
    mass = [total**3 / (total**2 + 1.0) for _, total in dense]
    kept = rates > 0
    unkept = ((1 - rates[kept]) / rates[kept])[:, None]
    rows = []
    for (weights, total), own in zip(dense, mass, strict=True):
        claims = weights / np.maximum(total, 1e-300)[:, None] * np.sqrt(own)[:, None]
        rows.append(np.sqrt(np.stack([(claims[kept] ** 2 * other[kept, None] * unkept).sum(0) for other in mass], 1)))
    deviation = np.concatenate(rows)
    off = np.abs(part.visible - whole.visible) / np.maximum(deviation, 1e-6 * whole.visible.max())
    assert off.max() < 4.5
    assert 0.2 < np.sqrt((off[deviation > 0] ** 2).mean()) < 1.6


def test_priorities_are_fixed_and_spread_evenly():
    found = priorities(100_000)
    assert 0 < found.min() < found.max() <= 1
    np.testing.assert_allclose(np.histogram(found, bins=10, range=(0, 1))[0], 10_000, rtol=0.05)
    np.testing.assert_array_equal(priorities(10), found[:10])


def graph_of(overlaps: dict[tuple[int, int], float], view_of: list[int]) -> MaskGraph:
    """Masks of mass 1, all of which every view shows whole."""
    first, second = (np.array(side, np.int64) for side in zip(*overlaps, strict=True))
    views = max(view_of) + 1
    return MaskGraph(
        first, second, np.array(list(overlaps.values())), np.ones((len(view_of), views)), np.array(view_of, np.int64)
    )


def test_best_partners_are_joined_first():
    """Mask 2 fits 1 better than 0, which is of the view of 1: 0 stays alone."""
    graph = graph_of({(0, 2): 0.7, (1, 2): 0.9}, [0, 0, 1])
    assert join_masks(graph, EXACT).tolist() == [0, 1, 1]


def test_iou_and_shared_mass_are_thresholds():
    """O = 0.4 of masks of mass 1 is an IoU of 0.4 / 1.6."""
    graph = graph_of({(0, 1): 0.4}, [0, 1])
    assert len(set(join_masks(graph, InstanceSettings(least_iou=0.24)).tolist())) == 1
    assert len(set(join_masks(graph, InstanceSettings(least_iou=0.26)).tolist())) == 2
    faint = MaskGraph(
        np.array([0]), np.array([1]), np.array([0.05]), np.array([[1.0, 0.05], [0.05, 1.0]]), np.array([0, 1])
    )
    assert len(set(join_masks(faint, InstanceSettings(least_shared=0.04)).tolist())) == 1
    assert len(set(join_masks(faint, InstanceSettings(least_shared=0.06)).tolist())) == 2


@pytest.mark.parametrize("order", [1, -1])
def test_what_is_shared_is_a_share_of_the_smaller_mask(order):
    """0.3 of masks of mass 1 and 3, of which each view shows 0.4 of the other: IoU 0.6, share 0.3 and not 0.1."""
    visible = np.array([[1.0, 0.4], [0.4, 3.0]])[::order, ::order]
    graph = MaskGraph(np.array([0]), np.array([1]), np.array([0.3]), visible, np.array([0, 1]))
    for least, groups in ((0.29, 1), (0.31, 2)):
        found = join_masks(graph, InstanceSettings(least_shared=least))
        assert len(set(found.tolist())) == groups


def test_features_can_forbid():
    graph = graph_of({(0, 1): 0.9}, [0, 1])
    other = MaskGraph(graph.first, graph.second, graph.shared, graph.visible, graph.view_of, np.eye(2))
    assert len(set(join_masks(other, InstanceSettings(least_cosine=0.5)).tolist())) == 2
    assert len(set(join_masks(other, InstanceSettings()).tolist())) == 1


def test_no_group_has_two_masks_of_a_view():
    random = np.random.default_rng(0)
    view_of = np.sort(random.integers(0, 12, 60))
    pairs = [(a, b) for a in range(60) for b in range(a + 1, 60) if view_of[a] != view_of[b]]
    graph = graph_of(dict(zip(pairs, random.random(len(pairs)), strict=True)), view_of.tolist())
    groups = join_masks(graph, InstanceSettings(least_iou=0.1, least_shared=0.0))
    keys = groups * 100 + view_of
    assert len(np.unique(keys)) == 60
    assert len(np.unique(groups)) < 30


def hand_made(gaussians, sets, weights, members, names=()) -> ViewEvidence:
    return ViewEvidence(
        "v",
        np.array(gaussians, np.int32),
        np.array(sets, np.int16),
        np.array(weights, np.float32),
        np.array(members, bool),
        np.full(len(members[0]), -1),
        tuple(names),
    )


def test_counts_by_hand():
    """Gaussian 0: 2 px of mask A, 1 px of A and B, so 9 / (9 + 1) views; 1: 1 px of no mask, 1 / (1 + 1) views."""
    view = hand_made([0, 0, 1], [0, 1, 2], [2.0, 1.0, 1.0], [[1, 0], [1, 1], [0, 0]])
    found = counting.count_groups([view], "default", np.array([0, 1]), 2, 1.0).toarray()
    np.testing.assert_allclose(found, [[0.0, 0.9 * 2.5 / 3, 0.9 * 0.5 / 3], [0.5, 0.0, 0.0]], rtol=1e-6)


def test_candidates_are_sorted_and_filled_up():
    from scipy import sparse

    counts = sparse.csr_matrix(np.array([[0.0, 1.0, 3.0], [0, 0, 0], [2.0, 2.0, 0.0]], np.float32))
    columns, shares, total = counting.best_candidates(counts, 2)
    assert columns.tolist() == [[2, 1], [-1, -1], [0, 1]]
    np.testing.assert_allclose(shares, [[0.75, 0.25], [0, 0], [0.5, 0.5]])
    assert total.tolist() == [4.0, 0.0, 4.0]


def test_neighbors_speak_for_the_unsure_alone():
    """Gaussian 1 is torn between two groups, its neighbors belong to the first; the fourth was never seen."""
    from scipy import sparse

    counts = sparse.csr_matrix(np.array([[0, 4.0, 0], [0, 1.0, 1.0], [0, 4.0, 0], [0, 0, 0]], np.float32))
    means = np.array([[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0], [0.1, 0.1, 0]], np.float32)
    found = counting.refine(counts, means, np.full((4, 3), 0.5, np.float32), 2).toarray()
    np.testing.assert_array_equal(found[[0, 2, 3]], counts.toarray()[[0, 2, 3]])
    weight = np.exp(-0.5 * (0.1 / 0.5) ** 2)
    np.testing.assert_allclose(found[1], [0, 1.0 + 0.5 * min(1.0, 2 * weight), 1.0], rtol=1e-5)


def test_small_groups_are_dropped_and_the_others_numbered_by_size():
    columns = np.array([[2], [2], [2], [1], [3], [3], [0], [-1]], np.int32)
    shares, observations = np.ones((8, 1), np.float32), np.full(8, 9.0, np.float32)
    found, kept = counting.drop_small(columns, shares, observations, 3, InstanceSettings(least_gaussians=2))
    assert kept.tolist() == [1, 2]
    assert found[:, 0].tolist() == [1, 1, 1, -1, 2, 2, 0, -1]


@pytest.mark.parametrize("quat", [(1.0, 0, 0, 0), (0.8, 0.1, -0.5, 0.3), (0.1, -0.7, 0.7, 0.05)])
def test_an_oriented_box_is_that_of_a_turned_cuboid(quat):
    turn = rotation_matrices(torch.tensor([quat], dtype=torch.float64))[0].numpy()
    local = np.random.default_rng(1).uniform(-1, 1, (40_000, 3)) * [3.0, 2.0, 1.0]
    mean, axes, sides = oriented_box(local @ turn.T + [5.0, -2.0, 1.0], np.ones(len(local)))
    np.testing.assert_allclose(mean, [5, -2, 1], atol=0.03)
    np.testing.assert_allclose(sides, 0.96 * 2 * np.array([3.0, 2.0, 1.0]), rtol=0.02)
    np.testing.assert_allclose(np.abs(axes.T @ turn), np.eye(3), atol=0.03)
    back = rotation_matrices(torch.tensor([quaternion(axes)], dtype=torch.float64))[0].numpy()
    np.testing.assert_allclose(back, axes, atol=1e-9)


def test_agreement_in_closed_form():
    """A Gaussian in four views, labels a, a, b, half a half b; pairs: aa 1, ab 0 (2), a-half 1/2 (2), b-half 1/2."""
    sets = [[1, 0], [0, 1], [0, 0]]
    views = [
        hand_made([0], [0], [1.0], sets),
        hand_made([0], [0], [5.0], sets),
        hand_made([0], [1], [1.0], sets),
        hand_made([0, 0], [0, 1], [2.0, 2.0], sets),
        hand_made([0, 1], [2, 0], [1.0, 1.0], sets),  # no mask here, and a Gaussian that is seen once
    ]
    labels = [np.array([0, 1])] * 5
    assert agreement(views, labels, 2) == pytest.approx((1 + 0.5 + 0.5 + 0.5) / 6)
    assert np.isnan(agreement(views[:1], labels[:1], 2))


def test_groups_by_name():
    views = [hand_made([0], [0], [1.0], [[1, 0]], ["leg", "arm"]), hand_made([0], [0], [1.0], [[1]], ["arm"])]
    groups, names = name_groups(views, "default")
    assert groups.tolist() == [1, 0, 0]
    assert names == ("arm", "leg")


def test_view_evidence_is_small(stage):
    """An id more costs nothing: only what is shown is stored."""
    view: View = stage.views[0]
    labels = stage.labels(view)
    many = torch.stack([(labels == k % 5) & (torch.arange(labels.shape[1]) % 60 == k // 5) for k in range(300)])
    found = ViewMasks.without_empty(many, torch.full((300,), -1))
    evidence = view_evidence(stage.gaussians, view, found, RasterSettings())
    assert len(evidence.gaussians) < 12 * len(stage.gaussians) < 300 * len(stage.gaussians)


def test_masks_overlap_in_so_many_ways_and_no_more(stage, monkeypatch):
    """Two masks that overlap cut a view into three sets: the first alone, the second alone, both."""
    view: View = stage.views[0]
    masks = torch.zeros(2, *view.camera.size, dtype=torch.bool)
    masks[0, :, :40], masks[1, :, 20:] = True, True
    found = ViewMasks(masks, torch.full((2,), -1))
    monkeypatch.setattr(evidence_module, "MAX_SETS", 3)
    assert len(view_evidence(stage.gaussians, view, found, RasterSettings()).members) == 4  # one holds no mask
    monkeypatch.setattr(evidence_module, "MAX_SETS", 2)
    with pytest.raises(InputError, match="overlap in 3 ways, at most 2"):
        view_evidence(stage.gaussians, view, found, RasterSettings())


@pytest.mark.parametrize(("angle", "doubted"), [(0.0, True), (0.4, True), (0.5, False), (3.0, False)])
def test_instances_that_may_be_one_look_alike(angle, doubted):
    """Two side by side that no view compares, their features at an angle: cos 0.4 = 0.92, cos 0.5 = 0.88."""
    table = [
        Instance(k, "default", 0, 9, 1, 1, 1.0, (float(k), 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
        for k in (1, 2)
    ]
    once, no = np.ones(2, np.int64), np.zeros((2, 2), bool)
    facts = [GroupFacts(once, once, no, no, ("", ""), np.ones(2))]
    features = torch.tensor([[1.0, 0.0], [math.cos(angle), math.sin(angle)]])
    found = find_doubts(table, facts, features)
    assert [row.may_be for row in found] == ([(2,), (1,)] if doubted else [(), ()])
    assert [row.may_be for row in find_doubts(table, facts, None)] == [(2,), (1,)]


@pytest.mark.parametrize(("inside", "parent"), [(10, 2), (6, 2), (5, 2), (4, 0), (0, 0)])
def test_a_part_belongs_to_the_object_that_holds_half_of_it(inside, parent):
    """Of ten Gaussians of part 1 some are in object 2, the others in none."""
    zero = (0.0, 0.0, 0.0)
    table = tuple(
        Instance(k, level, 0, 9, 1, 1, 1.0, zero, (1.0, 0.0, 0.0, 0.0), zero) for k, level in ((1, "s"), (2, "l"))
    )
    ids = {"s": np.ones(10, np.int64), "l": np.where(np.arange(10) < inside, 2, -1)}
    assert _parents(SimpleNamespace(levels=("s", "l"), table=table), ids).get(1, 0) == parent


def test_mean_features_are_weighted_with_the_confidence():
    """Nine votes of nine make 10/11, one of one 2/3; a Gaussian that nothing lifted does not count."""
    zero = (0.0, 0.0, 0.0)
    table = (Instance(1, "default", 0, 3, 1, 1, 1.0, zero, (1.0, 0.0, 0.0, 0.0), zero),)
    ids = torch.ones(1, 3, 1, dtype=torch.int32)
    found = InstanceMap(ids, torch.ones(1, 3, 1), torch.tensor([9.0, 1.0, 9.0]), table, ("default",), "x")
    weight = torch.tensor([1.0, 1.0, 0.0])
    semantics = Semantics(torch.eye(3), weight, weight, "toy", "x")
    total = 10 / 11 + 2 / 3
    mean = torch.tensor([[10 / 11 / total, 2 / 3 / total, 0.0]])
    torch.testing.assert_close(mean_features(found, semantics), mean)


def test_doubts_look_at_the_features_of_their_own_level():
    """Two parts that look alike, and two wholes that do not; nothing was compared."""
    place = [(1, "s"), (2, "s"), (3, "l"), (4, "l")]
    table = [
        Instance(k, level, 0, 9, 1, 1, 1.0, (0.1 * k, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
        for k, level in place
    ]
    once, no = np.ones(2, np.int64), np.zeros((2, 2), bool)
    facts = [GroupFacts(once, once, no, no, ("", ""), np.ones(2))] * 2
    alike, apart = torch.tensor([[1.0, 0.0], [1.0, 0.1]]), torch.eye(2)
    for features, may_be in (((alike, apart), [(2,), (1,), (), ()]), ((apart, alike), [(), (), (4,), (3,)])):
        assert [row.may_be for row in find_doubts(table, facts, torch.cat(features))] == may_be


@pytest.mark.parametrize("scoring", ["cosine", "relevancy", "evidence"])
def test_an_instance_that_no_view_showed_has_no_name(scoring):
    """It has no feature: its cosine with every class is the same, and says nothing."""
    zero = (0.0, 0.0, 0.0)
    table = tuple(
        Instance(k, "default", 0, 9, 1, 1, 1.0, zero, (1.0, 0.0, 0.0, 0.0), zero, label="kept") for k in (1, 2, 3)
    )
    ids = torch.ones(1, 4, 1, dtype=torch.int32)
    features = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    found = InstanceMap(ids, torch.ones(1, 4, 1), torch.ones(4), table, ("default",), "x", 0.5, features, "toy")

    class Axes:
        space, calibration = "toy", Calibration(scoring, 0.1, level=0.1)

        def encode_text(self, texts):
            return torch.stack([torch.eye(3)[{"a": 0, "b": 1}.get(text, 2)] for text in texts])

    named = name_instances(found, ["a", "b"], Axes()).table
    assert [row.label for row in named] == ["a", "kept", "b"]
    assert [row.label_score > 0.5 for row in named] == [True, False, True]
