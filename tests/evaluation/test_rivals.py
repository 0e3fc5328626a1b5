"""Rivals of lifting on the stage: nearest points against brute force, and features fitted by gradient descent."""

import numpy as np
import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.evaluation.rivals.nearest_points import OPAQUE, TOLERANCE, fuse_nearest_points
from sgwarp.evaluation.rivals.optimization import fit_features
from sgwarp.lifting.lifter import lift
from sgwarp.ops.splatting.forward import rasterize
from sgwarp.runs.log import RunLog
from sgwarp.scene import FeatureMap, Gaussians


def half_transparent(stage) -> Gaussians:
    """The stage with every third Gaussian too thin to be a point."""
    g = stage.gaussians
    thin = torch.where(torch.arange(len(g)) % 3 == 0, 0.3, g.opacities)
    return Gaussians(g.means, g.quats, g.scales, thin, g.sh)


def test_every_gaussian_has_the_feature_of_its_nearest_point(stage):
    scene, noise = half_transparent(stage), torch.Generator().manual_seed(0)
    maps = {
        view.stem: FeatureMap("t", dense=torch.randn(*view.camera.size, 4, generator=noise)) for view in stage.views
    }
    found = fuse_nearest_points(scene, stage.views, maps)
    fused = lift(scene, stage.views, maps, "center", tau=TOLERANCE, border=0)
    points = np.flatnonzero((fused.seen & (scene.opacities >= OPAQUE)).numpy())
    means = scene.means.double().numpy()
    for row in range(0, len(scene), 211):
        distance = np.linalg.norm(means[points] - means[row], axis=1)
        nearest = points[distance < distance.min() + 1e-9]  # neighbors on a grid may be equally near
        assert any(torch.equal(found.features[row], fused.features[k]) for k in nearest)
    assert found.coverage == 1.0


@pytest.mark.parametrize("channels", [None, 3])
def test_features_are_fitted_to_the_maps(stage, channels):
    seen, log = [], RunLog()
    options = {"steps": 60, "channels": channels, "look": seen.append, "look_at": (5, 60)}
    fitted = fit_features(stage.gaussians, stage.views[:5], stage.one_hot, log=log, **options)
    view = stage.views[5]
    truth = stage.labels(view)
    rendered = rasterize(stage.gaussians, view.camera, fitted.features).features
    right = (rendered.argmax(dim=2) + 1 == truth)[truth > 0].float().mean()
    assert right > (0.93 if channels is None else 0.85)
    assert [at.step for at in seen] == [5, 60]
    assert "fit" in log.stages
    assert 0 < seen[0].seconds < seen[1].seconds
    assert torch.equal(seen[1].features, fitted.features)
    assert not torch.equal(seen[0].features, fitted.features)
    assert fitted.labels == ("1", "2", "3", "4")
    options = options | {"steps": 5, "look_at": ()}
    again = fit_features(stage.gaussians, stage.views[:5], stage.one_hot, **options)
    assert torch.equal(again.features, seen[0].features)


def test_what_no_view_sees_stays_unseen(stage):
    view = stage.views[0]
    nothing = torch.full(view.camera.size, -1)
    nothing[30:40, 40:50] = 0
    maps = {view.stem: FeatureMap("t", ids=nothing, vectors=torch.ones(1, 3))}
    fitted = fit_features(stage.gaussians, [view], maps, steps=3)
    assert 0 < fitted.coverage < 0.2
    assert (fitted.features[~fitted.seen] == 0).all()


def test_what_any_step_sees_is_seen(stage):
    """Two views that show different things, one step each."""
    views, maps = stage.views[:2], {}
    for view, rows in zip(views, (slice(0, 20), slice(-20, None)), strict=True):
        ids = torch.full(view.camera.size, -1)
        ids[rows] = 0
        maps[view.stem] = FeatureMap("t", ids=ids, vectors=torch.ones(1, 3))
    one, other = (fit_features(stage.gaussians, [view], maps, steps=1).seen for view in views)
    assert bool((one & ~other).any())
    assert bool((other & ~one).any())
    assert torch.equal(fit_features(stage.gaussians, views, maps, steps=2).seen, one | other)


def test_refusals(stage):
    with pytest.raises(InputError, match="steps and channels"):
        fit_features(stage.gaussians, stage.views, stage.one_hot, steps=0)
    with pytest.raises(InputError, match="no feature map"):
        fit_features(stage.gaussians, stage.views, {})
