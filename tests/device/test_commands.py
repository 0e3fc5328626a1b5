"""Training, and every command with `--device cuda`, on a pretended CUDA device."""

import json
from collections import Counter
from dataclasses import dataclass, replace

import pytest
import torch

import sgwarp as sg
from sgwarp.cli import main
from sgwarp.demo.data import Room
from sgwarp.demo.measurement import measure
from sgwarp.errors import InputError
from sgwarp.network.augmentation import Augmentation
from sgwarp.network.layers.mink_unet import ARCHITECTURES, Architecture
from sgwarp.network.training.processes import joined
from sgwarp.ops import devices


@pytest.fixture
def tiny(monkeypatch):
    monkeypatch.setitem(ARCHITECTURES, "tiny", Architecture((1,) * 8, (16,) * 8))
    return sg.DistillSettings(arch="tiny", voxel=0.4, epochs=1, augment=Augmentation(up=1), half=True)


def training_scene(stage, name="stage"):
    gaussians = stage.gaussians.subset(torch.arange(0, len(stage.gaussians), 4))
    shares = torch.eye(4)[stage.classes[::4] - 1]
    weight = torch.ones(len(gaussians))
    semantics = sg.Semantics(shares, weight, 2 * weight, "labels", gaussians.fingerprint, ("1", "2", "3", "4"))
    return sg.TrainingScene(name, lambda: (gaussians, semantics))


def test_distill_and_predict(stage, tiny, tmp_path, pretended_cuda):
    scene = training_scene(stage)
    _, here = sg.distill([scene], tiny)
    network, there = sg.distill([scene], tiny, validation=[scene], state=tmp_path / "state.pt", device="cuda")
    assert there[0].loss == pytest.approx(here[0].loss, rel=0.02)
    gaussians = scene.load()[0]
    found = sg.predict(gaussians.to("cuda"), network.to("cuda")).semantics()
    assert torch.isfinite(found.features.cpu()).all()


def run(*arguments):
    assert main([*map(str, arguments), "--device", "cuda:0"]) == 0


def test_the_commands(stage_files, tmp_path, pretended_cuda):
    scene, views, out = stage_files.scene, stage_files.views, tmp_path
    run("info", scene)
    run("render", scene, "--views", views, "--view", "0001", "--out", out / "view.png")
    labels = f"files:{stage_files.labels}"
    run("lift", scene, "--views", views, "--encoder", labels, "--out", out / "S.safetensors")
    run("segment", scene, "--semantics", out / "S.safetensors", "--views", views, "--out", out / "maps")
    run("fit", views, "--out", out / "fitted.ply", "--steps", "4", "--cap", "200", "--init", "random")
    assert json.loads((out / "run.json").read_text())["device"] == "cuda:0"
    assert {"view.png", "S.safetensors", "maps", "fitted.ply"} <= {path.name for path in out.iterdir()}


def test_the_report_checks_the_extremes_on_the_device(stage_files, tmp_path, monkeypatch, pretended_cuda):
    from sgwarp.evaluation.report import extremes

    few = {name: extremes.EXTREMES[name] for name in list(extremes.EXTREMES)[:2]}
    monkeypatch.setattr(extremes, "EXTREMES", few)
    monkeypatch.setattr("sgwarp.evaluation.report.run.EXTREMES", few)
    scene = tmp_path / "scene.ply"
    sg.save_gaussians(stage_files.gaussians.subset(torch.arange(0, len(stage_files.gaussians), 20)), scene)
    options = ["--patches", "2", "--repeats", "1"]
    pretended_cuda.reset()
    run("report", scene, "--views", stage_files.views, "--out", tmp_path, *options)
    launched = Counter(pretended_cuda.launches)
    assert launched["composite_colors_block"] + launched["composite_features_block"] > 10
    # The host waits for each list of tiles, and for what was left out of each picture of the extremes.
    waits = Counter(place for _, place in pretended_cuda.waits if place.startswith("ops/splatting/tiles.py"))
    assert sorted(waits.values()) == [2 * len(few), launched["count_splat_tiles"]]
    found = json.loads((tmp_path / "report.json").read_text())
    assert found["about"]["device"] == "cuda:0"
    assert [row["schedule"] for row in found["stability"]] == ["block"] * len(few)
    assert all(row["within"] for row in found["stability"])


def test_the_demo_measures_on_the_device(monkeypatch, pretended_cuda):
    room = Room.load()
    thin = room.gaussians.subset(torch.arange(0, len(room.gaussians), 100))
    few = replace(room, gaussians=thin, views=room.views[:1], held_out=room.held_out[:1])
    monkeypatch.setattr("sgwarp.demo.measurement.SMALLEST", 15_000)  # looks for few objects
    vectors = torch.eye(len(room.names), 24)
    maps = {view.stem: sg.FeatureMap("toy", ids=room.label_map(view).ids, vectors=vectors) for view in few.views}
    there = few.to("cuda:0")
    found = measure(there, sg.lift(there.gaussians, there.views, maps), Words("toy", room.names))
    assert found.coverage > 0.1
    assert all(not finding.scores.is_cuda for finding in found.findings)


@dataclass
class Words:
    """Each name has an axis of its own."""

    space: str
    names: tuple[str, ...]

    def encode_text(self, texts):
        return torch.eye(len(self.names), 24)[[self.names.index(text) for text in texts]]


@pytest.mark.parametrize(
    ("name", "message"),
    [("tpu", "expected cpu, cuda or cuda:N"), ("cuda:x", "expected cpu"), ("cuda:7", "cuda:0 to cuda:0")],
)
def test_other_devices_are_refused(name, message, pretended_cuda):
    with pytest.raises(InputError, match=message):
        devices.find_device(name)


def test_a_driver_that_warp_does_not_take_is_named(make_scene, monkeypatch, pretended_cuda):
    scene = make_scene("sh3")
    there = scene.gaussians.to("cuda")
    monkeypatch.setattr(devices.wp, "is_cuda_available", lambda: False)
    for call in (lambda: devices.find_device("cuda"), lambda: sg.render(there, scene.camera)):
        with pytest.raises(InputError, match="driver of version 580"):
            call()


def test_several_processes_do_not_share_a_device(monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(InputError, match="one device each"), joined("cuda:1"):
        pass
