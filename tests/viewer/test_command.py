"""`sgwarp view` and the --view of other commands, up to the browser."""

import json

import pytest
import torch

from sgwarp.cli import main
from sgwarp.io.instances import save_instances
from sgwarp.io.store import load_semantics, save_semantics
from sgwarp.viewer import live as live_module
from sgwarp.viewer import server

pytest.importorskip("viser")


class Opened:
    """Takes the place of a viewer."""

    def __init__(self):
        self.benches, self.addresses, self.sizes = [], [], []

    def __call__(self, bench, address=None):
        self.benches.append(bench)
        self.addresses.append(address)
        bench.subscribe(lambda: self.sizes.append(len(bench.state.gaussians)))
        self.bench = bench
        return self

    def wait(self):
        raise KeyboardInterrupt

    def close(self):
        pass


@pytest.fixture
def opened(monkeypatch):
    viewer = Opened()
    monkeypatch.setattr(server, "open_viewer", viewer)
    monkeypatch.setattr(live_module, "open_viewer", viewer)
    return viewer


def run(*arguments) -> int:
    return main([str(argument) for argument in arguments])


@pytest.fixture
def files(stage_files, label_semantics, instances, tmp_path):
    from dataclasses import replace

    fingerprint = stage_files.gaussians.fingerprint
    semantics, found = tmp_path / "S.safetensors", tmp_path / "I.safetensors"
    save_semantics(replace(label_semantics, fingerprint=fingerprint), semantics, {"encoder": "files:x"})
    save_instances(replace(instances, fingerprint=fingerprint), found)
    return semantics, found


def test_view_opens_what_it_is_given(opened, stage_files, files):
    semantics, found = files
    options = ["--semantics", semantics, "--instances", found, "--views", stage_files.views, "--port", 9000]
    assert run("view", stage_files.scene, *options) == 0
    given = opened.benches[0].materials
    assert torch.equal(given.gaussians.means, stage_files.gaussians.means)
    assert given.semantics.labels == ("1", "2", "3", "4")
    assert len(given.instances.table) == 8
    assert [view.stem for view in given.views] == [f"{k:04d}" for k in range(6)]
    assert opened.addresses == [server.Address("127.0.0.1", 9000, None)]


def test_view_asks_what_the_network_predicted(opened, stage_files, files, tmp_path):
    from dataclasses import replace

    lifted = load_semantics(files[0])
    predicted = tmp_path / "P.safetensors"
    save_semantics(replace(lifted, features=lifted.features.flip(1)), predicted, {"encoder": "files:x"})
    assert run("view", stage_files.scene, "--semantics", files[0], "--predicted", predicted) == 0
    given = opened.benches[0].materials
    assert torch.equal(given.semantics.features, lifted.features)
    assert torch.equal(given.predicted.features, lifted.features.flip(1))


def test_view_of_a_scene_alone_and_for_others(opened, stage_files, files):
    assert run("view", stage_files.scene, "--host", "0.0.0.0") == 0
    assert opened.benches[0].materials.semantics is None
    assert opened.addresses[0].host == "0.0.0.0"
    assert opened.addresses[0].token
    assert run("view", stage_files.scene, "--semantics", files[0], "--min-weight", 1e9) == 0
    assert not bool(opened.benches[1].materials.semantics.seen.any())


def test_view_of_a_moving_scene(opened, stage, tmp_path):
    from dataclasses import replace

    from sgwarp.io.sequence_files import write_params

    moved = [replace(stage.gaussians, means=stage.gaussians.means + 0.1 * t) for t in range(3)]
    write_params(tmp_path / "params.npz", moved)
    assert run("view", tmp_path / "params.npz") == 0
    assert opened.benches[0].frames == 3


def test_semantics_of_another_scene_are_refused(opened, stage_files, label_semantics, tmp_path, capsys):
    path = tmp_path / "S.safetensors"
    save_semantics(label_semantics, path, {})  # its fingerprint is not that of the scene's file
    assert run("view", stage_files.scene, "--semantics", path) == 2
    assert "another" in capsys.readouterr().err
    assert not opened.benches


def test_the_folder_of_photographs_is_named_for_models_only(opened, stage_files, capsys):
    """transforms.json lists its photographs; with a model, `load_views` takes the name."""
    assert run("view", stage_files.scene, "--views", stage_files.views, "--images", "images_4") == 2
    assert "COLMAP models only" in capsys.readouterr().err


@pytest.mark.parametrize(
    "options",
    [
        ("--semantics", "missing.safetensors"),
        ("--views", "nowhere"),
        ("--predicted", "missing.safetensors"),
    ],
)
def test_bad_input_is_one_line(opened, stage_files, capsys, options):
    assert run("view", stage_files.scene, *options) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert not opened.benches


def test_a_port_that_is_none_is_bad_input(stage_files, capsys):
    assert run("view", stage_files.scene, "--port", 70000) == 2
    assert "--port" in capsys.readouterr().err


def test_lift_shows_what_it_writes(opened, stage_files, tmp_path):
    out = tmp_path / "S.safetensors"
    options = ["--views", stage_files.views, "--encoder", f"files:{stage_files.labels}", "--out", out, "--view"]
    assert run("lift", stage_files.scene, *options) == 0
    from sgwarp.io.store import load_semantics

    shown, written = opened.benches[0].materials.semantics, load_semantics(out)
    torch.testing.assert_close(shown.features, written.features.float(), rtol=0, atol=1e-3)  # half precision on disk
    assert json.loads((tmp_path / "run.json").read_text())["outputs"] == [str(out)]


@pytest.mark.slow
def test_fit_shows_what_it_writes(opened, stage_files, tmp_path):
    out = tmp_path / "F.ply"
    options = ["--steps", 12, "--cap", 300, "--sh-degree", 0, "--hold-out", 0, "--init", "random", "--view"]
    assert run("fit", stage_files.views, "--out", out, *options) == 0
    from sgwarp.io.scenes import load_gaussians

    shown = opened.benches[0].materials.gaussians
    torch.testing.assert_close(shown.means, load_gaussians(out).means)
    assert len(opened.benches[0].materials.views) == 6


def test_demo_shows_its_result(opened, monkeypatch, tmp_path, toy_text):
    """The demo itself takes its time and has tests of its own."""

    def run_demo(out, device, show, watch):
        from sgwarp.demo.data import Room

        gaussians = Room.load().gaussians
        watch(lambda: _semantics_for(gaussians))

    monkeypatch.setattr("sgwarp.demo.run.run_demo", run_demo)
    monkeypatch.setattr("sgwarp.encoders.registry.make_text_encoder", lambda name, device: toy_text)
    assert run("demo", "--out", tmp_path / "o", "--view") == 0
    given = opened.benches[0].materials
    assert len(given.views) == 12
    assert given.encoder is toy_text


def _semantics_for(gaussians):
    from sgwarp.scene import Semantics

    ones = torch.ones(len(gaussians))
    return Semantics(ones[:, None], ones, ones, "conse", gaussians.fingerprint)
