"""Fitting, lifting, asking, distillation and the commands on a pretended CUDA device."""

import pytest
import torch

import sgwarp as sg
from sgwarp.io.views import load_views
from sgwarp.reconstruction.fitting import loop
from sgwarp.reconstruction.fitting.settings import FitSettings

STEPS = 10


def fitted(files, **options):
    views = load_views(files.views)
    start = files.gaussians.subset(torch.arange(0, len(files.gaussians), 40))
    settings = {"steps": STEPS, "cap": 150, "refine_every": 4, "evaluate_every": 5} | options.pop("settings", {})
    return sg.fit(views[:4], start, views[4:], FitSettings(**settings), **options)


@pytest.mark.parametrize(
    "settings", [{}, {"strategy": "default", "background": "random"}, {"exposure": True, "sparse": False}], ids=str
)
def test_fit_gives_what_the_cpu_gives(settings, stage_files, tmp_path, pretended_cuda):
    here = fitted(stage_files, settings=settings)
    there = fitted(stage_files, settings=settings, device="cuda", checkpoint=tmp_path / "state")
    assert there.gaussians.means.is_cuda
    assert len(there.gaussians) == len(here.gaussians)
    torch.testing.assert_close(there.curve[0].psnr, here.curve[0].psnr, rtol=0, atol=0.02)


def test_a_step_waits_for_the_intersections_alone(stage_files, monkeypatch, pretended_cuda):
    seen = []
    take_step = loop.Loop._take_step

    def watched(run):
        pretended_cuda.reset()
        refine = take_step(run)
        refine()
        seen.append(([place.split(":")[0] for _, place in pretended_cuda.waits], len(pretended_cuda.launches)))
        return lambda: None

    monkeypatch.setattr(loop.Loop, "_take_step", watched)
    fitted(stage_files, device="cuda", settings={"refine_every": 1000, "evaluate_every": 1000})
    assert len(seen) == STEPS
    assert all(waits == ["ops/splatting/tiles.py"] for waits, _ in seen)
    assert all(launches <= 22 for _, launches in seen)


def test_a_fit_on_the_device_resumes(stage_files, tmp_path, pretended_cuda):
    whole = fitted(stage_files, device="cuda")
    path = tmp_path / "state"
    fitted(stage_files, device="cuda", checkpoint=path, keep_checkpoint=True, settings={})
    again = fitted(stage_files, device="cuda", checkpoint=path, resume=True)
    assert len(again.gaussians) == len(whole.gaussians)


@pytest.mark.parametrize("kind", ["one_hot", "dense"])
@pytest.mark.parametrize("mode", ["weighted", "center"])
def test_lift_and_ask(kind, mode, stage, toy_text, pretended_cuda):
    views = stage.views[:2]
    maps = {view.stem: getattr(stage, kind)(view) for view in views}
    here = sg.lift(stage.gaussians, views, maps, mode=mode)
    there = sg.lift(stage.gaussians, views, maps, mode=mode, device="cuda")
    assert there.features.is_cuda
    torch.testing.assert_close(there.features.cpu(), here.features, rtol=1e-3, atol=1e-3)
    if kind == "one_hot":
        return
    scene, camera = stage.gaussians.to("cuda"), views[0].camera
    labels, _ = sg.segment(scene, there, ["left door", "lamp"], camera, toy_text)
    expected, _ = sg.segment(stage.gaussians, here, ["left door", "lamp"], camera, toy_text)
    assert labels.is_cuda
    assert (labels.cpu() == expected).float().mean() > 0.99
    scores = sg.query(there, ["lamp"], toy_text)
    assert sg.localize(scores[:, 0], scene, camera, seen=there.seen)[0] == pytest.approx(
        sg.localize(sg.query(here, ["lamp"], toy_text)[:, 0], stage.gaussians, camera, seen=here.seen)[0], abs=1
    )
    assert sg.select(scores[:, 0], top_share=0.1).is_cuda
    assert sg.relevancy(there, ["lamp"], toy_text).is_cuda


def test_residual(stage, pretended_cuda):
    """How far the lifted semantics, rendered again, are from the maps; part of lifting unless it is turned off."""
    views = stage.views[:3]
    log_here, log_there = sg.RunLog(), sg.RunLog(device="cuda")
    maps = {view.stem: stage.one_hot(view) for view in views}
    sg.lift(stage.gaussians, views, maps, log=log_here)
    sg.lift(stage.gaussians, views, maps, device="cuda", log=log_there)
    assert log_there.error == pytest.approx(log_here.error, abs=1e-3)
