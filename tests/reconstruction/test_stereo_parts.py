"""The parts of the plane sweep, each against slow loops over what its description says."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sgwarp.reconstruction import stereo, stereo_refinement
from sgwarp.reconstruction.stereo import _best, _costs, _judge, _warp, estimate_depth, unproject
from sgwarp.reconstruction.stereo_agreement import difference, least, together
from sgwarp.reconstruction.stereo_refinement import _warped, refined
from sgwarp.reconstruction.stereo_smoothing import smoothed
from sgwarp.scene import Camera

K = torch.tensor([[30.0, 0, 9], [0, 25, 8], [0, 0, 1]])


def camera(place=(0.0, 0.0, 0.0), degrees: float = 0.0, width: int = 20, height: int = 14) -> Camera:
    """At a place, turned about the vertical."""
    angle = math.radians(degrees)
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 0] = pose[2, 2] = math.cos(angle)
    pose[0, 2], pose[2, 0] = -math.sin(angle), math.sin(angle)
    pose[:3, 3] = -pose[:3, :3] @ torch.tensor(place, dtype=torch.float64)
    return Camera(K, pose, width, height)


def seen_at(camera: Camera, point) -> tuple[float, float, float]:
    """Pixel and depth of a place."""
    x, y, z = camera.world_to_camera[:3].numpy() @ np.append(point, 1.0)
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    return fx * x / z + cx, fy * y / z + cy, z


def place_of(camera: Camera, column: float, row: float, depth: float) -> np.ndarray:
    x, y = (column - 9.0) / 30.0 * depth, (row - 8.0) / 25.0 * depth
    return np.linalg.inv(camera.world_to_camera.numpy())[:3] @ np.array([x, y, depth, 1.0])


# Agreement.


def test_windows_are_compared_by_correlation_and_brightness():
    """Of 5 x 5 pixels: 1 - correlation, where a deviation of 0.002 counts as even, and thrice the difference."""
    random = np.random.default_rng(0)
    image, warped = (random.random((9, 11)).astype(np.float32) for _ in range(2))
    image[:, :6] = 0.5 + 0.002 * image[:, :6]  # nearly even
    warped[:4] *= 0.2
    found = difference(image, warped)
    for row in range(2, 7):
        for column in range(2, 9):
            a, b = (t[row - 2 : row + 3, column - 2 : column + 3].astype(np.float64) for t in (image, warped))
            joint = (a * b).mean() - a.mean() * b.mean()
            correlation = joint / math.sqrt((a.var() + 4e-6) * (b.var() + 4e-6))
            expected = 1 - correlation + 3 * abs(a.mean() - b.mean())
            assert found[row, column] == pytest.approx(expected, abs=2e-3)
    assert found.dtype == np.float32


def test_what_was_not_warped_costs_without_limit():
    image = np.random.default_rng(0).random((12, 12)).astype(np.float32)
    warped = image.copy()
    warped[5, 6] = -1000
    expected = np.zeros((12, 12), bool)
    expected[3:8, 4:9] = True
    assert np.array_equal(np.isinf(difference(image, warped)), expected)
    assert np.isfinite(difference(image, np.zeros_like(image))).all()  # black is a color


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5])
def test_the_better_half_of_the_neighbors_counts(count):
    random = np.random.default_rng(count)
    costs = random.random((count, 3, 4, 5)).astype(np.float32)
    costs[random.random(costs.shape) < 0.5] = np.inf
    found = together(costs.copy())
    for place in np.ndindex(3, 4, 5):
        finite = sorted(value for value in costs[(slice(None), *place)] if np.isfinite(value))
        enough = len(finite) >= 2 or (count == 1 and len(finite) == 1)
        expected = np.mean(finite[: math.ceil(len(finite) / 2)]) if enough else 2.0
        assert found[place] == pytest.approx(expected, rel=1e-6)


def test_the_least_lies_between_two_planes():
    """Of parabolas exactly; at most half a step beyond the planes but one at either end; the middle one is 0."""
    planes = np.arange(9.0)
    for at, expected in ((3.3, -0.7), (4.0, 0.0), (5.49, 1.49), (6.8, 2.8), (0.6, -3.4), (0.0, -3.5), (9.0, 3.5)):
        costs = (0.01 * (planes - at) ** 2).astype(np.float32).reshape(9, 1, 1)
        assert least(costs)[0, 0] == pytest.approx(expected, abs=1e-3)
    assert least(np.ones((9, 1, 1), np.float32))[0, 0] == -3  # nowhere in particular, and no division by zero
    corner = np.abs(planes - 6).astype(np.float32).reshape(9, 1, 1)
    assert least(corner)[0, 0] == 2


def test_costs_are_smoothed_along_four_lines():
    """Recursively, place by place: a step to the next plane costs 0.1, one to any other 0.6."""
    costs = np.random.default_rng(0).random((5, 4, 6)).astype(np.float32)
    costs[2] *= 0.1
    depth, height, width = costs.shape
    expected = np.zeros_like(costs, np.float64)
    for down, right in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        ways: dict[tuple[int, int], list[float]] = {}
        for row in range(height)[:: down or 1]:
            for column in range(width)[:: right or 1]:
                before, own = ways.get((row - down, column - right)), costs[:, row, column].tolist()
                if before is not None:
                    for plane in range(depth):
                        moved = [
                            cost + {0: 0.0, 1: 0.1}.get(abs(plane - other), 0.6) for other, cost in enumerate(before)
                        ]
                        own[plane] += min(moved) - min(before)
                ways[row, column] = own
                expected[:, row, column] += own
    np.testing.assert_allclose(smoothed(costs), expected, rtol=1e-5)


# Warping.


def linear(rows, columns):
    """A picture that interpolation does not change."""
    return 0.02 * columns + 0.01 * rows + 0.1


NEIGHBOR = np.fromfunction(lambda r, c: linear(r + 0.5, c + 0.5), (16, 24)).astype(np.float32)


@pytest.mark.parametrize(("place", "degrees"), [((0.3, 0.1, -0.2), 4.0), ((-0.2, 0.0, 0.3), -6.0)])
@pytest.mark.parametrize("surface", ["plane", "hills"])
def test_a_neighbor_is_warped_by_the_places_that_pixels_see(place, degrees, surface):
    own, other = camera((0.1, 0.0, 0.0), 2.0), camera(place, degrees, 48, 32)
    other = replace(other, K=torch.tensor([[55.0, 0, 20], [0, 60, 17], [0, 0, 1]]))
    picture = np.fromfunction(lambda r, c: linear(r + 0.5, c + 0.5), (32, 48)).astype(np.float32)
    depth = np.full((14, 20), 2.5)
    if surface == "hills":
        depth += 0.5 * np.random.default_rng(0).random(depth.shape)
        (found,) = _warped(picture, other, own, depth / 1.25, np.array([1.25]))
    else:
        found = _warp(picture, other, own, 2.5)
    inside = 0
    for row, column in np.ndindex(14, 20):
        u, v, _ = seen_at(other, place_of(own, column + 0.5, row + 0.5, depth[row, column]))
        if 0.5 < u < 47.5 and 0.5 < v < 31.5:
            assert found[row, column] == pytest.approx(linear(v, u), abs=1e-3)  # OpenCV rounds to 1/32 of a pixel
            inside += 1
        elif not (-0.6 < u < 48.6 and -0.6 < v < 32.6):
            assert found[row, column] < -1
    assert 100 < inside < 280


def test_what_lies_behind_a_neighbor_is_not_seen():
    own, crossing, beyond = camera(), camera((0.0, 0.0, 2.4), 80.0, 24, 16), camera((0.0, 0.0, 5.0), 0.0, 24, 16)
    assert _warp(NEIGHBOR, beyond, own, 2.5) is None
    (surface,) = _warped(NEIGHBOR, beyond, own, np.full((14, 20), 2.5), np.ones(1))
    assert (surface < -1).all()
    plane = _warp(NEIGHBOR, crossing, own, 2.5)
    (surface,) = _warped(NEIGHBOR, crossing, own, np.full((14, 20), 2.5), np.ones(1))
    behind = 0
    for row, column in np.ndindex(14, 20):
        *_, z = seen_at(crossing, place_of(own, column + 0.5, row + 0.5, 2.5))
        if z < -0.05:
            assert plane[row, column] < -1
            assert surface[row, column] < -1
            behind += 1
    assert 50 < behind < 250
    assert plane.max() > 0


def test_points_are_seen_where_their_pixels_are():
    own = camera((0.5, -1.0, 2.0), 25.0)
    depth = 1 + np.random.default_rng(0).random((14, 20))
    points = unproject(own, depth).reshape(14, 20, 3)
    for row, column in ((0, 0), (3, 17), (13, 19), (7, 2)):
        found = seen_at(own, points[row, column])
        assert found == pytest.approx((column + 0.5, row + 0.5, depth[row, column]))
    found = stereo.DepthMap(own, depth, np.zeros((14, 20, 3)), depth > 0).points
    np.testing.assert_array_equal(found, points.reshape(-1, 3))


def test_costs_are_those_of_the_neighbors_on_the_planes(monkeypatch):
    """On the plane where the photographs were taken of, they agree; without any there is nothing to compare."""
    planes = np.array([1.0, 2.5, 6.0])
    assert (_costs(NEIGHBOR, camera(), [], planes) == np.float32(2.0)).all()
    random = np.random.default_rng(0).random((16, 24)).astype(np.float32)
    others = [camera((x, 0.0, 0.0), 0.0, 24, 16) for x in (-0.25, 0.25)]
    shown = [np.roll(random, 3 if x < 0 else -3, axis=1) for x in (-0.25, 0.25)]  # 30 * 0.25 / 2.5 pixels
    costs = _costs(random, camera(width=24, height=16), [*zip(shown, others, strict=True)], planes)
    middle = costs[:, 5:-5, 8:-8]
    assert middle.shape == (3, 6, 8)
    assert middle[1].max() < 0.05
    assert middle[[0, 2]].min() > 0.2


def test_planes_are_told_by_their_ratio():
    planes = 0.1 * 1.055 ** np.arange(9)
    costs = (0.01 * (np.arange(9.0) - 5.5) ** 2).astype(np.float32).reshape(9, 1, 1)
    assert _best(costs, planes)[0, 0] == pytest.approx(0.1 * 1.055**5.5, rel=1e-5)


# The maps.


@pytest.mark.parametrize(
    ("depths", "known"),
    [
        ((2.0, 2.0, 2.0), True),
        ((2.0, 2.0, 2.07), True),  # within 4 %
        ((2.0, 2.0, 1.93), True),
        ((2.0, 2.0, 2.09), False),  # one alone confirms nothing
        ((2.0, 2.0, 1.92), False),
        ((2.0, 2.0, 2.0, 2.3, 2.3), True),  # two see 12 % and more beyond the point, and two confirm it
        ((2.0, 2.0, 2.0, 2.3, 2.3, 2.3), False),
        ((2.0, 2.0, 2.0, 2.26, 2.26, 2.26), True),
        ((2.0, 2.0, 2.0, 1.0, 1.0, 1.0), True),  # hidden from there, which contradicts nothing
    ],
)
def test_points_are_known_that_others_confirm_more_than_contradict(depths, known):
    """One after the other of five cameras beside each other, of one wall: its depth is what each map says."""
    cameras = [camera((0.02 * k, 0.0, 0.0)) for k in range(len(depths))]
    _, found = _judge(0, np.arange(1, len(depths)), [np.full((14, 20), depth) for depth in depths], cameras)
    assert found.shape == (14, 20)
    assert bool(found[2:-2, 3:-3].all()) == known
    assert bool(found[2:-2, 3:-3].any()) == known


@pytest.mark.parametrize("block", [(3, 9, 4, 13), (0, 6, 0, 11), (7, 14, 9, 20)])
def test_a_point_is_looked_for_where_others_see_it(block):
    """Each of two others agrees in the pixels alone whose rays meet the point, at its edge too, and nowhere behind."""
    own, others = camera(), [camera((0.2, 0.0, 0.0)), camera((-0.2, 0.1, 0.0))]
    top, bottom, left, right = block
    maps, expected = [np.full((14, 20), 2.0)], np.ones((14, 20), bool)
    for other in others:
        seen = np.zeros((14, 20), bool)
        its = np.full((14, 20), 9.0)
        its[top:bottom, left:right] = 2.0
        for row, column in np.ndindex(14, 20):
            u, v, _ = seen_at(other, place_of(own, column + 0.5, row + 0.5, 2.0))
            seen[row, column] = left <= u < right and top <= v < bottom
        maps.append(its)
        expected &= seen
    assert 10 < expected.sum() < 80
    assert np.array_equal(_judge(0, np.array([1, 2]), maps, [own, *others])[1], expected)
    turned = [camera((0.0, 0.0, 0.0), 180.0)] * 2
    assert not _judge(0, np.array([1, 2]), [maps[0]] * 3, [own, *turned])[1].any()


def test_small_copies_are_means_of_their_pixels():
    image = np.random.default_rng(0).random((6, 9, 3)).astype(np.float32)
    found = stereo._shrink(image, (2, 3))
    np.testing.assert_allclose(found, image.reshape(2, 3, 3, 3, 3).mean(axis=(1, 3)), rtol=1e-5)


def test_maps_are_small_and_their_planes_follow_the_extent(monkeypatch):
    """Of 160 and 320 pixels at most, a window of 5 at least; from a tenth of the extent to thirty in steps of 5.5 %."""
    given, reports = [], []

    def costs(image, camera, others, planes):
        given.append((image, camera, len(others), planes))
        return np.ones((len(planes), *image.shape), np.float32)

    monkeypatch.setattr(stereo, "_costs", costs)
    refinement = []
    monkeypatch.setattr(stereo, "refined", lambda *rest: refinement.append(rest) or rest[0])
    sizes = [(320, 200), (100, 60), (1600, 20)]
    cameras = [camera((0.3 * k, 0.0, 0.0), 0.0, *size) for k, size in enumerate(sizes)]
    images = [np.full((height, width, 3), (0.1, 0.2, 0.6), np.float32) for width, height in sizes]
    maps = estimate_depth(images, cameras, 2.0, lambda *call: reports.append(call))
    assert [found.depth.shape for found in maps] == [(200, 320), (60, 100), (5, 320)]
    assert [found.camera.size for found in maps] == [(200, 320), (60, 100), (5, 320)]
    assert maps[0].camera.K[0, 0].item() == pytest.approx(30.0)
    assert sorted(image.shape for image, *_ in given) == [(5, 160), (60, 100), (100, 160)]
    assert all(image.shape == its_camera.size for image, its_camera, *_ in given)
    assert all(np.allclose(found.colors, (0.1, 0.2, 0.6)) for found in maps)
    given.sort(key=lambda call: call[0].shape)
    assert all(np.allclose(image, 0.3) and others == 2 for image, _, others, _ in given)
    for depth, image, camera_of_it, others in refinement:
        assert depth.shape == image.shape == camera_of_it.size
        assert [picture.shape for picture, _ in others] == [one.size for _, one in others]
        assert len(others) == 2
        assert all(not torch.equal(one.position, camera_of_it.position) for _, one in others)
    planes = given[0][3]
    assert planes[0] == pytest.approx(0.2)
    assert 60 / 1.055 < planes[-1] < 60
    np.testing.assert_allclose(planes[1:] / planes[:-1], 1.055)
    assert reports == [(done, 3, "comparing photographs") for done in range(3)]


@pytest.mark.parametrize(("off", "found"), [(0.966, True), (1.034, True), (0.953, False), (1.047, False)])
def test_depth_is_made_finer_within_its_reach(off, found):
    """A slanted wall: what is 3.4 % off comes within 0.1 %; the reach is two and a half steps of 1.2 and of 0.4 %."""
    random = np.random.default_rng(0)
    texture = random.random((60, 60)).astype(np.float32)
    cameras = [camera((x, y, 0.0), 0.0, 60, 44) for x, y in ((0.0, 0.0), (0.3, 0.05), (-0.3, 0.0), (0.05, 0.3))]
    cameras = [replace(one, K=torch.tensor([[60.0, 0, 30], [0, 60, 22], [0, 0, 1]])) for one in cameras]
    import cv2

    def wall(one: Camera):
        """z = 3 + 0.3 x, papered with a texture of 14 pixels a meter."""
        x, y = np.meshgrid((np.arange(60) + 0.5 - 30) / 60, (np.arange(44) + 0.5 - 22) / 60)
        px, py, _ = one.position.tolist()
        depth = (3 + 0.3 * px) / (1 - 0.3 * x)
        u, v = (14 * (place + 2) for place in (px + x * depth, py + y * depth))
        return cv2.remap(texture, u.astype(np.float32), v.astype(np.float32), cv2.INTER_CUBIC), depth

    pictures = [wall(one) for one in cameras]
    depth = pictures[0][1]
    others = [(picture, one) for (picture, _), one in zip(pictures[1:], cameras[1:], strict=True)]
    start = (off * depth).astype(np.float32)
    start[10, 10] = start[30, 40] = 9.0  # wrong ones among right ones
    error = np.abs(refined(start, pictures[0][0], cameras[0], others) / depth - 1)
    assert (np.median(error[6:-6, 6:-6]) < 0.001) == found
    assert max(error[10, 10], error[30, 40]) < 0.02
    assert refined(start, pictures[0][0], cameras[0], []) is start


def test_windows_of_the_median_are_of_five_pixels(monkeypatch):
    """Two wrong pixels beside each other in a line are taken out, a block of four by four is not."""
    seen = []
    monkeypatch.setattr(
        stereo_refinement, "_warped", lambda other, its, own, surface, moves: seen.append((surface, moves)) or []
    )
    depth = np.full((14, 20), 2.0, np.float32)
    depth[3, 3:5] = 9.0
    depth[5:9, 10:14] = 5.0
    refined(depth, depth, camera(), [(depth, SimpleNamespace())])
    assert len(seen) == 2
    assert seen[0][0][3, 3:5].tolist() == [2.0, 2.0]
    assert seen[0][0][6:8, 11:13].tolist() == [[5.0, 5.0]] * 2
    for (_, moves), step in zip(seen, (0.012, 0.004), strict=True):
        np.testing.assert_allclose(moves, 1 + step * np.arange(-3, 4))
