"""Killed at random, an evaluation goes on without repeating or losing a scene."""

import json
import os
import random
import signal
import time
import warnings
from dataclasses import replace
from pathlib import Path

from sgwarp.cli import main
from sgwarp.datasets.base import SceneData
from sgwarp.datasets.synthetic import make_room
from sgwarp.datasets.synthetic_files import save_room
from sgwarp.evaluation.evaluator import evaluate
from sgwarp.evaluation.profiles import room
from sgwarp.evaluation.results import FILE
from sgwarp.evaluation.settings import Settings

SCENES, KILLS = 40, 6


class Stub:
    """What a case of no data is."""

    gaussians, lifted, scored, bytes_per_gaussian = (), (), (), 0.0


def tiny_profile(journal: Path):
    """Scenes take a hundredth of a second; each start is a line in the journal."""

    def make(scene, settings, split, log):
        with journal.open("a") as file:
            file.write(f"{scene.name}\n")
        return Stub()

    def score(case, result, sheets):
        (sheets / "half.png").write_bytes(b"half")
        time.sleep(0.01)
        (sheets / "half.png").unlink()
        result.figures["miou"] = 0.5
        result.values["located"] = [1.0]

    return replace(room.ROOM, make=make, score=score, total=room.total_of_values)


class Numbered:
    """A data set of empty scenes."""

    NAME, ABOUT = "folder", "numbers"

    @staticmethod
    def list_scenes(root):
        return [f"s{number:03d}" for number in range(SCENES)]

    @staticmethod
    def open_scene(root, name):
        return SceneData(name, Path(root), 1)


def killed_run(profile, out: Path, after: float) -> bool:
    """Run in a fork that is killed; whether it had ended by itself."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # torch's threads; the child uses none
        child = os.fork()
    if child == 0:
        try:
            evaluate(profile, out, out, Settings())
        finally:
            os._exit(0)
    time.sleep(after)
    os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    return os.WIFEXITED(status)


def test_no_scene_is_lost_or_repeated(tmp_path, monkeypatch):
    monkeypatch.setattr("sgwarp.evaluation.evaluator.find_reader", lambda name: Numbered)
    out, journal, rng = tmp_path / "out", tmp_path / "journal", random.Random(4)
    out.mkdir()
    profile = tiny_profile(journal)
    first: dict[str, int] = {}
    for _ in range(KILLS):
        killed_run(profile, out, rng.uniform(0.02, 0.25))
        for path in out.glob(f"scenes/*/{FILE}"):
            first.setdefault(path.parent.name, path.stat().st_mtime_ns)
    assert 0 < len(first) < SCENES, "the kills hit the work: choose other times"
    started_before = len(journal.read_text().split())
    found = evaluate(profile, out, out, Settings())
    assert [result.scene for result in found.results] == Numbered.list_scenes(out)
    assert found.figures["located"] == 1.0
    for name, written in first.items():
        assert (out / "scenes" / name / FILE).stat().st_mtime_ns == written
    starts = journal.read_text().split()
    assert len(starts) - started_before == SCENES - len(first)
    # A scene starts again only if its process was killed in it: once for each kill at most.
    assert len(starts) - SCENES <= KILLS
    assert not list(out.glob("scenes/*/half.png"))
    assert not list(out.glob("scenes/*/.*"))


def test_new_names_of_classes_make_a_record_anew(tmp_path, monkeypatch):
    """The record has the names, and the same images under other names are another question."""
    save_room(make_room(seed=3, count=300), tmp_path / "rooms" / "one", views=9, width=32, height=24)
    names = tmp_path / "rooms" / "one" / "classes.json"

    def run() -> tuple[int, list[str]]:
        words = ["evaluate", "room", "--data", tmp_path / "rooms", "--out", tmp_path / "out", "--encoder", "truth"]
        assert main([str(word) for word in words]) == 0
        again = json.loads((tmp_path / "out" / "run.json").read_text())["left_out"].get("scenes_done_before", 0)
        return again, json.loads((tmp_path / "out/scenes/one/result.json").read_text())["result"]["classes"]

    before = run()[1]
    assert run() == (1, before)
    content = json.loads(names.read_text())
    names.write_text(json.dumps({number: f"new {name}" for number, name in content.items()}))
    assert run() == (0, [f"new {name}" for name in before])
