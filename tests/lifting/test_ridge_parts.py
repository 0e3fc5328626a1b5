"""The parts of "solve": when its iteration ends, which channels and views choose the ridge, and what a map shows."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sgwarp.encoders.base import MissingMap
from sgwarp.lifting import holes, ridge, robust
from sgwarp.lifting.holes import fill_holes
from sgwarp.lifting.lifter import lift
from sgwarp.lifting.map_reader import MapReader, as_source
from sgwarp.lifting.ridge import RIDGES, Problem, choose_ridge, conjugate_gradients, map_at_pixels
from sgwarp.lifting.settings import LiftSettings
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.runs.log import RunLog
from sgwarp.scene import FeatureMap, Semantics


def matrix(size: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(2)
    root = rng.normal(size=(2 * size, size))
    return root.T @ root + np.diag(10 ** rng.uniform(-1, 2, size)), rng.normal(size=(size, columns))


def steps_until(K: np.ndarray, right: np.ndarray, tolerance: float) -> int:
    """Textbook preconditioned iteration of one column: products until its residual is small enough."""
    inverse = 1 / np.diag(K)
    z, rest = np.zeros_like(right), right.copy()
    scaled = inverse * rest
    direction, size = scaled, rest @ scaled
    first, steps = size, 0
    while size > tolerance**2 * first:
        image = K @ direction
        step = size / (direction @ image)
        z, rest = z + step * direction, rest - step * image
        scaled = inverse * rest
        before, size = size, rest @ scaled
        direction = scaled + size / before * direction
        steps += 1
    return steps


@pytest.mark.parametrize("tolerance", [0.5, 1e-1, 1e-2, 1e-4, 1e-7])
@pytest.mark.parametrize("columns", [1, 3])
def test_iterations_end_when_every_column_is_solved_well_enough(tolerance, columns):
    K, right = matrix(25, columns)
    products = []

    def product(z):
        products.append(z)
        return torch.from_numpy(K) @ z

    solved = conjugate_gradients(product, torch.from_numpy(right), torch.from_numpy(np.diag(K).copy()), 500, tolerance)
    assert len(products) == max(steps_until(K, right[:, k], tolerance) for k in range(columns))
    missed = np.linalg.norm(right - K @ solved.numpy(), axis=0) / np.linalg.norm(right, axis=0)
    assert missed.max() < 30 * tolerance
    products.clear()
    conjugate_gradients(product, torch.from_numpy(right), torch.from_numpy(np.diag(K).copy()), 2, 1e-12)
    assert len(products) == 2, "at most so many"


def test_nothing_to_solve_takes_no_product():
    right, products = torch.zeros(4, 2), []
    assert not conjugate_gradients(lambda z: products.append(z) or z, right, torch.ones(4), 5).any()
    assert products == []


def test_a_diagonal_matrix_is_solved_at_once():
    diagonal, products = torch.tensor([0.5, 2.0, 4.0]), []
    right = torch.tensor([[1.0, 0.0], [2.0, 0.0], [4.0, 0.0]])

    def product(z):
        products.append(z)
        return diagonal[:, None] * z

    solved = conjugate_gradients(product, right, diagonal, 9)
    torch.testing.assert_close(solved, right / diagonal[:, None])
    assert len(products) == 1


@pytest.fixture
def problem(stage):
    """Of `count` views; no map is read."""

    def make(count: int, labels=None, channels: int = 5) -> Problem:
        views = [SimpleNamespace(stem=f"{k:02d}") for k in range(count)]
        return Problem(SimpleNamespace(kind=("t", channels, labels)), views, {})

    return make


@pytest.fixture
def chosen(monkeypatch):
    """`chosen(errors)`: the residuals that the ridges have; what was solved and what was held out."""

    def make(errors, means=None):
        noted = SimpleNamespace(solved=[], held=[], fitted=[])
        means = torch.ones(3, 5) if means is None else means
        monkeypatch.setattr(ridge, "_weighted", lambda problem, views: (means, "weight"))

        def solve(self, prior, strength, iterations):
            noted.solved.append((strength, iterations, prior, self.channels))
            noted.fitted = [view.stem for view in self.views]
            return strength

        def missed(problem, views, features, weight):
            noted.held.append([view.stem for view in views])
            assert weight == "weight"
            return errors[RIDGES.index(features)]

        monkeypatch.setattr(Problem, "solve", solve)
        monkeypatch.setattr(ridge, "_missed", missed)
        return noted

    return make


@pytest.mark.parametrize(
    ("errors", "expected"),
    [
        ((0.1, 0.2, 0.3), (1.0, 0.1)),
        ((0.3, 0.1, 0.2), (10.0, 0.1)),
        ((0.3, 0.2, 0.1), (100.0, 0.1)),
        ((0.2, 0.2, 0.2), (1.0, 0.2)),
        ((math.nan, 0.4, math.nan), (10.0, 0.4)),
        ((math.nan,) * 3, (10.0, math.nan)),
    ],
)
def test_the_ridge_with_the_least_residual_is_taken(problem, chosen, errors, expected):
    noted = chosen(errors)
    found = choose_ridge(problem(4), 7)
    assert found == pytest.approx(expected, nan_ok=True)
    assert [(strength, iterations) for strength, iterations, *_ in noted.solved] == [(k, 7) for k in RIDGES]


@pytest.mark.parametrize(
    ("count", "held"), [(0, []), (1, []), (3, []), (4, [3]), (9, [3]), (10, [3, 9]), (16, [3, 9, 15])]
)
def test_every_sixth_view_is_held_out(problem, chosen, count, held):
    noted = chosen((0.3, 0.2, 0.1))
    found = choose_ridge(problem(count), 2)
    if not held:
        assert found == pytest.approx((10.0, math.nan), nan_ok=True)
        assert noted.held == []
        return
    assert noted.held == [[f"{k:02d}" for k in held]] * 3
    assert noted.fitted == [f"{k:02d}" for k in range(count) if k not in held]


@pytest.mark.parametrize(("channels", "labels", "few"), [(32, None, False), (33, None, True), (40, ("a",) * 40, False)])
def test_the_largest_channels_choose_for_all(problem, chosen, channels, labels, few):
    g = torch.Generator().manual_seed(0)
    means = torch.randn(6, channels, generator=g) * torch.randperm(channels, generator=g)
    noted = chosen((0.3, 0.2, 0.1), means)
    choose_ridge(problem(4, labels, channels), 2)
    _, _, prior, taken = noted.solved[0]
    if not few:
        assert taken is None
        assert torch.equal(prior, means)
        return
    size = (means.double() ** 2).sum(dim=0)
    assert set(taken.tolist()) == set(size.argsort()[-32:].tolist())
    assert torch.equal(prior, means[:, taken])


@pytest.mark.parametrize("kind", ["dense", "valid", "vectors", "labels"])
def test_channels_of_a_map_are_those_at_its_pixels(stage, kind):
    """Zero where a map says nothing."""
    view = stage.views[0]
    truth = stage.labels(view) - 1
    known = truth >= 0
    table = torch.eye(4) if kind == "labels" else torch.randn(4, 4, generator=torch.Generator().manual_seed(1))
    dense = table[truth.clamp(min=0)]
    found = {
        "dense": FeatureMap("t", dense=dense),
        "valid": FeatureMap("t", dense=torch.where(known[..., None], dense, torch.nan), valid=known),
        "vectors": FeatureMap("t", ids=truth, vectors=table),
        "labels": FeatureMap("labels", ids=truth, labels=("1", "2", "3", "4")),
    }[kind]
    said = torch.ones_like(known) if kind == "dense" else known
    for channels in (slice(0, 4), slice(1, 3), slice(2, 64)):
        features, valid = map_at_pixels(found, view, channels, torch.device("cpu"))
        expected = torch.where(said[..., None], dense, 0.0)[..., channels]
        torch.testing.assert_close(features, expected)
        assert (valid is None) == (kind == "dense")
        assert valid is None or torch.equal(valid, known)
    chosen = torch.tensor([2, 0])
    if kind != "labels":
        reader = MapReader(stage.gaussians, as_source(lambda view: found), RasterSettings(), RunLog())
        few = Problem(reader, [view], {}, channels=chosen).map_of(view)
        features, _ = map_at_pixels(few, view, slice(0, 2), torch.device("cpu"))
        torch.testing.assert_close(features, torch.where(said[..., None], dense, 0.0)[..., chosen])


def test_the_residual_of_held_out_views_is_a_mean_over_those_with_a_map(stage, monkeypatch):
    monkeypatch.setattr(ridge, "residual", lambda gaussians, camera, found, *rest: float(found.dense.mean()))
    maps = {
        view.stem: FeatureMap("t", dense=torch.full((4, 4, 1), float(k))) for k, view in enumerate(stage.views[:3], 1)
    }

    def encode(view):
        if view.stem not in maps:
            raise MissingMap(view.stem)
        return maps[view.stem]

    reader = MapReader(stage.gaussians, as_source(encode), RasterSettings(), RunLog())
    part = Problem(reader, [], {})
    assert ridge._missed(part, stage.views[:4], torch.zeros(1), torch.ones(1)) == pytest.approx(2.0)
    assert math.isnan(ridge._missed(part, stage.views[4:], torch.zeros(1), torch.ones(1)))


# Work in parts


@pytest.mark.slow
def test_results_do_not_depend_on_how_many_rows_are_taken_at_once(stage, monkeypatch):
    pytest.importorskip("scipy")
    views, settings = stage.views[:3], LiftSettings(passes=2, ridge=1.0, iterations=2)

    def results():
        median = lift(stage.gaussians, views, stage.dense, "robust", lift_settings=settings).features
        solved = lift(stage.gaussians, views[:2], stage.dense, "solve", lift_settings=settings).features
        n = len(stage.gaussians)
        seen = (torch.arange(n) % 2).float()
        half = Semantics(
            torch.eye(3)[torch.arange(n) % 3] * seen[:, None], seen, seen, "t", stage.gaussians.fingerprint
        )
        filled = fill_holes(stage.gaussians, half, 3)
        return median, solved, filled.features, filled.weight

    whole = results()
    monkeypatch.setattr(robust, "ROWS", 1000)
    monkeypatch.setattr(holes, "ROWS", 700)
    monkeypatch.setattr(ridge, "BLOCK", 2)
    for one, other in zip(whole, results(), strict=True):
        torch.testing.assert_close(other, one, rtol=1e-4, atol=1e-5)


def test_nothing_is_filled_where_nothing_lacks_or_nothing_was_seen(stage):
    pytest.importorskip("scipy")
    n = len(stage.gaussians)
    for weight in (torch.ones(n), torch.zeros(n)):
        semantics = Semantics(torch.ones(n, 2) * weight[:, None], weight, weight, "t", stage.gaussians.fingerprint)
        assert fill_holes(stage.gaussians, semantics) is semantics


def test_every_product_tells_which_views_are_done(stage):
    done, views = [], stage.views[:2]
    reader = MapReader(stage.gaussians, as_source(stage.dense), RasterSettings(), RunLog())
    problem = Problem(reader, views, {}, done=done.append)
    features = torch.zeros(len(stage.gaussians), 5)
    for walk in (problem.diagonal, lambda: problem.normal_product(features)):
        walk()
        assert done == [view.stem for view in views]
        done.clear()
    assert reader.log.stages["solve"] > 0
