"""What commands write beside their main result: pictures, notes, tables, and the lines that they print."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sgwarp.apps.instances import maps
from sgwarp.cli import main
from sgwarp.commands.convert import Convert, _size
from sgwarp.commands.instances import Instances, listing
from sgwarp.commands.predict import Predict
from sgwarp.files.images import read_ids, read_rgb
from sgwarp.io.store import read_notes
from sgwarp.lifting.lifter import lift
from sgwarp.runs.log import RunLog
from sgwarp.scene import Instance


def run(*words) -> int:
    return main([str(word) for word in words])


def test_id_maps_lie_over_their_own_photographs(stage, stage_files, tmp_path, monkeypatch):
    views = [view for view in _views(stage_files) if view.image_path is not None][:3]
    asked = []

    def render_ids(gaussians, found, camera):
        asked.append(camera)
        return torch.full(camera.size, 300 + len(asked)), None

    monkeypatch.setattr(maps, "render_ids", render_ids)
    monkeypatch.setattr(maps, "draw_ids", lambda photograph, ids, found: photograph)
    command = Instances(scene=stage_files.scene, views=stage_files.views, masks="x", out=tmp_path / "i")
    command.render_out = tmp_path / "maps"
    log = RunLog()
    command._render(stage_files.gaussians, views, SimpleNamespace(table=()), log)
    assert asked == [view.camera for view in views]
    expected = []
    for number, view in enumerate(views, start=1):
        path, picture = tmp_path / "maps" / f"{view.stem}.png", tmp_path / "maps" / "pictures" / f"{view.stem}.png"
        expected += [str(path), str(picture)]
        assert (np.asarray(read_ids(path)) == 300 + number).all(), "16 bits"
        own = (view.image().numpy() * 255).round()
        assert np.abs(read_rgb(picture).astype(float) - own).max() <= 1
    assert log.outputs == expected


def _views(stage_files):
    from sgwarp.commands.options import find_views

    return find_views(stage_files.views)


@pytest.mark.parametrize("filled", [False, True])
def test_predictions_note_where_they_come_from(stage, stage_files, tmp_path, monkeypatch, filled):
    semantics = lift(stage_files.gaussians, stage.views, stage.dense)
    monkeypatch.setattr(Predict, "_semantics", lambda self, gaussians, log: semantics)
    more = ["--projection", tmp_path / "s.safetensors"] if filled else []
    assert run("predict", stage_files.scene, "--net", "n.safetensors", "--out", tmp_path / "p.safetensors", *more) == 0
    notes = read_notes(tmp_path / "p.safetensors")
    assert (notes["network"], notes["projection"]) == ("n.safetensors", filled)
    assert json.loads((tmp_path / "run.json").read_text())["outputs"] == [str(tmp_path / "p.safetensors")]


@pytest.mark.parametrize(
    ("covered", "always", "asked"), [(True, False, False), (True, True, True), (False, False, True)]
)
def test_the_network_is_asked_where_the_views_do_not_suffice(monkeypatch, tmp_path, covered, always, asked):
    from sgwarp.network import prediction, quality, semantic_network

    calls = []
    quality_of = SimpleNamespace(suffices=lambda: covered, _asdict=lambda: {"covered": 0.5})
    monkeypatch.setattr("sgwarp.commands.predict.load_on", lambda path, gaussians: f"lifted from {path}")
    monkeypatch.setattr(quality, "projection_quality", lambda projected: quality_of)
    monkeypatch.setattr(quality, "filled", lambda *given: ("filled", *given))
    network = SimpleNamespace(to=lambda device: calls.append(device) or "network")
    monkeypatch.setattr(semantic_network, "load_network", lambda path, **given: calls.append((path, given)) or network)
    result = SimpleNamespace(semantics=lambda: "predicted")
    monkeypatch.setattr(prediction, "predict", lambda gaussians, net, log: calls.append((gaussians, net)) or result)
    net = Path("n")
    command = Predict(scene=Path("s"), net=net, out=tmp_path, always=always, voxel=0.1, inputs="ones", space="clip")
    log = RunLog()
    loaded = [(net, {"inputs": "ones", "voxel": 0.1, "space": "clip"}), "cpu", ("scene", "network")]
    assert command._semantics("scene", log) == "predicted"
    assert calls == loaded
    assert not log.error
    calls.clear()
    command.projection = Path("p")
    found = command._semantics("scene", log)
    assert found == (("filled", "lifted from p", "predicted") if asked else "lifted from p")
    assert calls == (loaded if asked else [])
    assert log.error == {"covered": 0.5}
    assert log.left_out == ({} if asked else {"network": 1})


def test_an_ablation_is_written_and_its_faults_are_said(tmp_path, monkeypatch, capsys):
    trials = [
        SimpleNamespace(variant=SimpleNamespace(axis="modes", value="center"), error=""),
        SimpleNamespace(variant=SimpleNamespace(axis="modes", value="solve"), error="no memory"),
    ]
    ablation = SimpleNamespace(trials=trials)
    rows = [{"value": "center", "miou": 0.5}, {"value": "solve", "miou": float("nan")}]
    found = SimpleNamespace(figures={"miou": 0.25}, failed={})
    table = SimpleNamespace(markdown=lambda: "## Changed")
    written = []
    for name, stand_in in (
        ("evaluator.evaluate", lambda *given, **named: found),
        ("ablation.ablate", lambda *given, **named: ablation),
        ("ablation.as_rows", lambda given: rows if given is ablation else None),
        ("ablation.draw_ablation", lambda given, path: path.touch() or True),
        ("ablation.ablation_table", lambda given: table),
        ("report_files.headline", lambda given: SimpleNamespace(markdown=lambda: "## Results")),
        ("report_files.write_tables", lambda *given: written.append(given) or [tmp_path / "o" / "results.md"]),
    ):
        monkeypatch.setattr(f"sgwarp.evaluation.{name}", stand_in)
    words = ["evaluate", "room", "--data", tmp_path, "--out", tmp_path / "o", "--encoder", "truth", "--ablate", "modes"]
    (tmp_path / "o").mkdir()
    assert run(*words) == 0
    assert json.loads((tmp_path / "o" / "ablation.json").read_text()) == [rows[0], {"value": "solve", "miou": None}]
    said = capsys.readouterr().out
    assert said.index("modes solve: no memory") < said.index("## Results") < said.index("## Changed")
    assert "modes center" not in said
    assert written == [(found, tmp_path / "o", [table])]
    log = json.loads((tmp_path / "o" / "run.json").read_text())
    assert log["outputs"] == [str(tmp_path / "o" / name) for name in ("ablation.json", "ablation.png", "results.md")]
    assert log["error"] == {"miou": 0.25, "failed": 0}


def test_a_converted_scene_is_counted_and_weighed(stage_files, tmp_path, capsys):
    out = tmp_path / "a.splat"
    assert run("convert", stage_files.scene, out) == 0
    count = len(stage_files.gaussians)
    assert out.stat().st_size == 32 * count
    said = capsys.readouterr().out
    assert said.startswith(f"{count} Gaussians, {_size(stage_files.scene)} -> {_size(out)}; ")
    assert Convert.spz_version == 4


@pytest.mark.parametrize(
    ("count", "text"), [(512, "0.5 kB"), (99_940, "99.9 kB"), (100_000, "0.10 MB"), (2_345_678, "2.35 MB")]
)
def test_sizes_have_a_unit(tmp_path, count, text):
    (tmp_path / "a").write_bytes(bytes(count - 100))
    (tmp_path / "b").write_bytes(bytes(100))
    (tmp_path / "folder").mkdir()
    assert _size(tmp_path) == text
    (tmp_path / "c").write_bytes(bytes(count))
    assert _size(tmp_path / "c") == text


def row(number: int, count: int, level: str = "default", label: str = "") -> Instance:
    box = {"centroid": (0.0, 0.0, 0.0), "rotation": (1.0, 0.0, 0.0, 0.0), "extent": (1.0, 2.5, 0.125)}
    return Instance(number, level, 0, count, 3, 4, 0.876, **box, label=label, label_score=0.75 if label else 0.0)


def test_the_listing_says_what_an_instance_is(monkeypatch):
    table = (row(1, 50), row(2, 2000, "m", "lamp"), row(3, 70))
    head, first, second, third = listing(SimpleNamespace(table=table)).splitlines()
    assert head.split() == ["id", "Gaussians", "views", "sure", "size", "[scene", "units]", "label"]
    assert first.split() == ["2", "2,000", "4", "0.88", "1", "x", "2.5", "x", "0.125", "lamp", "(0.75)", "level", "m"]
    assert second.split()[:2] == ["3", "70"]
    assert third.split() == ["1", "50", "4", "0.88", "1", "x", "2.5", "x", "0.125"]
    monkeypatch.setattr("sgwarp.commands.instances.LISTED", 2)
    lines = listing(SimpleNamespace(table=table)).splitlines()
    assert len(lines) == 4
    assert lines[-1] == "1 smaller ones are in the table"
    monkeypatch.setattr("sgwarp.commands.instances.LISTED", 3)
    assert "smaller" not in listing(SimpleNamespace(table=table))
