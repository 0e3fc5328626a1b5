"""What `sgwarp distill` gives to the training and keeps of it. Nothing is trained here."""

import json
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from sgwarp.cli import main
from sgwarp.commands.distill import Distill
from sgwarp.io.store import save_semantics
from sgwarp.lifting.lifter import lift
from sgwarp.network.training.settings import Epoch
from sgwarp.scene import FeatureMap


@pytest.fixture
def folder(stage, stage_files, tmp_path) -> Path:
    """Two scenes with their semantics."""
    for name in ("a", "b"):
        (tmp_path / f"{name}.ply").write_bytes(stage_files.scene.read_bytes())
    semantics = lift(stage_files.gaussians, stage.views[:1], stage.dense)
    for name in ("a", "b"):
        save_semantics(semantics, tmp_path / f"{name}.safetensors")
    return tmp_path


@pytest.mark.parametrize("leads", [True, False])
def test_one_process_shows_progress_and_writes(folder, monkeypatch, capsys, leads):
    calls, out = [], folder / "o" / "net.v2.safetensors"
    processes = SimpleNamespace(leads=leads)

    @contextmanager
    def joined(device):
        calls.append(device)
        yield processes

    def distill(scenes, settings, **given):
        calls.append((len(scenes), settings.epochs, given))
        given["state"].write_text("state")
        return "network", [Epoch(1, 0.1, 0.75, 1.0), Epoch(2, 0.1, 0.5, 1.0)]

    monkeypatch.setattr("sgwarp.network.training.processes.joined", joined)
    monkeypatch.setattr("sgwarp.network.training.trainer.distill", distill)
    monkeypatch.setattr(
        "sgwarp.network.semantic_network.save_network",
        lambda network, path, notes: path.write_text(json.dumps([network, notes])),
    )
    out.parent.mkdir()
    words = ["distill", folder / "a.ply", folder / "b.ply", "--out", out, "--epochs", 2, "--device", "cpu"]
    assert main([str(word) for word in words]) == 0
    device, (scenes, epochs, given) = calls
    assert (device, scenes, epochs) == ("cpu", 2, 2)
    assert given["processes"] is processes
    assert callable(given["progress"]) == leads
    left = {path.name for path in out.parent.iterdir()}
    if not leads:
        assert left == {"net.v2.state.pt"}
        assert capsys.readouterr().out == ""
        return
    assert left == {"net.v2.safetensors", "net.v2_curves.json", "net.v2_curves.png", "run.json"}, "and no state"
    assert json.loads(out.read_text()) == ["network", {"scenes": 2, "epochs": 2, "loss": 0.5}]
    outputs = [str(out), *(str(out.with_name(f"net.v2_curves{suffix}")) for suffix in (".json", ".png"))]
    assert json.loads((out.parent / "run.json").read_text())["outputs"] == outputs
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("write ")
    assert lines[1].startswith("wrote ")
    assert len(lines) == 2


@pytest.mark.parametrize("needs_image", [True, False])
def test_masks_are_made_of_the_photographs_of_views_that_have_some(stage_files, monkeypatch, needs_image):
    made, asked = [], []

    def encode(view, image):
        asked.append((view.stem, image))
        return FeatureMap("toy", ids=torch.zeros(view.camera.size, dtype=torch.int64), vectors=torch.ones(1, 3))

    source = SimpleNamespace(needs_image=needs_image, encode=encode, has_map=lambda view: view.stem != "0002")

    def make_encoder(name, views, device, cache):
        made.append((name, device))
        return source

    monkeypatch.setattr("sgwarp.encoders.registry.make_encoder", make_encoder)
    command = Distill(scenes=[], out=Path("n.safetensors"), encoder="files:{views}/labels", device="cpu")
    load = command._masks_of(stage_files.views)
    assert made == [(f"files:{stage_files.views}/labels", "cpu")]
    assert asked == []
    views = [one() for one in load]
    assert [stem for stem, _ in asked] == ["0000", "0001", "0003", "0004", "0005"]
    assert all(view.camera.size == (72, 96) for view in views)
    for _, image in asked:
        assert image is None if not needs_image else image.shape == (72, 96, 3)
    del source.has_map
    assert len(command._masks_of(stage_files.views)) == 6, "a source that cannot tell is asked for all"


def test_the_masks_of_all_scenes_come_from_one_network(folder, stopped, monkeypatch):
    """It is kept while the contrastive loss trains, and not for the other."""
    entered = []

    @contextmanager
    def kept_encoders():
        entered.append(True)
        yield

    monkeypatch.setattr("sgwarp.encoders.registry.kept_encoders", kept_encoders)
    words = ["distill", folder / "a.ply", "--out", folder / "o.safetensors"]
    call = stopped("sgwarp.network.training.trainer.distill", *words)
    assert call.positional[0][0].masks is None
    assert entered == []
    (folder / "a").mkdir()
    call = stopped("sgwarp.network.training.trainer.distill", *words, "--loss", "contrastive")
    assert call.positional[0][0].masks is not None
    assert entered == [True]
