"""What commands put into their record, say and leave out: lift, poses, demo, encoders, render, batch."""

import json
import logging
import re
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest

from sgwarp.cli import main
from sgwarp.cluster.summary import Tally
from sgwarp.cluster.tasks import Outcome
from sgwarp.commands.batch import Batch
from sgwarp.commands.demo import Demo
from sgwarp.commands.lift import Lift
from sgwarp.encoders.catalogue import KINDS
from sgwarp.files.images import read_rgb
from sgwarp.io.store import load_semantics, read_notes
from sgwarp.lifting.lifter import lift
from sgwarp.runs.log import RunLog


def run(*words) -> int:
    return main([str(word) for word in words])


def record(folder) -> dict:
    return json.loads((folder / "run.json").read_text())


# lift


def test_a_lift_notes_how_it_was_made(stage_files, tmp_path):
    out = tmp_path / "s.safetensors"
    words = ["lift", stage_files.scene, "--views", stage_files.views, "--encoder", f"files:{stage_files.labels}"]
    assert run(*words, "--mode", "center", "--out", out, "--cache", "none") == 0
    notes = read_notes(out)
    assert (notes["encoder"], notes["mode"], notes["views"]) == (f"files:{stage_files.labels}", "center", 6)
    log = record(tmp_path)
    assert log["outputs"] == [str(out)]
    assert {"read", "compare", "load_encoder", "lift", "write"} <= set(log["stages"])
    assert log["error"]["coverage"] == pytest.approx(load_semantics(out).coverage)
    assert log["left_out"]["views_without_map"] == 1


@pytest.mark.parametrize(("finished", "said"), [(True, ["finish", "closed"]), (False, ["closed"])])
def test_the_viewer_of_a_lift_closes_with_it(stage, stage_files, tmp_path, monkeypatch, finished, said):
    calls, seen = [], []
    live = SimpleNamespace(
        close=lambda: calls.append("closed"), finish=lambda: calls.append("finish"), watch=lambda make: None
    )

    def lifted(self, gaussians, views, log):
        seen.append(log.watch)
        if not finished:
            raise KeyboardInterrupt
        return lift(gaussians, views[:1], lambda view: stage.one_hot(stage.views[0]))

    monkeypatch.setattr(Lift, "_live", lambda self, gaussians, views: live)
    monkeypatch.setattr(Lift, "_lift", lifted)
    words = ["lift", stage_files.scene, "--views", stage_files.views, "--out", tmp_path / "s.safetensors", "--view"]
    assert run(*words) == (0 if finished else 130)
    assert calls == said
    assert seen == [live.watch]


@pytest.mark.parametrize(("cache", "device", "limit"), [("", "cpu", 10.0), ("none", "cpu", 10.0), ("maps", "cpu", 0.5)])
def test_maps_are_kept_where_and_as_far_as_it_was_said(stage, stage_files, tmp_path, monkeypatch, cache, device, limit):
    asked, folder = [], tmp_path / "maps"
    source = lambda view: stage.one_hot(stage.views[0])  # noqa: E731
    monkeypatch.setattr("sgwarp.encoders.registry.make_encoder", lambda *given: asked.append(given) or source)
    monkeypatch.setattr("sgwarp.encoders.cache.default_folder", lambda: "default")
    command = Lift(scene=stage_files.scene, views=stage_files.views, out=tmp_path / "s", encoder="e")
    command.cache, command.cache_limit = str(folder) if cache == "maps" else cache, limit
    command._lift(stage_files.gaussians, stage.views[:1], RunLog())
    expected = {"": "default", "none": None, "maps": str(folder)}[cache]
    assert asked == [("e", stage.views[:1], device, expected, limit)]


# poses


def test_photographs_without_a_pose_are_named_up_to_a_few(stage_files, tmp_path, monkeypatch, caplog):
    from sgwarp.commands.poses import NAMED

    caplog.set_level(logging.INFO)
    monkeypatch.setattr("sgwarp.reconstruction.sfm.library.require_pycolmap", lambda: None)
    for count in (0, NAMED, NAMED + 2):
        caplog.clear()
        left = {f"{k}.jpg": "too dark" for k in range(count)}
        found = SimpleNamespace(summary=lambda: "5 of 9 placed", left_out=left, error=0.75)
        monkeypatch.setattr("sgwarp.reconstruction.sfm.poses.estimate_poses", lambda *given, found=found: found)
        photographs, out = stage_files.views / "images", tmp_path / "o"
        assert run("poses", photographs, "--out", out) == 0
        said = [message for message in caplog.messages if "too dark" in message]
        assert said == [f"{k}.jpg: has no pose: too dark" for k in range(min(count, NAMED))]
        assert f"{photographs}: 5 of 9 placed" in caplog.messages
        assert (f"and 2 more have none; {out / 'sfm.json'} lists them" in caplog.messages) == (count > NAMED)
        assert ("more have none" in caplog.text) == (count > NAMED)
        log = record(out)
        assert log["left_out"] == ({"photographs_without_pose": count} if count else {})
        assert log["error"] == {"reprojection_error": 0.75}
        assert log["outputs"] == [str(out / "sparse" / "0")]
        assert "poses" in log["stages"]


