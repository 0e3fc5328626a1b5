"""The unit of depth images: which points are compared, what is counted of them, and which factor is believed."""

import math
import warnings

import numpy as np
import pytest
import torch

from sgwarp.reconstruction import depth_unit
from sgwarp.reconstruction.depth_unit import _Pairs, _rays, _widest, measure_depth_unit, shrink_depth
from sgwarp.scene import Camera


def camera(place, width: int = 12, height: int = 10) -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = -torch.tensor(place, dtype=torch.float64)
    return Camera(torch.tensor([[14.0, 0, 5], [0, 12, 6], [0, 0, 1]]), pose, width, height)


@pytest.mark.parametrize(
    ("size", "small"),
    [((48, 64), (48, 64)), ((48, 65), (24, 32)), ((96, 128), (48, 64)), ((129, 7), (43, 2)), ((1, 300), (1, 60))],
)
def test_small_copies_take_the_pixels_in_the_middle(size, small):
    """At most 64 wide and high; none is mixed with others."""
    depth = np.arange(size[0])[:, None] * 1000.0 + np.arange(size[1])
    found, its_camera = shrink_depth(depth, camera((0, 0, 0), size[1], size[0]))
    rows, columns = ([math.floor((k + 0.5) * n / few) for k in range(few)] for few, n in zip(small, size, strict=True))
    np.testing.assert_array_equal(found, np.array(rows)[:, None] * 1000.0 + np.array(columns))
    assert its_camera.size == small
    assert its_camera.K[0, 0].item() == pytest.approx(14 * small[1] / size[1])


@pytest.mark.parametrize("factor", [1.0, 0.7, 1.6])
@pytest.mark.parametrize("shift", [(0.3, 0.1, 0.0), (0.2, 0.0, 2.0), (7.5, 0.0, 0.0)])
def test_points_are_counted_where_others_see_a_surface(factor, shift):
    """Loops over all points: in front, in the image, and of those a surface within 4 %; of a tenth of all at least."""
    random = np.random.default_rng(0)
    cameras = [camera((0.0, 0.0, 0.0)), camera(shift)]
    depths = [np.where(random.random((10, 12)) < 0.8, random.uniform(1.5, 4, (10, 12)), 0.0) for _ in range(2)]
    depths[1][3:7] = depths[0][3:7] = 3.0
    pairs = _Pairs(depths, cameras, 1.0)
    total = judged = close = 0
    for own, other in ((0, 1), (1, 0)):
        apart = (cameras[own].position - cameras[other].position).numpy()
        for row, column in np.argwhere(depths[own] > 0):
            total += 1
            z = factor * depths[own][row, column]
            x, y, z = np.array([(column + 0.5 - 5) / 14 * z, (row + 0.5 - 6) / 12 * z, z]) + apart
            if z <= 0:
                continue
            u, v = math.floor(14 * x / z + 5), math.floor(12 * y / z + 6)
            if 0 <= u < 12 and 0 <= v < 10 and depths[other][v, u] > 0:
                judged += 1
                close += abs(z / (factor * depths[other][v, u]) - 1) < 0.04
    assert len(pairs) == total
    assert pairs.agreement(factor) == pytest.approx(close / max(judged, total / 10, 1))
    if shift[0] > 7:
        assert judged < total / 10


def test_views_without_depth_are_not_looked_into():
    cameras = [camera((0.3 * k, 0.0, 0.0)) for k in range(3)]
    depths = [np.full((10, 12), 3.0), np.zeros((10, 12)), np.full((10, 12), 3.0)]
    assert sorted(_Pairs(depths, cameras, 1.0).pairs) == [(0, 2), (1, 0), (1, 2), (2, 0)]
    assert _Pairs([np.zeros((10, 12))] * 2, cameras[:2], 1.0).agreement(1.0) == 0


@pytest.mark.parametrize(("count", "chosen"), [(4, [0, 1, 2, 3]), (10, [*range(10)]), (19, [*range(0, 19, 2)])])
def test_points_of_ten_views_are_compared(count, chosen):
    cameras = [camera((0.3 * k, 0.0, 0.0)) for k in range(count)]
    assert sorted(_Pairs([np.ones((10, 12))] * count, cameras, 1.0).rays) == chosen


@pytest.mark.parametrize(("points", "left"), [(120, 120), (499, 499), (500, 250), (3000, 250), (3072, 256)])
def test_about_250_points_of_a_view_are_compared(points, left):
    depth = np.zeros(48 * 64)
    depth[:points] = 2.0
    rays = _rays(depth.reshape(48, 64), camera((5.0, 0.0, 1.0), 64, 48))
    assert len(rays) == left
    np.testing.assert_allclose(rays[0], [(0.5 - 5) / 14 * 2, (0.5 - 6) / 12 * 2, 2.0])
    assert (rays[:, 2] == 2).all()


class Agreement:
    """What a factor agrees in, as a function of it."""

    def __init__(self, of_factor, points: int = 1000) -> None:
        self.agreement, self.points = of_factor, points

    def __len__(self) -> int:
        return self.points


