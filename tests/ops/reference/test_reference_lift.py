"""The float64 oracle of lifting: transposition, and the centre mode case by case."""

import pytest
import torch

from sgwarp.ops.reference.lifting import lift_center, lift_weighted, transpose_composite
from sgwarp.ops.reference.rasterizer import composite, project_scene
from sgwarp.scene import Camera, Gaussians

pytestmark = pytest.mark.slow


def test_lifting_is_the_transpose_of_rendering(scene):
    """<A x, y> = <x, A^T y>, with and without invalid pixels."""
    rng = torch.Generator().manual_seed(0)
    g, cam = scene.gaussians, scene.camera
    x = torch.randn(len(g), 5, generator=rng, dtype=torch.float64)
    y = torch.randn(cam.height, cam.width, 5, generator=rng, dtype=torch.float64)
    valid = torch.rand(cam.height, cam.width, generator=rng) < 0.7
    projection = project_scene(g, cam)
    raster = composite(projection, x, cam.width, cam.height)
    for mask in (None, valid):
        lifted = transpose_composite(projection, len(g), y, mask)
        on = torch.ones_like(valid) if mask is None else mask
        torch.testing.assert_close((raster.features * y)[on].sum(), (x * lifted.features).sum(), rtol=1e-10, atol=1e-10)
        torch.testing.assert_close(lifted.weight.sum(), raster.alpha[on].sum(), rtol=1e-10, atol=1e-10)


def test_weighted_lifting_of_a_constant_is_that_constant(make_scene):
    _, g, cam = make_scene("overlapping")
    value = torch.tensor([0.25, -2.0])
    lifted = lift_weighted(g, cam, value.expand(cam.height, cam.width, 2))
    seen = lifted.weight > 0
    assert seen.float().mean() > 0.9
    means = lifted.features[seen] / lifted.weight[seen, None]
    torch.testing.assert_close(means, value.double().expand_as(means))
    assert (lifted.features[~seen] == 0).all()


def wall_and_posts() -> tuple[Gaussians, Camera]:
    """An opaque wall at depth 4 in the whole image, and small Gaussians in front of, on and behind it."""
    centres = [
        [0.0, 0.0, 4.0],  # 0: the wall
        [0.40, 0.0, 4.1],  # 1: just behind its surface: visible within tau = 0.05
        [0.0, 0.40, 5.0],  # 2: far behind: hidden
        [0.0, -0.4, 3.0],  # 3: faint, far in front: not the surface
        [1.55, 0.0, 4.0],  # 4: on the wall, in the border of 10 pixels
        [9.00, 0.0, 4.0],  # 5: outside the image
    ]
    scales = torch.tensor([[40.0, 40.0, 0.001]] + [[0.05, 0.05, 0.05]] * 5)
    opacities = torch.tensor([0.95, 0.5, 0.5, 0.1, 0.5, 0.5])
    g = Gaussians(torch.tensor(centres), torch.tensor([[1.0, 0, 0, 0]] * 6), scales, opacities, torch.zeros(6, 1, 3))
    return g, Camera(torch.tensor([[40.0, 0, 60.4], [0, 40.0, 40.6], [0, 0, 1]]), torch.eye(4), 80, 80)


def test_centre_mode_tests_depth_and_border():
    g, cam = wall_and_posts()
    rows, columns = torch.meshgrid(torch.arange(80.0), torch.arange(80.0), indexing="ij")
    image = torch.stack([rows, columns], dim=-1)
    lifted = lift_center(g, cam, image)
    assert lifted.weight.tolist() == [1, 1, 0, 0, 0, 0]
    assert lifted.features[0].tolist() == [40, 60]  # centre at (60.4, 40.6)
    assert lifted.features[1].tolist() == [40, 64]  # 40 * 0.4 / 4.1 + 60.4 = 64.3
    assert (lifted.features[2:] == 0).all()

    assert lift_center(g, cam, image, tau=0.01).weight.tolist() == [1, 0, 0, 0, 0, 0]
    assert lift_center(g, cam, image, tau=0.30).weight.tolist() == [1, 1, 1, 1, 0, 0]
    assert lift_center(g, cam, image, border=0).weight.tolist() == [1, 1, 0, 0, 1, 0]
    invalid = torch.ones(80, 80, dtype=torch.bool)
    invalid[40, 64] = False
    assert lift_center(g, cam, image, invalid).weight.tolist() == [1, 0, 0, 0, 0, 0]


def test_centre_mode_needs_a_surface():
    """Where accumulated opacity never reaches one half there is no surface, and nothing is visible."""
    g, cam = wall_and_posts()
    faint = g.subset(torch.tensor([3]))
    lifted = lift_center(faint, cam, torch.ones(80, 80, 1), tau=1e6)
    assert lifted.weight.tolist() == [0]


def test_centre_mode_margin_names_close_decisions():
    g, cam = wall_and_posts()
    image = torch.ones(80, 80, 1)
    margin = lift_center(g, cam, image, tau=0.1 / 4.0 + 1e-9).margin
    assert margin[1] < 1e-5  # |4.0 - 4.1| = 0.1 against tau 4.0
    assert margin[0] > 0.1
    assert torch.isinf(margin[5])