def test_photographs_that_are_not_there(tmp_path, capsys):
    assert run("poses", tmp_path / "none", "--out", tmp_path / "o") == 2
    assert f"{tmp_path / 'none'}: no such file or folder" in capsys.readouterr().err


# demo


@pytest.mark.parametrize("fails", [False, True])
def test_the_viewer_of_the_demo_closes_with_it(tmp_path, monkeypatch, fails):
    calls = []

    def run_demo(out, **given):
        calls.append(("run", out, sorted(given)))
        if fails:
            raise KeyboardInterrupt

    live = SimpleNamespace(watch="watch", finish=lambda: calls.append("finish"), close=lambda: calls.append("closed"))
    monkeypatch.setattr("sgwarp.demo.run.run_demo", run_demo)
    monkeypatch.setattr(Demo, "_live", lambda self: live)
    out = tmp_path / "o"
    assert run("demo", "--out", out) == (130 if fails else 0)
    assert calls == [("run", out, ["device", "show"])]
    calls.clear()
    assert run("demo", "--out", out, "--view") == (130 if fails else 0)
    shown = [("run", out, ["device", "show", "watch"])]
    assert calls == [*shown, *([] if fails else ["finish"]), "closed"]


# encoders


def test_every_encoder_is_listed_under_its_role(capsys):
    assert run("encoders", "--json") == 0
    facts = {row["name"]: row for row in json.loads(capsys.readouterr().out)}
    assert list(facts) == [kind.name for kind in KINDS.values()]
    assert run("encoders") == 0
    text = capsys.readouterr().out
    for kind in KINDS.values():
        row = facts[kind.name]
        assert row["installed"] == (not kind.missing)
        assert row["install"] == (f'pip install "sgwarp[{kind.extra}]"' if kind.extra else None)
        assert (row["role"], row["options"], row["example"]) == (kind.role, list(kind.options), kind.example)
        state = "installed" if row["installed"] else f"needs: {row['install']}"
        block = f"  {kind.name:12} {kind.about} ({state})\n  {'':12} --encoder '{kind.example}'\n"
        assert text.count(block) == 1
        after = text.split(block)[1].splitlines()[0]
        assert after == f"  {'':12} options: {', '.join(kind.options)}" if kind.options else "options:" not in after
    heads = [line for line in text.splitlines() if line and not line.startswith(" ")]
    assert len(heads) == len({kind.role for kind in KINDS.values()}) + 1


# render


def test_a_picture_is_named_by_the_output_or_by_its_view(stage_files, tmp_path, capsys):
    words = ["render", stage_files.scene, "--views", stage_files.views]
    assert run(*words, "--out", tmp_path / "one.png") == 2
    assert "is one file for 6 views; name a folder, or one --view" in capsys.readouterr().err
    assert run("render", stage_files.scene, "--view", "0001", "--out", tmp_path / "o") == 2
    assert "--view 0001: needs --views" in capsys.readouterr().err
    assert run(*words, "--view", "0001", "--out", tmp_path / "one.png", "--background", "white") == 0
    assert run(*words, "--view", "0001", "--out", tmp_path / "many", "--mode", "depth") == 0
    assert record(tmp_path)["outputs"] == [str(tmp_path / "one.png")]
    names = [str(tmp_path / "many" / name) for name in ("0001.png", "0001.npy")]
    assert record(tmp_path / "many")["outputs"] == names
    assert np.load(names[1]).shape == (72, 96)
    white, scene = read_rgb(tmp_path / "one.png"), tmp_path / "black.png"
    assert run(*words, "--view", "0001", "--out", scene) == 0
    void = (read_rgb(scene).sum(axis=2) == 0) & (white.min(axis=2) == 255)
    assert void.sum() > 50, "where the scene is not"


