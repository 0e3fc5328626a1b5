"""What a rendering loads side by side is what it launches: no more, or compiling it would be in vain, and no less."""

import pytest
import torch
import warp as wp

import sgwarp as sg
from sgwarp.ops import launcher
from sgwarp.ops.splatting.forward import rasterize
from sgwarp.ops.splatting.lift_sums import LiftSums
from sgwarp.ops.splatting.lifting import lift_view
from sgwarp.scene import FeatureMap


@pytest.fixture
def modules(monkeypatch) -> tuple[set[str], set[str]]:
    """Names of modules that are loaded together from now on, and of those whose kernels are launched."""
    loaded: set[str] = set()
    launched: set[str] = set()
    load, launch = wp.force_load, wp.launch

    def spy_on_loading(device, *, modules, **options):
        loaded.update(module.name for module in modules)
        load(device, modules=modules, **options)

    def spy_on_launching(kernel, *arguments, **options):
        launched.add(kernel.module.name)
        return launch(kernel, *arguments, **options)

    monkeypatch.setattr(wp, "force_load", spy_on_loading)
    monkeypatch.setattr(wp, "launch", spy_on_launching)
    monkeypatch.setattr(launcher, "_loaded", set())
    monkeypatch.setattr(launcher, "_thread_count", 2)
    return loaded, launched


@pytest.mark.parametrize("backward", [False, True])
@pytest.mark.parametrize("harmonics", [False, True])
def test_a_rendering_loads_what_it_launches(make_scene, modules, backward, harmonics):
    loaded, launched = modules
    _, gaussians, camera = make_scene("random_cloud")
    leaves = [getattr(gaussians, name).clone() for name in ("means", "quats", "scales", "opacities")]
    leaves[0].requires_grad_(backward)
    values = {"sh": gaussians.sh} if harmonics else {"features": torch.rand(len(gaussians), 3)}
    seen = sg.rasterize(*leaves, camera.world_to_camera, camera.K, camera.width, camera.height, **values)
    if backward:
        (seen.features.sum() + seen.alpha.sum()).backward()
    assert launched
    assert loaded == launched


def test_what_is_loaded_is_not_loaded_again(make_scene, modules):
    loaded, _ = modules
    _, gaussians, camera = make_scene("random_cloud")
    first = sg.render(gaussians, camera)
    assert loaded
    loaded.clear()
    assert torch.equal(sg.render(gaussians, camera), first)
    assert not loaded


@pytest.mark.parametrize("channels", [4, 64, 80, 160])
@pytest.mark.parametrize("depth", [False, True])
def test_many_channels_load_what_they_launch(make_scene, modules, channels, depth):
    loaded, launched = modules
    _, gaussians, camera = make_scene("random_cloud")
    rasterize(gaussians, camera, features=torch.rand(len(gaussians), channels), expected_depth=depth)
    assert launched
    assert loaded == launched


@pytest.mark.parametrize("mode", ["weighted", "squared"])
@pytest.mark.parametrize("channels", [0, 3, 80, 160])
def test_lifting_loads_what_it_launches(make_scene, modules, mode, channels):
    """No channels are an id map."""
    loaded, launched = modules
    _, gaussians, camera = make_scene("random_cloud")
    if channels:
        found = FeatureMap("x", dense=torch.rand(camera.height, camera.width, channels))
    else:
        found = FeatureMap("labels", ids=torch.zeros(camera.size, dtype=torch.int32), labels=("chair",))
    lift_view(gaussians, camera, found, LiftSums.zeros(len(gaussians), found.channels), mode=mode)
    assert launched
    assert loaded == launched
