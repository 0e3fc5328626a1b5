"""Where photographs agree a fit starts from flat Gaussians on the surface, few points or none beside them."""

import numpy as np
import pytest
import torch

from sgwarp.reconstruction.fitting import initial
from sgwarp.reconstruction.fitting.photographs import Photograph
from sgwarp.reconstruction.fitting.settings import FitSettings
from sgwarp.reconstruction.stereo import DepthMap
from sgwarp.scene import Camera

HEIGHT, WIDTH, DEPTH = 30, 40, 2.0
K = torch.tensor([[40.0, 0, 20], [0, 40, 15], [0, 0, 1]])


@pytest.fixture
def wall(monkeypatch):
    """Three photographs of a wall 2 m in front of them, red on its left and blue on its right; all depth is known."""
    camera = Camera(K, torch.eye(4, dtype=torch.float64), WIDTH, HEIGHT)
    colors = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    colors[:, :20, 0] = colors[:, 20:, 2] = 1.0
    depth = np.full((HEIGHT, WIDTH), DEPTH, np.float32)
    maps = [DepthMap(camera, depth, colors, np.ones(depth.shape, bool)) for _ in range(3)]
    monkeypatch.setattr(initial, "estimate_depth", lambda *rest: maps)
    pixels = torch.from_numpy((colors * 255).astype(np.uint8))
    return [Photograph("a", camera, pixels) for _ in range(3)]  # of one name: nothing may be looked up by it


@pytest.mark.parametrize(("strategy", "opacity"), [("mcmc", 0.5), ("default", 0.1)])
def test_surfaces_become_flat_gaussians_of_their_colors(wall, strategy, opacity):
    found = initial.gaussians_from_photographs(wall, FitSettings(strategy=strategy, cap=600), 1.0)
    assert len(found) <= (600 if strategy == "mcmc" else 300)
    assert len(found) > 30
    torch.testing.assert_close(found.means[:, 2], torch.full((len(found),), DEPTH))
    normal = found.scales.amin(dim=1) / found.scales.amax(dim=1)
    assert normal.max() < 0.11
    torch.testing.assert_close(found.opacities, torch.full((len(found),), opacity))
    colors = found.sh[:, 0] * 0.28209479177387814 + 0.5
    inside = found.means[:, 0].abs() > 0.1
    left = found.means[:, 0] < 0
    torch.testing.assert_close(colors[inside & left], torch.tensor([[1.0, 0, 0]]).expand(int((inside & left).sum()), 3))
    torch.testing.assert_close(
        colors[inside & ~left], torch.tensor([[0, 0, 1.0]]).expand(int((inside & ~left).sum()), 3)
    )


def test_what_a_mask_hides_is_no_surface(wall):
    mask = torch.ones(HEIGHT, WIDTH, dtype=torch.uint8)
    mask[:, :20] = 0
    masked = [Photograph("a", p.camera, p.stored, mask) for p in wall]
    found = initial.gaussians_from_photographs(masked, FitSettings(cap=600), 1.0)
    assert (found.means[:, 0] > 0).all()


def test_few_points_keep_their_places_and_are_no_larger_than_the_gaps_around_them(wall):
    points = torch.tensor(
        [[0.0, 0.0, 1.9], [0.3, 0.2, 1.9], [-0.4, 0.1, 1.9], [0.2, -0.3, 1.9], [0.0, 0.0, 60.0]]
    ).double()
    colors = torch.full((5, 3), 0.25)
    found = initial.completed(points, colors, wall, FitSettings(cap=600), 1.0, lambda *call: None)
    torch.testing.assert_close(found.means[:5].double(), points)
    torch.testing.assert_close(found.sh[:5, 0] * 0.28209479177387814 + 0.5, colors)
    assert 100 < len(found) <= 600
    surface = found.means[5:].double()
    for place, size in zip(points, found.scales[:5], strict=True):
        nearest = torch.cat([surface, points])
        distance = (nearest - place).norm(dim=1)
        distance = distance.sort().values[1:4].square().mean().sqrt()  # but itself
        torch.testing.assert_close(size.double(), distance.expand(3), rtol=1e-5, atol=0)


def test_few_points_are_all_there_is_where_photographs_agree_nowhere(monkeypatch, wall):
    nothing = [
        DepthMap(p.camera, np.ones((HEIGHT, WIDTH), np.float32), None, np.zeros((HEIGHT, WIDTH), bool)) for p in wall
    ]
    monkeypatch.setattr(initial, "estimate_depth", lambda *rest: nothing)
    points = torch.rand(20, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    found = initial.completed(points, torch.zeros(20, 3), wall, FitSettings(cap=600), 1.0, lambda *call: None)
    alone = initial.gaussians_from_points(points, torch.zeros(20, 3), FitSettings(cap=600), 1.0)
    for name in ("means", "scales", "opacities", "sh"):
        assert torch.equal(getattr(found, name), getattr(alone, name))
