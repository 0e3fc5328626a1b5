"""What a rendering loads side by side is what it launches: no more, or compiling it would be in vain, and no less."""

import threading

import pytest
import torch
import warp as wp

import sgwarp as sg
from sgwarp.ops.splatting.forward import rasterize
from sgwarp.ops.splatting.lift_sums import LiftSums
from sgwarp.ops.splatting.lifting import lift_view
from sgwarp.scene import FeatureMap


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


def test_one_thread_loads_what_is_compiled_alike(make_scene, modules, monkeypatch):
    """Headers are compiled once for each thread and set of options."""
    threads: dict[str, set[int]] = {}
    load = wp.force_load

    def spy(device, *, modules, **options):
        for module in modules:
            threads.setdefault(module.options["cpu_compiler_flags"], set()).add(threading.get_ident())
        load(device, modules=modules, **options)

    monkeypatch.setattr(wp, "force_load", spy)
    _, gaussians, camera = make_scene("random_cloud")
    for channels in (3, 16, 64):
        rasterize(gaussians, camera, features=torch.rand(len(gaussians), channels), expected_depth=True)
    assert len(threads) == 2
    assert [len(idents) for idents in threads.values()] == [1, 1]
    first, second = threads.values()
    assert first.isdisjoint(second)