@pytest.mark.parametrize(
    ("values", "low", "high", "most"),
    [
        ((0.1, 0.5, 0.96, 1.0, 0.97, 0.5, 0.2), 2, 4, 1.0),
        ((0.1, 0.5, 1.0, 0.96, 0.97, 0.94, 0.99), 2, 4, 1.0),
        ((0.79, 0.94, 0.75, 0.78, 0.8, 0.77, 0.77), 1, 1, 0.94),
        ((0.8, 0.8, 0.79, 0.78, 0.8, 0.77, 0.77), 0, 6, 0.8),
        ((0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.5), 6, 6, 0.5),
        ((0.1, 0.95, 1.0, 0.95, 0.94, 1.0, 0.1), 1, 3, 1.0),  # just as good as that
    ],
)
def test_the_middle_of_what_is_nearly_as_good_is_taken(values, low, high, most):
    factors = 2.0 ** np.arange(7)
    found, best = _widest(Agreement(dict(zip(factors.tolist(), values, strict=True)).__getitem__), factors)
    assert (found, best) == (pytest.approx(2 ** ((low + high) / 2)), most)


def measured(monkeypatch, of_factor, points: int = 1000):
    depths, cameras = [np.ones((10, 12))], [camera((0, 0, 0))]

    def pairs(*given):
        assert given == (depths, cameras, 2.5)
        return Agreement(of_factor, points)

    monkeypatch.setattr(depth_unit, "_Pairs", pairs)
    return measure_depth_unit(depths, cameras, 2.5)


def around(true: float, most: float, else_where: float = 0.02, width: float = 0.04):
    return lambda factor: most if abs(factor / true - 1) < width else else_where


@pytest.mark.parametrize(("points", "enough"), [(199, False), (200, True)])
def test_of_few_points_nothing_is_said(monkeypatch, points, enough):
    assert (measured(monkeypatch, around(0.3, 0.9), points) is not None) == enough


@pytest.mark.parametrize("true", [3.28084, 1 / 6553.5, 0.31, 47.0, 8e4, 1.3e-5])
def test_any_factor_is_found(monkeypatch, true):
    found = measured(monkeypatch, around(true, 0.9))
    assert found.factor == pytest.approx(true, rel=0.003)
    assert (found.agreement, found.as_given) == (0.9, 0.02)


@pytest.mark.parametrize("true", [1.2e5, 1 / 1.2e5])
def test_factors_beyond_a_hundred_thousand_are_not_tried(monkeypatch, true):
    assert measured(monkeypatch, around(true, 0.9)).factor == 1


@pytest.mark.parametrize(("true", "factor"), [(0.00103, 0.001), (98.0, 100.0), (0.0011, None), (1.15, None)])
def test_a_round_factor_that_is_as_good_is_meant(monkeypatch, true, factor):
    found = measured(monkeypatch, around(true, 0.9))
    assert found.factor == (pytest.approx(true, rel=0.003) if factor is None else factor)
    assert found.agreement == 0.9


@pytest.mark.parametrize(("round_one", "believed"), [(0.86, True), (0.85, False)])
def test_a_round_factor_may_be_a_twentieth_worse(monkeypatch, round_one, believed):
    """Of 0.9: the factors around 0.00105 agree in it, and the round one a little less."""

    def agreement(factor):
        return round_one if factor == 0.001 else 0.9 if abs(factor / 0.00106 - 1) < 0.04 else 0.02

    found = measured(monkeypatch, agreement)
    assert (found.factor == 0.001) == believed
    assert found.agreement == (round_one if believed else 0.9)


@pytest.mark.parametrize(
    ("as_given", "most", "believed"),
    [
        (0.50, 0.74, False),  # half of the points disagree, and 0.26 of them still: not twice as many
        (0.50, 0.76, True),
        (0.30, 0.59, False),
        (0.30, 0.61, True),  # more than twice as many agree
        (0.945, 0.99, False),  # within a twentieth of the best
        (0.93, 0.99, True),
        (0.0, 0.5, True),
    ],
)
def test_another_unit_has_to_be_clearly_better(monkeypatch, as_given, most, believed):
    found = measured(monkeypatch, lambda factor: as_given if factor == 1 else around(0.3, most, 0.0)(factor))
    assert found.as_given == as_given
    assert found.factor == (pytest.approx(0.3, rel=0.003) if believed else 1)
    assert found.agreement == (most if believed else as_given)


def test_a_finer_search_may_find_more(monkeypatch):
    """The best of both searches is what depth as it was given is held against: here the first one just misses it."""
    true = 1e-5 * 1.08**134.5  # between two factors that are tried, at which it is 0.68

    def agreement(factor):
        return 0.66 if factor == 1 else max(0.0, 0.99 - 8 * abs(math.log(factor / true)))

    found = measured(monkeypatch, agreement)
    assert found.factor == pytest.approx(true, rel=0.005)
    assert found.agreement > 0.95


def test_points_beside_a_camera_are_in_no_pixel():
    """However far beyond the image the division takes them, nothing overflows."""
    points = np.array([[1.0, 0.0, 1e-300], [-1.0, 1.0, 1e-300], [0.0, 0.0, 3.0], [0.0, 0.0, -3.0]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = depth_unit._ratios(points, 1.0, np.full((10, 12), 2.0), camera((0, 0, 0)))
    assert found.tolist() == [1.5]
