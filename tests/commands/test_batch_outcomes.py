"""What `sgwarp batch` makes of the outcomes of its scenes, and what it tells its engine. No scene is worked on."""

import json
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from sgwarp.cli import main
from sgwarp.cluster.local import Call
from sgwarp.cluster.tasks import Outcome
from sgwarp.commands.batch import MEASURE, PREPARE, WARM, Batch

NAMES = ("a", "b", "c", "d")


@pytest.fixture
def rooms(stage_files, tmp_path) -> Path:
    for name in NAMES:
        (tmp_path / "rooms" / name).mkdir(parents=True)
        shutil.copy(stage_files.scene, tmp_path / "rooms" / name / "scene.ply")
    return tmp_path / "rooms"


@pytest.fixture
def answered(monkeypatch):
    """`answered(*rounds)`: what the engine says in each round, by scene; returns the names that it is given."""

    def make(*rounds):
        given, left = [], list(rounds)

        def engine(self, tasks):
            statuses = left.pop(0)

            def do(waiting):
                given.append([task.name for task in waiting])
                for task in waiting:
                    status = statuses[task.name]
                    seconds = {"lift": 2.0} if status != "held" else {}
                    yield Outcome(task.name, status, "why" if status == "failed" else "", seconds)

            return do

        monkeypatch.setattr(Batch, "_engine", engine)
        return given

    return make


def run(rooms, *more) -> int:
    return main([str(word) for word in ("batch", rooms, "--do", "lift", "--out", rooms.parent / "out", *more)])


def test_outcomes_are_counted_written_and_printed(rooms, answered, capsys, monkeypatch):
    known = {"a": Outcome("a", "skipped", "", {"lift": 50.0})}
    monkeypatch.setattr("sgwarp.cluster.working.settled", lambda task: known.get(task.name))
    given = answered({"b": "done", "c": "held", "d": "failed"}, {"c": "done"})
    assert run(rooms) == 1
    assert given == [["b", "c", "d"], ["c"]], "what another batch holds is asked for again"
    out = rooms.parent / "out"
    assert "2 done, 1 skipped, 1 failed scenes" in capsys.readouterr().out
    log = json.loads((out / "run.json").read_text())
    assert log["error"] == {"done": 2, "failed": 1}
    assert log["left_out"] == {"scenes_done_before": 1}
    assert log["stages"]["lift"] == pytest.approx(4.0), "only of what was done now"
    files = [str(out / name) for name in ("a", "b", "c", "summary.csv", "summary.png")]
    assert log["outputs"] == files
    rows = [line.split(",")[:2] for line in (out / "summary.csv").read_text().splitlines()[1:]]
    assert rows == [["a", "skipped"], ["b", "done"], ["c", "done"], ["d", "failed"]]


def test_without_a_failure_the_exit_code_is_0_and_shards_have_their_folder(rooms, answered):
    given = answered({"b": "done", "d": "done"})
    assert run(rooms, "--shard", "1/2") == 0
    assert given == [["b", "d"]]
    folder = rooms.parent / "out" / "shards" / "1-of-2"
    assert {path.name for path in folder.iterdir()} >= {"run.json", "summary.csv"}
    assert not (rooms.parent / "out" / "summary.csv").exists()


def test_a_task_knows_how_it_is_run(rooms):
    batch = Batch(scenes=str(rooms), do="lift", out=rooms.parent / "out", retry_failed=True, threads=3, device="cuda:1")
    from sgwarp.cluster.listing import list_scenes

    for task, name in zip(batch._tasks(list_scenes(str(rooms))), NAMES, strict=True):
        assert (task.name, task.folder) == (name, str((rooms.parent / "out").absolute()))
        assert (task.runner, task.measure) == ("sgwarp.commands.scene_stages:run_stage", MEASURE)
        assert (task.common, task.retry, task.fault) == (("--threads", "3"), True, "")
        words = task.stages[0].arguments
        assert words[words.index("--device") + 1] == "cuda:1"
        assert words[0] == str(rooms / name / "scene.ply")
        assert {str(rooms / name), str(rooms / name / "scene.ply")} <= set(task.inputs)


ENVIRONMENT = {"OMP_NUM_THREADS": "2", "OMP_WAIT_POLICY": "passive"}


@pytest.mark.parametrize(
    ("options", "warm"),
    [
        ({"workers": 1}, None),
        ({"workers": 2}, ("conse", "cpu")),
        ({"workers": 2, "options": ("encoder=a",)}, ("a", "cpu")),
        ({"workers": 2, "options": ("lift.encoder=b", "encoder=a"), "device": "cuda:1"}, ("b", "cuda:1")),
    ],
)
def test_the_engine_of_this_machine(rooms, monkeypatch, options, warm):
    made = []
    monkeypatch.setattr("sgwarp.cluster.local.LocalEngine", lambda *given: made.append(given))
    batch = Batch(scenes="list", do="lift,segment", out=rooms, threads=2, **options)
    batch._engine([None] * 3)
    expected = None if warm is None else Call(WARM, (["lift", "segment"], *warm))
    assert made == [(options["workers"], Call(PREPARE), expected, ENVIRONMENT, ())]
    batch._engine([None])
    assert made[1][2] is None, "one scene needs no warming"


@pytest.mark.parametrize(
    ("options", "gpus", "address"),
    [
        ({}, 0.0, None),
        ({"device": "cuda"}, 1.0, None),
        ({"device": "cuda:0", "gpus": 0.25, "address": "ray://x:1"}, 0.25, "ray://x:1"),
        ({"gpus": 0.0, "device": "cuda"}, 0.0, None),
    ],
)
def test_the_engine_of_a_cluster(rooms, monkeypatch, options, gpus, address):
    made = []
    module = SimpleNamespace(RayEngine=lambda *given: made.append(given))
    monkeypatch.setitem(sys.modules, "sgwarp.cluster.ray_engine", module)
    batch = Batch(scenes="list", do="lift", out=rooms, engine="ray", workers=1, threads=2, **options)
    batch._engine([None])
    assert made == [(1, 2, gpus, address, Call(PREPARE), None, ENVIRONMENT)]


@pytest.mark.parametrize(
    ("device", "workers", "visible", "devices"),
    [
        ("cuda", 2, "0, 3", ("0", "3")),
        ("cuda", 2, None, ("0", "1", "2")),
        ("cuda", 1, "0,3", ()),
        ("cuda:1", 2, "0,3", ()),
        ("cpu", 2, "0,3", ()),
    ],
)
def test_workers_share_the_devices_that_are_seen(rooms, monkeypatch, device, workers, visible, devices):
    monkeypatch.setattr("torch.cuda.device_count", lambda: 3)
    if visible is None:
        monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    else:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    assert Batch(scenes="list", do="lift", out=rooms, workers=workers, device=device)._devices() == devices
