"""What every walk over the views shares: the thresholds of the rasterizer, and the resolution of the maps."""

from dataclasses import replace

import pytest
import torch

from sgwarp.lifting import lifter, residuals, ridge, robust
from sgwarp.lifting.lifter import lift
from sgwarp.lifting.map_reader import MapReader, as_source
from sgwarp.lifting.ridge import Problem
from sgwarp.lifting.settings import LiftSettings
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.runs.log import RunLog
from sgwarp.scene import FeatureMap

WALKS = (
    (lifter, "lift_view"),
    (robust, "lift_view"),
    (ridge, "lift_view"),
    (ridge, "rasterize"),
    (residuals, "render"),
)


@pytest.mark.parametrize("reliability", [False, True])
@pytest.mark.parametrize("mode", ["weighted", "center", "strongest", "robust", "solve"])
def test_thresholds_reach_every_walk(stage, monkeypatch, mode, reliability):
    asked = []

    def spy(real):
        def spied(*arguments, **options):
            asked.append(options["settings"])
            return real(*arguments, **options)

        return spied

    for module, name in WALKS:
        monkeypatch.setattr(module, name, spy(getattr(module, name)))
    given = RasterSettings(alpha_min=0.02)
    options = LiftSettings(passes=1, iterations=1, reliability=reliability)
    lift(stage.gaussians, stage.views[:4], stage.one_hot, mode, settings=given, lift_settings=options)
    assert len(asked) >= 4
    assert all(one is given for one in asked)


def test_the_ridge_problem_is_posed_at_the_resolution_of_the_maps(stage):
    """Maps of half the size, seen by the views or by cameras of that size: the same matrix and right-hand side."""
    random = torch.Generator().manual_seed(1)
    half = (stage.views[0].camera.height // 2, stage.views[0].camera.width // 2)
    views = stage.views[:2]
    maps = {view.stem: FeatureMap("t", dense=torch.randn(*half, 3, generator=random)) for view in views}
    features = torch.randn(len(stage.gaussians), 3, generator=random)

    def posed(views):
        reader = MapReader(stage.gaussians, as_source(maps), RasterSettings(), RunLog())
        problem = Problem(reader, views, {"0000": 0.5})
        return problem.diagonal(), problem.normal_product(features), problem.gradient(features, slice(0, 3))

    small = [replace(view, camera=view.camera.resized(*half)) for view in views]
    for one, other in zip(posed(views), posed(small), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-4)
        assert one.any()