def test_a_photograph_that_cannot_be_told_is_not_written_over(stage_files, tmp_path, capsys):
    """Some photographs are missing, so nothing says which file is one."""
    views = tmp_path / "views"
    (views / "images").mkdir(parents=True)
    (views / "transforms.json").write_text((stage_files.views / "transforms.json").read_text())
    picture = views / "images" / "0001.png"
    picture.write_bytes(b"a photograph")
    words = ["render", stage_files.scene, "--views", views, "--view", "0001", "--out"]
    assert run(*words, picture) == 2
    assert "0001.png: " in capsys.readouterr().err
    assert picture.read_bytes() == b"a photograph"
    assert run(*words, tmp_path / "o" / "0001.png") == 0


# batch


def test_progress_of_a_batch_counts_what_was_done_before(monkeypatch, tmp_path):
    calls = []

    @contextmanager
    def show(title):
        yield lambda done, total, name: calls.append((title, done, total, bool(name)))

    tasks = [SimpleNamespace(name=name) for name in "abcd"]
    known = {"a": Outcome("a", "skipped", "", {})}
    rounds = [["held", "done", "failed"], ["done"]]

    def engine(self, waiting):
        statuses = rounds.pop(0)
        return lambda given: (Outcome(task.name, status, "", {}) for task, status in zip(given, statuses, strict=True))

    monkeypatch.setattr("sgwarp.commands.batch.show_progress", show)
    monkeypatch.setattr("sgwarp.cluster.working.settled", lambda task: known.get(task.name))
    monkeypatch.setattr(Batch, "_engine", engine)
    tally = Tally()
    Batch(scenes="s", do="lift", out=tmp_path)._do(tasks, tally)
    assert [(outcome.name, outcome.status) for outcome in tally.outcomes] == [
        *[("a", "skipped"), ("c", "done")],
        *[("d", "failed"), ("b", "done")],
    ]
    assert calls == [("batch", 0, 4, False), ("batch", 2, 4, True), ("batch", 3, 4, True), ("batch", 4, 4, True)]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--workers", 0], "--workers: expected 1 or more, got 0"),
        (["--threads", 0], "--threads: expected 1 or more, got 0"),
        (["--time-limit", 0], "--time-limit: expected a positive number"),
        (["--memory-limit", 0], "--memory-limit: expected a positive number"),
        (["--memory-limit", "inf"], "--memory-limit: expected a positive number"),
        (["--gpus", 1], "are for --engine ray"),
        (["--options", "=3"], "expected option=value, got '=3'"),
        (["--options", "lift.tau"], "expected option=value, got 'lift.tau'"),
        (["--options", "tau=1", "border=2", "tau=2"], "'tau' stands there twice"),
    ],
)
def test_a_batch_refuses_values_without_sense(stage_files, tmp_path, capsys, options, message):
    (tmp_path / "list.txt").write_text(f"{stage_files.scene}\n")
    assert run("batch", tmp_path / "list.txt", "--do", "lift", "--out", tmp_path / "o", *options) == 2
    assert re.search(re.escape(message), capsys.readouterr().err)
    assert not (tmp_path / "o").exists()


def test_values_at_the_end_of_their_range_are_taken(tmp_path):
    Batch(scenes="s", do="lift", out=tmp_path, workers=1, threads=1, time_limit=1e-3, memory_limit=1e-3)._check()
    Batch(scenes="s", do="lift", out=tmp_path, engine="ray", address="x:1", gpus=0.5)._check()


def test_features_of_gaussians_are_taken_as_they_are(stage, stage_files, tmp_path, monkeypatch, caplog):
    """Nothing is lifted, and what is said about lifting is without effect."""
    (kind,) = [kind for kind in KINDS.values() if kind.fused][:1]
    semantics, asked = lift(stage_files.gaussians, stage.views[:1], stage.dense), []

    def builder(name):
        return lambda argument, gaussians, space: asked.append((name, argument, len(gaussians), space)) or semantics

    monkeypatch.setattr("sgwarp.encoders.building.builder", builder)
    out = tmp_path / "s.safetensors"
    words = ["lift", stage_files.scene, "--views", "none", "--encoder", f"{kind.name}:F.pt?space=clip", "--out", out]
    assert run(*words, "--mode", "center") == 0
    assert asked == [(kind.fused, "F.pt", len(stage_files.gaussians), "clip")]
    assert f"--mode has no effect: {kind.name}:F.pt?space=clip holds features of Gaussians" in caplog.text
    assert read_notes(out)["encoder"] == f"{kind.name}:F.pt?space=clip"
    assert "views" not in read_notes(out)
    assert record(tmp_path)["error"] == {"coverage": pytest.approx(semantics.coverage)}
