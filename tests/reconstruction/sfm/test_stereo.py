"""Depth where photographs agree, against surfaces that are known."""

from dataclasses import replace

import numpy as np

from sgwarp.reconstruction.stereo import estimate_depth


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
