"""Every mode of render against the geometry of the stage, and the orbit around a scene."""

import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.rendering.orbits import UP, orbit_views
from sgwarp.rendering.renderer import render


def interior(mask, by=5):
    """Pixels at least by // 2 away from the rim of the mask."""
    return -torch.nn.functional.max_pool2d(-mask.float()[None], by, 1, by // 2)[0] > 0


def test_rgb_shows_the_panels_colours(stage):
    view = stage.views[1]
    image, labels = render(stage.gaussians, view.camera), stage.labels(view)
    assert image.shape == (*view.camera.size, 3)
    for number, colour in ((1, (0.8, 0.8, 0.7)), (2, (0.7, 0.2, 0.1)), (4, (0.1, 0.3, 0.8))):
        seen = image[interior(labels == number)]
        # About 4 % of what is behind a panel shines through its Gaussians of opacity 0.95.
        torch.testing.assert_close(seen.median(dim=0).values, torch.tensor(colour), atol=0.05, rtol=0)


def test_depths_are_those_of_the_panels(stage):
    view = stage.views[0]
    truth, inside = stage.depth(view), interior(stage.labels(view) == 2)
    for mode, tolerance in (("depth", 0.03), ("expected_depth", 0.15)):
        depth = render(stage.gaussians, view.camera, mode)
        assert depth.shape == view.camera.size
        assert (depth[inside] - truth[inside]).abs().max() < tolerance
    surface = render(stage.gaussians, view.camera, "depth")
    assert (surface[interior(torch.isinf(truth))] == 0).all()


def test_alpha_and_background(stage):
    view = stage.views[0]
    alpha = render(stage.gaussians, view.camera, "alpha")
    white = render(stage.gaussians, view.camera, background=torch.ones(3))
    black = render(stage.gaussians, view.camera)
    torch.testing.assert_close(white - black, (1 - alpha)[..., None].expand(-1, -1, 3), atol=1e-5, rtol=0)


@pytest.mark.parametrize("channels", [1, 3, 5, 40])
def test_features_are_linear(stage, channels):
    camera = stage.views[0].camera
    values = torch.rand(len(stage.gaussians), channels, generator=torch.Generator().manual_seed(1))
    one = render(stage.gaussians, camera, "features", values)
    assert one.shape == (*camera.size, channels)
    torch.testing.assert_close(render(stage.gaussians, camera, "features", 2 * values), 2 * one, atol=1e-5, rtol=1e-5)
    alpha = render(stage.gaussians, camera, "alpha")
    ones = render(stage.gaussians, camera, "features", torch.ones_like(values))
    torch.testing.assert_close(ones, alpha[..., None].expand_as(ones), atol=1e-5, rtol=0)


def test_refusals(stage):
    camera = stage.views[0].camera
    with pytest.raises(InputError, match="mode: 'normals'"):
        render(stage.gaussians, camera, "normals")
    with pytest.raises(InputError, match="mode 'features'"):
        render(stage.gaussians, camera, "features")
    with pytest.raises(InputError, match="mode 'rgb'"):
        render(stage.gaussians, camera, "rgb", torch.ones(len(stage.gaussians), 3))


@pytest.mark.parametrize("up", sorted(UP))
def test_orbit_looks_at_the_scene_from_all_sides(stage, up):
    views = orbit_views(stage.gaussians, 4, 80, 60, up=up)
    assert [view.stem for view in views] == ["orbit_000", "orbit_001", "orbit_002", "orbit_003"]
    centre = stage.gaussians.means.double().median(dim=0).values
    upward = torch.tensor(UP[up]).double()
    places = torch.stack([view.camera.position for view in views])
    for view in views:
        in_camera = view.camera.world_to_camera[:3, :3] @ centre + view.camera.world_to_camera[:3, 3]
        torch.testing.assert_close(in_camera[:2], torch.zeros(2).double(), atol=1e-5, rtol=0)
        assert in_camera[2] > 0
        assert (view.camera.world_to_camera[:3, :3] @ upward)[1] < -0.5  # up in the world is up in the image
        assert (view.camera.position - centre) @ upward > 0
        visible = render(stage.gaussians, view.camera, "alpha") > 0.5
        assert visible.float().mean() > 0.02
    torch.testing.assert_close(places.mean(dim=0) - centre, (places.mean(dim=0) - centre) @ upward * upward)


def test_orbit_refusals(stage):
    with pytest.raises(InputError, match="one view or more"):
        orbit_views(stage.gaussians, 0, 80, 60)
    with pytest.raises(InputError, match="'x-up' is not one of"):
        orbit_views(stage.gaussians, 1, 80, 60, up="x-up")
    with pytest.raises(InputError, match="no finite Gaussian"):
        orbit_views(stage.gaussians.subset(torch.zeros(0, dtype=torch.int64)), 1, 80, 60)
