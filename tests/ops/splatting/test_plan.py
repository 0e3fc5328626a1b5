"""What a plan leaves out, and that leaving out does not change what was asked for."""

import dataclasses

import pytest
import torch

import sgwarp as sg
from sgwarp.ops.splatting import forward
from sgwarp.ops.splatting.autograd import rasterize
from sgwarp.ops.splatting.plan import plan_render
from sgwarp.scene import Gaussians


def with_degree(gaussians: Gaussians, degree: int, used: int) -> Gaussians:
    """The scene with coefficients up to `degree`, of which those above `used` are zero."""
    rng = torch.Generator().manual_seed(0)
    sh = 0.2 * torch.randn(len(gaussians), (degree + 1) ** 2, 3, generator=rng)
    sh[:, (used + 1) ** 2 :] = 0.0
    return dataclasses.replace(gaussians, sh=sh)


@pytest.mark.parametrize("used", [0, 1, 2, 3])
def test_harmonics_that_are_zero_everywhere_are_left_out(make_scene, used):
    _, gaussians, camera = make_scene("random_cloud")
    gaussians = with_degree(gaussians, 3, used)
    plan = plan_render(gaussians)
    assert plan.sh_degree == used
    assert dict(plan.left_out).get("harmonics", 0) == 16 - (used + 1) ** 2
    everything = dataclasses.replace(plan, sh_degree=3)
    less = forward.rasterize(gaussians, camera, plan=plan)
    more = forward.rasterize(gaussians, camera, plan=everything)
    assert torch.equal(less.features, more.features)


def test_one_coefficient_is_enough_to_keep_its_degree(make_scene):
    _, gaussians, _ = make_scene("random_cloud")
    gaussians = with_degree(gaussians, 3, 0)
    gaussians.sh[len(gaussians) // 2 + 1, 6, 1] = 1e-30
    assert plan_render(gaussians).sh_degree == 2
    assert plan_render(gaussians, settings=sg.RasterSettings(sh_degree=1)).sh_degree == 1
    assert plan_render(with_degree(gaussians, 3, 0), look=False).sh_degree == 3


@pytest.mark.parametrize("mode", ["alpha", "depth", "expected_depth"])
def test_no_colours_where_nobody_asked_for_them(make_scene, mode):
    _, gaussians, camera = make_scene("sh3")
    plan = sg.plan(gaussians, mode)
    assert plan.values == "nothing"
    assert dict(plan.left_out)["colors"] == 3
    everything = forward.rasterize(gaussians, camera, expected_depth=True, depth=True)
    assert torch.equal(sg.render(gaussians, camera, mode), getattr(everything, mode))


def test_no_depth_and_no_records_where_nobody_asked_for_them(make_scene):
    _, gaussians, camera = make_scene("random_cloud")
    plain = forward.rasterize(gaussians, camera)
    assert plain.depth is None
    assert plain.expected_depth is None
    deep = forward.rasterize(gaussians, camera, depth=True)
    assert torch.equal(plain.features, deep.features)
    names = ("means", "quats", "scales", "opacities")
    leaves = [getattr(gaussians, name).clone().requires_grad_() for name in names]
    recorded = rasterize(*leaves, camera.world_to_camera, camera.K, camera.width, camera.height, sh=gaussians.sh)
    assert recorded.features.requires_grad
    assert torch.equal(plain.features, recorded.features)


def test_scores_in_place_of_features(make_scene):
    """Splatting is linear: a query needs its own channel, not those of the features it was asked of."""
    _, gaussians, camera = make_scene("random_cloud")
    rng = torch.Generator().manual_seed(0)
    features, query = torch.randn(len(gaussians), 96, generator=rng), torch.randn(96, 2, generator=rng)
    late = sg.render(gaussians, camera, "features", features) @ query
    early = sg.render(gaussians, camera, "features", features @ query)
    torch.testing.assert_close(early, late, rtol=0, atol=2e-5 * float(late.abs().max()))


def test_a_plan_says_what_it_does(make_scene):
    _, gaussians, camera = make_scene("random_cloud")
    text = str(sg.plan(with_degree(gaussians, 3, 0)))
    assert "harmonics of degree 0" in text
    assert "15 coefficients per Gaussian" in text
    assert "2 depth images" in text
    features = torch.zeros(len(gaussians), 1)
    assert "1 feature channel," not in str(sg.plan(gaussians, "features", features))
    assert "1 feature channel;" in str(sg.plan(gaussians, "features", features))
    with pytest.raises(dataclasses.FrozenInstanceError):
        sg.plan(gaussians).depth = True
    log = sg.RunLog()
    sg.render(with_degree(gaussians, 2, 1), camera, log=log)
    assert log.left_out["harmonics_per_gaussian_that_are_zero"] == 5
    assert log.left_out["depth_images_not_asked_for"] == 2


def test_a_scene_that_was_written_to_is_looked_at_again(make_scene):
    _, gaussians, camera = make_scene("random_cloud")
    gaussians = with_degree(gaussians, 3, 0)
    assert plan_render(gaussians).sh_degree == 0
    assert bool(gaussians.finite.all())
    before = gaussians.fingerprint
    gaussians.sh.copy_(with_degree(gaussians, 3, 3).sh)
    assert plan_render(gaussians).sh_degree == 3
    fresh = Gaussians(gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    assert torch.equal(sg.render(gaussians, camera), sg.render(fresh, camera))
    gaussians.sh[5, 0, 0] = torch.nan
    assert int(gaussians.finite.sum()) == len(gaussians) - 1
    gaussians.means[0, 0] += 1.0
    assert gaussians.fingerprint != before
