"""Thresholds of the rasterizer and of projections: the last values that are taken, and the first that are refused."""

import math

import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.lifting.lifter import lift
from sgwarp.ops.neighbors import mean_squared_neighbor_distance
from sgwarp.ops.splatting.autograd import rasterize
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.querying.segmentation import segment

RANGES = {
    "alpha_min": ((2.0**-16, 0.998), (2.0**-17, 0.999, math.nan)),
    "alpha_max": ((0.5, 1.0 - 1e-6), (0.0, 1.0, 1.0 / 255.0)),
    "transmittance_min": ((0.0, 0.4), (-1e-9, 1.0)),
    "dilation": ((0.0, 9.0), (-1e-9, math.inf, math.nan)),
    "surface_opacity": ((1e-6, 0.9998), (0.0, 0.9999, 1.0)),
    "sh_degree": ((None, 0, 3), (-1, 4)),
}


@pytest.mark.parametrize("name", RANGES)
def test_ranges_of_the_thresholds(name):
    taken, refused = RANGES[name]
    for value in taken:
        assert getattr(RasterSettings(**{name: value}), name) == value
    for value in refused:
        with pytest.raises(InputError, match=r"^RasterSettings\.\w+ = .* is out of range"):
            RasterSettings(**{name: value})


def test_points_that_are_not_finite_are_named():
    points = torch.rand(5, 3)
    points[3, 1] = math.nan
    with pytest.raises(InputError, match=r"^points\[3\] = .*: not finite; remove such points first"):
        mean_squared_neighbor_distance(points)


@pytest.mark.parametrize("count", [255, 256])
def test_as_many_classes_as_an_image_has_numbers(stage, toy_text, count):
    """255 means unknown, so that 0 to 254 are left."""
    semantics = lift(stage.gaussians, stage.views[:1], stage.dense)
    names = [f"class {k}" for k in range(count)]
    if count == 256:
        with pytest.raises(InputError, match="classes: at most 255 at a time, got 256"):
            segment(stage.gaussians, semantics, names, stage.views[0].camera, toy_text)
        return
    labels, _ = segment(stage.gaussians, semantics, names, stage.views[0].camera, toy_text)
    assert labels.shape == (72, 96)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sh": None}, r"give sh \[N, K, 3\], features \[N, C\], or both"),
        ({"absgrad": True}, "absgrad: give means2d"),
        ({"schedule": "tiles"}, "schedule: expected 'lanes', 'block' or None, got 'tiles'"),
        ({"means2d": torch.zeros(3, 2)}, r"means2d: expected shape \[\d+, 2\], got \[3, 2\]"),
        ({"means": torch.zeros(3)}, r"means: expected floating point \[N, 3\]"),
    ],
)
def test_what_is_asked_of_the_rasterizer(stage, change, message):
    g, camera = stage.gaussians, stage.views[0].camera
    given = {"means": g.means, "quats": g.quats, "scales": g.scales, "opacities": g.opacities, "sh": g.sh} | change
    with pytest.raises(InputError, match=message):
        rasterize(viewmat=camera.world_to_camera, K=camera.K, width=camera.width, height=camera.height, **given)
