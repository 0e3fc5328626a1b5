"""How far an orbit lies, and why renderings and photographs do not match."""

import math
from pathlib import Path

import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.rendering.agreement import Agreement, _say
from sgwarp.rendering.orbits import orbit_views
from sgwarp.rendering.renderer import plan
from sgwarp.scene import Gaussians


def gaussians(means) -> Gaussians:
    count = len(means)
    shapes = {"quats": (4,), "scales": (3,), "opacities": (), "sh": (1, 3)}
    return Gaussians(means, **{name: torch.full((count, *shape), 0.5) for name, shape in shapes.items()})


@pytest.mark.parametrize(("width", "height"), [(80, 60), (60, 80)])
def test_an_orbit_is_as_far_as_the_scene_fits_its_field_of_view(width, height):
    """Of 100 points on a ball of radius 2 and 3 strays far out; 50 degrees along the shorter side, 15 above."""
    random = torch.Generator().manual_seed(1)
    ball = 2 * torch.nn.functional.normalize(torch.randn(200, 3, generator=random), dim=1)
    means = torch.cat([ball, -ball, torch.tensor([[90.0, 0, 0]] * 3), torch.zeros(1, 3)])
    scene = gaussians(means)
    center = means.double().median(dim=0).values
    radius = (means.double() - center).norm(dim=1).sort().values[int(0.95 * 403)].item()
    assert radius == pytest.approx(2, abs=0.3)
    for view in orbit_views(scene, 3, width, height, up="z-up"):
        away = view.camera.position - center
        assert away.norm().item() == pytest.approx(radius / math.sin(math.radians(25)))
        assert away[2].item() == pytest.approx(away.norm().item() * math.sin(math.radians(15)))
        assert view.camera.K[0, 0].item() == pytest.approx(30 / math.tan(math.radians(25)))
        assert view.camera.near == pytest.approx(away.norm().item() / 1000)


def test_directions_and_modes_are_named():
    scene = gaussians(torch.zeros(4, 3))
    with pytest.raises(InputError, match="up: 'x-up' is not one of y-down, y-up, z-up, z-down"):
        orbit_views(scene, 1, 4, 4, up="x-up")
    with pytest.raises(InputError, match="mode: 'depths' is not one of rgb"):
        plan(scene, "depths")


@pytest.mark.parametrize(
    ("correlation", "reordered", "matching", "order"),
    [
        (0.41, 0.9, True, True),  # the order may be wrong, but nobody asks
        (0.39, 0.58, False, False),  # hardly better
        (0.39, 0.60, False, True),
        (0.0, 0.39, False, False),  # which is chance
        (0.0, 0.41, False, True),
        (math.nan, math.nan, True, False),
    ],
)
def test_why_renderings_and_photographs_do_not_match(caplog, correlation, reordered, matching, order):
    found = Agreement(correlation, 4, reordered)
    assert found.matches == matching
    _say(Path("a.ply"), found)
    assert ("their order may be wrong" in caplog.text) == order
    assert ("different worlds" in caplog.text) != order
    assert ("--transform" in caplog.text) != order
