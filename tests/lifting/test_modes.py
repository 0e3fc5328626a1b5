"""Lift modes against dense float64 linear algebra, Weiszfeld's iteration in numpy, and views that are wrong."""

import inspect
from dataclasses import asdict, fields, replace

import numpy as np
import pytest
import torch

from sgwarp.commands.lift import Lift
from sgwarp.errors import InputError
from sgwarp.lifting import lifter, map_reader, ridge, robust
from sgwarp.lifting.holes import TRUST, fill_holes
from sgwarp.lifting.lifter import lift
from sgwarp.lifting.reliability import LEAST, from_residuals
from sgwarp.lifting.residuals import residual
from sgwarp.lifting.ridge import RIDGES, conjugate_gradients
from sgwarp.lifting.settings import LiftSettings
from sgwarp.ops.reference.rasterizer import ReferenceSettings, blend_blocks, project_scene
from sgwarp.ops.splatting.lifting import lift_view
from sgwarp.runs.log import RunLog
from sgwarp.scene import Camera, FeatureMap, Gaussians, Semantics, View

CHANNELS = 5


def dense_matrix(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """A of a view: alpha times transmittance, float64 [H W, N]."""
    projection = project_scene(gaussians, camera)
    A = torch.zeros(camera.height * camera.width, len(gaussians), dtype=torch.float64)
    for blend in blend_blocks(projection, camera.width, camera.height, ReferenceSettings()):
        A[blend.pixels[:, None], projection.index[blend.rows][None]] += blend.weights
    return A.numpy()


@pytest.fixture(scope="module")
def scene(make_scene):
    """A small cloud seen by five cameras, one map each: dense, dense with holes, ids."""
    _, gaussians, camera = make_scene("odd_size")
    noise = torch.Generator().manual_seed(5)
    views, maps = [], {}
    for k in range(5):
        pose = camera.world_to_camera.clone()
        pose[0, 3] += 0.1 * (k - 2)
        view = View(f"{k}", Camera(camera.K, pose, camera.width, camera.height))
        views.append(view)
        if k < 3:
            dense = torch.randn(*camera.size, CHANNELS, generator=noise)
            valid = torch.rand(camera.size, generator=noise) > 0.3 if k else None
            maps[view.stem] = FeatureMap("t", dense=dense, valid=valid)
        else:
            ids = torch.randint(-1, 6, (1, *camera.size), generator=noise)
            maps[view.stem] = FeatureMap("t", ids=ids, vectors=torch.randn(6, CHANNELS, generator=noise))
    matrices = [dense_matrix(gaussians, view.camera) for view in views]
    return gaussians, views, maps, matrices


def targets(found: FeatureMap) -> tuple[np.ndarray, np.ndarray]:
    """Features and validity at the pixels, float64 [H W, C] and [H W]."""
    if found.dense is not None:
        valid = torch.ones(found.size) if found.valid is None else found.valid
        return found.dense.double().flatten(0, 1).numpy(), valid.double().flatten().numpy()
    ids = found.ids[0].flatten()
    return found.vectors.double()[ids].numpy(), (ids >= 0).double().numpy()


def weighted_means(scene, mode: str = "weighted") -> tuple[np.ndarray, np.ndarray]:
    """Of each view, [V, N, C], and the weights behind them, [V, N]."""
    _, views, maps, matrices = scene
    means, weights = [], []
    for view, A in zip(views, matrices, strict=True):
        f, valid = targets(maps[view.stem])
        B = (A**2 if mode == "squared" else A) * valid[:, None]
        w = B.sum(axis=0)
        means.append(B.T @ f / np.where(w > 0, w, 1)[:, None])
        weights.append(w)
    return np.stack(means), np.stack(weights)


@pytest.mark.parametrize("mode", ["weighted", "squared"])
def test_means(scene, mode):
    gaussians, views, maps, _ = scene
    means, weights = weighted_means(scene, mode)
    total = weights.sum(axis=0)
    expected = (means * weights[..., None]).sum(axis=0) / np.where(total > 0, total, 1)[:, None]
    lifted = lift(gaussians, views, maps, mode)
    clear = total > 1e-3
    np.testing.assert_allclose(lifted.features[clear], expected[clear], atol=2e-4)
    np.testing.assert_allclose(lifted.weight, total, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("passes", [1, 4])
def test_robust_is_weiszfelds_iteration(scene, passes):
    gaussians, views, maps, _ = scene
    settings = LiftSettings(passes=passes, smoothing=0.05)
    lifted = lift(gaussians, views, maps, "robust", lift_settings=settings)
    means, weights = weighted_means(scene)
    total = weights.sum(axis=0)
    x = (means * weights[..., None]).sum(axis=0) / np.where(total > 0, total, 1)[:, None]
    for _ in range(passes):
        factor = weights / np.maximum(np.linalg.norm(x - means, axis=2), 0.05)
        divisor = factor.sum(axis=0)
        x = (factor[..., None] * means).sum(axis=0) / np.where(divisor > 0, divisor, 1)[:, None]
    clear = weights.max(axis=0) > 1e-2
    np.testing.assert_allclose(lifted.features[clear], x[clear], atol=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("ridge", [0.3, 10.0])
def test_solve_is_the_ridge_solution(scene, ridge):
    gaussians, views, maps, matrices = scene
    settings = LiftSettings(ridge=ridge, iterations=200)
    lifted = lift(gaussians, views, maps, "solve", lift_settings=settings)
    means, weights = weighted_means(scene)
    total = weights.sum(axis=0)
    prior = (means * weights[..., None]).sum(axis=0) / np.where(total > 0, total, 1)[:, None]
    K, right = ridge * np.eye(len(gaussians)), ridge * prior
    for view, A in zip(views, matrices, strict=True):
        f, valid = targets(maps[view.stem])
        K += A.T @ (valid[:, None] * A)
        right += A.T @ (valid[:, None] * f)
    np.testing.assert_allclose(lifted.features, np.linalg.solve(K, right), atol=3e-3)


def test_conjugate_gradients_against_numpy():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(40, 30))
    K = root.T @ root + np.diag(10 ** rng.uniform(-1, 2, 30))
    right = rng.normal(size=(30, 3))
    right[:, 1] = 0
    tensor = torch.from_numpy(K)
    solved = conjugate_gradients(lambda z: tensor @ z, torch.from_numpy(right), tensor.diagonal(), 60, 1e-12)
    np.testing.assert_allclose(solved, np.linalg.solve(K, right), atol=1e-9)
    once = conjugate_gradients(lambda z: tensor @ z, torch.from_numpy(right), tensor.diagonal(), 1)
    assert not np.allclose(once, solved)


WORTH = {"0": 1.0, "1": 0.25, "2": 0.04, "3": 0.6, "4": 0.01}


@pytest.mark.parametrize("mode", ["weighted", "squared", "robust", "solve"])
def test_what_a_view_is_worth_counts_in_every_mode(scene, mode, monkeypatch):
    """Against the means, Weiszfeld's iteration and the ridge solution with the views' factors in them."""
    gaussians, views, maps, matrices = scene
    monkeypatch.setattr(lifter, "view_reliabilities", lambda *rest: WORTH)
    settings = LiftSettings(reliability=True, passes=3, smoothing=0.05, ridge=0.3, iterations=200)
    lifted = lift(gaussians, views, maps, mode, lift_settings=settings)
    means, weights = weighted_means(scene, mode)
    worth = np.array([WORTH[view.stem] for view in views])[:, None]
    weights = worth * weights
    total = weights.sum(axis=0)
    x = (means * weights[..., None]).sum(axis=0) / np.where(total > 0, total, 1)[:, None]
    if mode == "solve":
        K, right = 0.3 * np.eye(len(gaussians)), 0.3 * x
        for view, A in zip(views, matrices, strict=True):
            f, valid = targets(maps[view.stem])
            K += WORTH[view.stem] * A.T @ (valid[:, None] * A)
            right += WORTH[view.stem] * A.T @ (valid[:, None] * f)
        x = np.linalg.solve(K, right)
    for _ in range(3 if mode == "robust" else 0):
        factor = weights / np.maximum(np.linalg.norm(x - means, axis=2), 0.05)
        divisor = factor.sum(axis=0)
        x = (factor[..., None] * means).sum(axis=0) / np.where(divisor > 0, divisor, 1)[:, None]
    clear = total > 1e-2
    np.testing.assert_allclose(lifted.features[clear], x[clear], atol=3e-3)
    np.testing.assert_allclose(lifted.weight, total, rtol=2e-3, atol=1e-4)
    squares = (weights**2).sum(axis=0)
    views_behind = total**2 / np.where(squares > 0, squares, 1)
    np.testing.assert_allclose(lifted.effective_views[clear], views_behind[clear], rtol=5e-3)


@pytest.mark.parametrize("reliability", [False, True])
@pytest.mark.parametrize(("mode", "walks"), [("weighted", 1), ("center", 1), ("robust", 4), ("solve", None)])
def test_progress_of_every_mode_reaches_what_it_announced(stage, mode, walks, reliability):
    """All walks over the views count; how many those of "solve" are nobody knows before the end."""
    calls = []
    settings = LiftSettings(passes=3, iterations=1, ridge=1.0, reliability=reliability)
    views = stage.views[:3]
    lift(stage.gaussians, views, stage.one_hot, mode, lift_settings=settings, progress=lambda *c: calls.append(c[:2]))
    assert [done for done, _ in calls] == list(range(len(calls)))
    assert calls[-1][0] == calls[-1][1]
    if walks is not None:
        assert {total for _, total in calls} == {3 * (walks + reliability)}


def test_maps_are_kept_within_a_limit_and_the_others_made_again(scene, monkeypatch):
    """Room for two of the dense maps and no third: ids are small and may fit where a dense map does not."""
    gaussians, views, maps, _ = scene
    asked = []

    def spy(view: View) -> FeatureMap:
        asked.append(view.stem)
        return maps["0"]

    monkeypatch.setattr(map_reader, "KEPT_BYTES", int(2.5 * maps["0"].dense.nbytes))
    lift(gaussians, views, spy, "robust", lift_settings=LiftSettings(passes=2))
    counts = sorted(asked.count(view.stem) for view in views)
    assert counts == [1, 1, 3, 3, 3]


def wrong_view(stage, view: View) -> FeatureMap:
    """View 0001 takes every panel for the next one."""
    labels = stage.labels(view)
    shifted = torch.where(labels > 0, labels % 4 + 1, 0) if view.stem == "0001" else labels
    return FeatureMap("labels", ids=shifted - 1, labels=("1", "2", "3", "4"))


def shown_right(stage, lifted: Semantics) -> float:
    """Share of the true label, over the Gaussians that are seen well."""
    clear = lifted.effective_views > 3
    return float(lifted.features[clear, stage.classes[clear] - 1].mean())


def test_a_wrong_view_is_outvoted(stage):
    """One of six views is wrong: a mean keeps a sixth of it, a median less, and its reliability is next to nothing."""
    by_mode = {}
    for mode in ("weighted", "robust"):
        by_mode[mode] = shown_right(stage, lift(stage.gaussians, stage.views, lambda v: wrong_view(stage, v), mode))
    log = RunLog()
    reliable = lift(
        *(stage.gaussians, stage.views, lambda view: wrong_view(stage, view)),
        lift_settings=LiftSettings(reliability=True),
        log=log,
    )
    assert by_mode["weighted"] < 0.87
    assert by_mode["robust"] > by_mode["weighted"] + 0.08
    assert shown_right(stage, reliable) > by_mode["weighted"] + 0.08
    assert log.error["least_reliability"] < 0.2


def test_reliability_only_takes_away():
    worth = from_residuals({"a": 0.1, "b": 0.2, "c": 0.4, "d": 20.0, "e": float("nan")})
    assert worth == pytest.approx({"a": 1.0, "b": 1.0, "c": (0.3 / 0.4) ** 2, "d": LEAST, "e": 1.0})
    assert from_residuals({}) == {}


@pytest.mark.slow
def test_solve_chooses_its_ridge_by_views_that_it_did_not_fit(stage):
    log = RunLog()
    options = LiftSettings(iterations=2)
    solved = lift(stage.gaussians, stage.views, stage.one_hot, "solve", lift_settings=options, log=log)
    assert log.error["ridge"] in RIDGES
    assert 0 <= log.error["residual"] < 0.2
    assert torch.equal(solved.weight, lift(stage.gaussians, stage.views, stage.one_hot).weight)


def test_the_ridge_is_the_one_that_misses_held_out_views_least(scene):
    """Every sixth of 16 views is held out, from the fourth on; the middle one counts as the last of them."""
    gaussians, five, five_maps, _ = scene
    views = [replace(five[k % 5], stem=f"{k:02d}") for k in range(16)]
    maps = {view.stem: five_maps[f"{k % 5}"] for k, view in enumerate(views)}
    held = [views[3], views[10], views[8]]
    rest = [view for view in views if view not in held]
    missed = {}
    for strength in RIDGES:
        one = lift(gaussians, rest, maps, "solve", lift_settings=LiftSettings(ridge=strength))
        known = (gaussians.finite & one.seen).float()
        missed[strength] = np.mean([residual(gaussians, v.camera, maps[v.stem], one.features, known) for v in held])
    log = RunLog()
    lift(gaussians, views, maps, "solve", log=log)
    assert log.error["ridge"] == min(missed, key=missed.get)
    assert log.error["residual"] == pytest.approx(min(missed.values()), rel=1e-4)


@pytest.mark.parametrize("mode", ["weighted", "robust", "solve"])
def test_every_walk_adds_up_in_a_fixed_order_if_asked(scene, mode, monkeypatch):
    """On the CPU the order is always fixed, so no result would tell."""
    gaussians, views, maps, _ = scene
    asked = []
    for module in (lifter, ridge, robust):

        def spy(*arguments, real=lift_view, **options):
            asked.append(options["deterministic"])
            return real(*arguments, **options)

        monkeypatch.setattr(module, "lift_view", spy)
    lift(gaussians, views, maps, mode, deterministic=True)
    assert len(asked) >= len(views)
    assert set(asked) == {True}


def test_maps_are_made_once_where_a_mode_walks_over_the_views_again(stage):
    asked = []

    def spy(view: View) -> FeatureMap:
        asked.append(view.stem)
        return stage.one_hot(view)

    lift(stage.gaussians, stage.views[:3], spy, "robust")
    assert sorted(asked) == ["0000", "0001", "0002"]


def test_holes_get_what_their_neighbors_have(stage):
    lifted = lift(stage.gaussians, stage.views, stage.one_hot)
    blind = torch.arange(len(stage.gaussians)) % 3 == 0
    holed = replace(
        lifted,
        features=torch.where(blind[:, None], 0.0, lifted.features),
        weight=torch.where(blind, 0.0, lifted.weight),
        effective_views=torch.where(blind, 0.0, lifted.effective_views),
    )
    filled = fill_holes(stage.gaussians, holed, 2)
    assert torch.equal(filled.features[~blind & holed.seen], lifted.features[~blind & holed.seen])
    row = int(blind.nonzero()[500])
    means, seen = stage.gaussians.means.double().numpy(), np.flatnonzero(holed.seen.numpy())
    distance = np.linalg.norm(means[seen] - means[row], axis=1)
    near = np.argsort(distance)[:2]
    shares = (1 / distance[near]) / (1 / distance[near]).sum()
    np.testing.assert_allclose(filled.features[row], shares @ holed.features[seen[near]].numpy(), atol=1e-6)
    assert filled.weight[row] == pytest.approx(TRUST * holed.weight[seen[near]].mean().item())
    assert (filled.effective_views[blind] == 0).all()
    same = filled.features[blind].argmax(dim=1) == lifted.features[blind].argmax(dim=1)
    assert same.float().mean() > 0.9


@pytest.mark.parametrize("wanted", [1, 3, 8])
def test_fewer_were_seen_than_neighbors_are_asked(wanted):
    """All that were seen speak then; what is not finite is neither asked nor filled."""
    random = np.random.default_rng(1)
    means = random.normal(size=(7, 3)).astype(np.float32)
    means[6] = np.nan
    quats = torch.tensor([1.0, 0, 0, 0]).expand(7, 4)
    gaussians = Gaussians(torch.tensor(means), quats, torch.ones(7, 3), torch.ones(7), torch.zeros(7, 1, 3))
    weight = torch.tensor([2.0, 3.0, 4.0, 0.0, 0.0, 0.0, 0.0])
    features = torch.tensor(random.normal(size=(7, 2)), dtype=torch.float32) * (weight > 0)[:, None]
    found = fill_holes(gaussians, Semantics(features, weight, weight.sign(), "t", gaussians.fingerprint), wanted)
    for row in (3, 4, 5):
        distance = np.linalg.norm(means[:3] - means[row], axis=1)
        near = np.argsort(distance)[:wanted]
        shares = (1 / distance[near]) / (1 / distance[near]).sum()
        np.testing.assert_allclose(found.features[row], shares @ features[near].numpy(), atol=1e-5)
        assert found.weight[row] == pytest.approx(TRUST * weight[near].mean().item())
    assert torch.equal(found.features[[0, 1, 2, 6]], features[[0, 1, 2, 6]])
    assert torch.equal(found.weight[[0, 1, 2, 6]], weight[[0, 1, 2, 6]])


def test_filling_is_counted_and_leaves_the_coverage(stage):
    log = RunLog()
    camera = stage.views[0].camera
    pose = camera.world_to_camera.clone()
    pose[0, 3] += 2.0  # half of the stage is out of sight
    some = [View("0000", Camera(camera.K, pose, camera.width, camera.height))]
    plain = lift(stage.gaussians, some, stage.one_hot)
    filled = lift(stage.gaussians, some, stage.one_hot, lift_settings=LiftSettings(fill=3), log=log)
    assert filled.coverage == 1.0 > plain.coverage == log.error["coverage"]
    assert log.left_out["unseen_gaussians_filled"] == int((~plain.seen).sum())


def test_defaults_are_the_same_wherever_they_are_given():
    """As arguments of `lift`, as settings of the modes, and as options of the command."""
    settings, options = asdict(LiftSettings()), {one.name: one.default for one in fields(Lift)}
    arguments = {name: one.default for name, one in inspect.signature(lift).parameters.items()}
    for others, count in ((arguments, 2), (options, 7)):
        shared = settings.keys() & others.keys()
        assert len(shared) == count
        assert {name: others[name] for name in shared} == {name: settings[name] for name in shared}


@pytest.mark.parametrize(
    "change", [{"passes": 0}, {"iterations": 0}, {"fill": -1}, {"ridge": -1.0}, {"smoothing": 0.0}, {"tau": 0.0}]
)
def test_settings_out_of_range(change):
    with pytest.raises(InputError, match=next(iter(change))):
        LiftSettings(**change)
