"""Depth where photographs agree, against surfaces that are known."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sgwarp.reconstruction import stereo
from sgwarp.reconstruction.stereo import estimate_depth
from sgwarp.scene import Camera


def test_depth_is_that_of_the_surface_in_any_unit(shots):
    shots, unit = shots[:5], 1e-3
    cameras = []
    for camera, _, _ in shots:
        pose = camera.world_to_camera.clone()
        pose[:3, 3] *= unit
        cameras.append(replace(camera, world_to_camera=pose))
    maps = estimate_depth([image for _, image, _ in shots], cameras, 1.4 * unit)
    for found, (_, _, depth) in zip(maps, shots, strict=True):
        sizes = zip(depth.shape, found.depth.shape, strict=True)
        rows, columns = (np.linspace(0, large - 1, small).round().astype(int) for large, small in sizes)
        error = np.abs(found.depth / (unit * depth[np.ix_(rows, columns)]) - 1)
        assert found.known.mean() > 0.6
        assert np.median(error[found.known]) < 0.02


def test_nothing_is_known_where_photographs_do_not_agree(shots):
    random, shots = np.random.default_rng(0), shots[:4]
    noise = [random.random(image.shape).astype(np.float32) for _, image, _ in shots]
    maps = estimate_depth(noise, [camera for camera, _, _ in shots], 1.4)
    assert np.mean([found.known.mean() for found in maps]) < 0.2


def test_one_photograph_alone_tells_nothing(shots):
    camera, image, _ = shots[0]
    (found,) = estimate_depth([image], [camera], 1.0)
    assert not found.known.any()


def test_depth_crosses_an_even_surface_from_its_border(shots):
    """A square of 1 m on one wall, all of one color: no window inside tells its depth."""
    images, inside = [], []
    for camera, image, depth in shots:
        x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(camera.K.numpy()).T
        at = camera.position.numpy() + depth[..., None] * (rays @ camera.world_to_camera[:3, :3].numpy())
        square = (np.abs(at[..., 0] - 0.8) < 0.5) & (np.abs(at[..., 1]) < 0.5)
        images.append(np.where(square[..., None], np.float32(0.5), image))
        inside.append(square)
    errors, known = [], []
    maps = estimate_depth(images, [camera for camera, _, _ in shots], 1.4)
    for found, square, (_, _, depth) in zip(maps, inside, shots, strict=True):
        sizes = zip(depth.shape, found.depth.shape, strict=True)
        rows, columns = (np.linspace(0, large - 1, small).round().astype(int) for large, small in sizes)
        own = square[np.ix_(rows, columns)]
        errors.append(np.abs(found.depth / depth[np.ix_(rows, columns)] - 1)[own & found.known])
        known.append(found.known[own])
    assert np.concatenate(known).mean() > 0.8
    assert np.median(np.concatenate(errors)) < 0.015


def camera_at(x, width=320, height=240):
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = -x
    K = torch.tensor([[300.0, 0, width / 2], [0, 300.0, height / 2], [0, 0, 1]], dtype=torch.float64)
    return Camera(K, pose, width, height)


@pytest.mark.parametrize(
    ("depths", "mean", "known"),
    [
        ((2.0, 2.04, 1.98), (1 + 1.02 + 0.99) / 3 * 2.0, True),  # both agree
        ((2.0, 2.04, 2.2), (1 + 1.02) / 2 * 2.0, False),  # one alone is not enough
        ((2.0, 2.04, 1.98, 3.0), (1 + 1.02 + 0.99) / 3 * 2.0, True),  # one sees through the point, two confirm it
        ((2.0, 2.04, 1.98, 3.0, 3.0, 3.0), (1 + 1.02 + 0.99) / 3 * 2.0, False),  # more see through it
        ((2.0, 2.04, 1.98, 1.0, 1.0, 1.0), (1 + 1.02 + 0.99) / 3 * 2.0, True),  # what is in front hides it
    ],
)
def test_depth_is_the_mean_of_the_photographs_that_agree(depths, mean, known):
    cameras = [camera_at(0.0) for _ in depths]
    maps = [np.full((240, 320), depth, np.float32) for depth in depths]
    depth, found = stereo._judge(0, np.arange(1, len(depths)), maps, cameras)
    np.testing.assert_allclose(depth, mean, rtol=1e-6)
    assert found.all() == known
    assert found.any() == known


def test_the_nearest_and_some_of_all_others_judge():
    cameras = [camera_at(0.01 * k) for k in range(200)]
    judges = stereo._choose_judges(cameras)
    assert judges[0].tolist()[:32] == list(range(1, 33))
    assert len(judges[0]) == 48
    assert judges[0].max() == 199
    assert 100 not in judges[100]
    assert len(set(judges[100].tolist())) == 48
    assert [sorted(own.tolist()) for own in stereo._choose_judges(cameras[:3])] == [[1, 2], [0, 2], [0, 1]]
    assert [own.tolist() for own in stereo._choose_judges(cameras[:1])] == [[]]


@pytest.mark.parametrize(("count", "longest"), [(3, 320), (150, 266), (2000, 160)])
def test_many_photographs_are_compared_on_smaller_copies(count, longest):
    assert stereo._fine_length([camera_at(0.0, 4000, 3000)] * count) == longest


def test_larger_copies_tell_depth_more_finely(shots, monkeypatch):
    """Against the same surfaces: by what share the median error falls."""
    errors = []
    for fine in (96, 256):
        monkeypatch.setattr(stereo, "LONGEST", 96)
        monkeypatch.setattr(stereo, "FINE", fine)
        maps = estimate_depth([image for _, image, _ in shots[:5]], [camera for camera, _, _ in shots[:5]], 1.4)
        assert {max(found.depth.shape) for found in maps} == {fine}
        own = []
        for found, (_, _, depth) in zip(maps, shots, strict=False):
            sizes = zip(depth.shape, found.depth.shape, strict=True)
            rows, columns = (((np.arange(small) + 0.5) * large / small).astype(int) for large, small in sizes)
            own.append(np.abs(found.depth / depth[np.ix_(rows, columns)] - 1)[found.known])
        errors.append(np.median(np.concatenate(own)))
    assert errors[1] < 0.7 * errors[0]
