"""The local engine: nothing is lost, nothing is done twice, one scene does not harm another."""

import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sgwarp.cluster.local import LocalEngine
from sgwarp.cluster.tasks import Limits
from sgwarp.version import __version__


def expected(names, stages=("first", "second")):
    """What the stages write, from their definition."""
    return {
        f"{name}/{stage}.bin": hashlib.sha512(f"{stage} scene {int(name[5:])}".encode()).digest() * 2000
        for name in names
        for stage in stages
    }


NAMES = [f"scene{number:02d}" for number in range(12)]


def test_every_scene_is_done_once(batch):
    outcomes = list(LocalEngine(2)(batch.tasks()))
    assert batch.statuses(outcomes) == dict.fromkeys(NAMES, "done")
    assert batch.results() == expected(NAMES)
    assert sorted(batch.starts()) == sorted(f"{name} {stage}" for name in NAMES for stage in ("first", "second"))
    assert batch.folders() == NAMES
    done = batch.record("scene03")
    assert done["version"] == __version__
    assert list(done["seconds"]) == ["first", "second"]
    assert done["figures"]["first"] == {"size": 7}
    assert done["outputs"] == {"first": ["first.bin"], "second": ["second.bin"]}
    assert done["peak_memory"] > 1e6
    (held,) = done["inputs"].values()
    assert (held["files"], held["bytes"]) == (1, 7)
    assert "worked on data.txt" in (batch.folder / "out" / "scene03" / "log.txt").read_text()


def test_what_is_done_is_skipped_and_what_changed_is_done_again(batch):
    list(LocalEngine(2)(batch.tasks()))
    batch.add("scene04", "scene 99")
    later = batch.folder / "in" / "scene05" / "data.txt"
    os.utime(later, (1e9, 1e9))  # the same contents, as after a copy
    found = batch.statuses(LocalEngine(2)(batch.tasks(run="run 2")))
    assert [name for name, status in found.items() if status == "done"] == ["scene04"]
    assert set(found.values()) == {"done", "skipped"}
    assert batch.results()["scene04/first.bin"] == hashlib.sha512(b"first scene 99").digest() * 2000


@pytest.mark.parametrize(
    ("stages", "again"),
    [
        (("first", "second", "third"), ("third",)),
        (("zeroth", "first", "second"), ("zeroth", "first", "second")),  # what comes first may change what follows
        (("second", "first"), ("second", "first")),
        (("first", "third"), ("first", "third")),
    ],
)
def test_stages_are_kept_as_far_as_their_order_is_the_same(batch, stages, again):
    list(LocalEngine(2)(batch.tasks()))
    before = len(batch.starts())
    other = type(batch)(batch.folder, stages=stages)
    assert set(batch.statuses(LocalEngine(2)(other.tasks(run="run 2"))).values()) == {"done"}
    assert sorted(batch.starts()[before:]) == sorted(f"{name} {stage}" for name in NAMES for stage in again)
    assert {name for name in batch.results() if name.split("/")[1][:-4] in stages} == set(expected(NAMES, stages))
    assert list(batch.record("scene03")["seconds"]) == list(stages)


def test_added_stages_leave_what_is_done(batch):
    list(LocalEngine(1)(batch.tasks()))
    before = (batch.folder / "out" / "scene00" / "first.bin").stat().st_mtime_ns
    longer = type(batch)(batch.folder, stages=("first", "second", "third"))
    assert set(batch.statuses(LocalEngine(1)(longer.tasks(run="run 2"))).values()) == {"done"}
    assert batch.results() == expected(NAMES, ("first", "second", "third"))
    assert (batch.folder / "out" / "scene00" / "first.bin").stat().st_mtime_ns == before
    assert len(batch.starts()) == 36


def test_what_fails_is_recorded_and_stops_nothing(batch):
    source = batch.add("scene02", "fails")
    batch.add("scene03", "breaks")
    batch.add("scene04", "dies")
    outcomes = {outcome.name: outcome for outcome in LocalEngine(2)(batch.tasks())}
    assert outcomes["scene02"].error == f"{source}: is of the kind that fails"
    assert outcomes["scene03"].error == "ZeroDivisionError: two"
    assert "signal 9" in outcomes["scene04"].error
    bad = {"scene02", "scene03", "scene04"}
    assert {name for name, outcome in outcomes.items() if outcome.status == "failed"} == bad
    assert batch.results() == expected([name for name in NAMES if name not in bad])
    assert batch.record("scene02", "failed.json")["error"] == outcomes["scene02"].error
    assert not (batch.folder / "out" / "scene02" / "done.json").exists()
    # It stays failed until it is asked for again, or has changed.
    batch.add("scene03", "scene 3")
    again = batch.statuses(LocalEngine(2)(batch.tasks(run="run 2")))
    assert [again[name] for name in sorted(bad)] == ["failed", "done", "failed"]
    assert not (batch.folder / "out" / "scene03" / "failed.json").exists()


def test_retry_failed(batch):
    batch.add("scene02", "fails")
    list(LocalEngine(1)(batch.tasks()))
    runner = batch.folder / "batch_runner.py"
    runner.write_text(runner.read_text().replace('"fails"', '"never again"'))  # another size: bytecode kept is stale
    assert batch.statuses(LocalEngine(1)(batch.tasks(run="run 2")))["scene02"] == "failed"
    assert batch.statuses(LocalEngine(1)(batch.tasks(run="run 3", retry=True)))["scene02"] == "done"


def test_limits_end_a_scene_and_no_other(batch):
    batch.add("scene01", "hangs")
    batch.add("scene06", "eats")
    outcomes = {o.name: o for o in LocalEngine(2)(batch.tasks(limits=Limits(seconds=3.0, memory=300_000_000)))}
    assert "time limit of 3 s" in outcomes["scene01"].error
    assert "more than the limit of 0.3 GB" in outcomes["scene06"].error
    rest = [name for name in NAMES if name not in ("scene01", "scene06")]
    assert batch.results() == expected(rest)


def workers_of(process: int) -> list[int]:
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                mine = int((entry / "stat").read_text().rpartition(")")[2].split()[1]) == process
                if mine and b"sgwarp.cluster.worker" in (entry / "cmdline").read_bytes():
                    found.append(int(entry.name))
            except (OSError, IndexError):
                pass
    return found


needs_proc = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")


@needs_proc
def test_killed_workers_lose_nothing(batch):
    killed, found = 0, []
    for outcome in LocalEngine(2)(batch.slower(0.1).tasks()):
        found.append(outcome)
        if killed < 3:
            for worker in workers_of(os.getpid())[:1]:
                os.kill(worker, signal.SIGKILL)
                killed += 1
    assert killed == 3
    assert set(batch.statuses(found)) == set(NAMES)
    assert batch.results() == expected(NAMES)
    assert not list((batch.folder / "out").glob(".*.partial"))


DRIVER = """
import json, sys
sys.path[:0] = {paths!r}
from sgwarp.cluster.local import LocalEngine
from sgwarp.cluster.tasks import Task
tasks = [Task.from_json(values) for values in json.loads(sys.stdin.read())]
for outcome in LocalEngine(2)(tasks):
    print(outcome.name, outcome.status, flush=True)
"""


@needs_proc
def test_a_killed_driver_loses_nothing(batch):
    tasks = batch.slower(0.2).tasks()
    for _ in range(2):
        command = [sys.executable, "-c", DRIVER.format(paths=sys.path)]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as driver:
            driver.stdin.write(json.dumps([task.to_json() for task in tasks]))
            driver.stdin.close()
            for _ in range(2):
                assert driver.stdout.readline()
            workers = workers_of(driver.pid)
            driver.kill()
        assert workers
        end = time.monotonic() + 20
        while any(Path(f"/proc/{worker}").exists() for worker in workers):
            assert time.monotonic() < end, "workers outlive their driver"
            time.sleep(0.1)
    found = batch.statuses(list(LocalEngine(2)(tasks)))
    assert set(found.values()) <= {"done", "skipped"}
    assert list(found.values()).count("skipped") >= 2
    assert batch.results() == expected(NAMES)
    assert batch.folders() == NAMES


def test_workers_share_out_devices(batch):
    """Each worker sees one CUDA device; a killed one's goes to the next."""
    runner = batch.folder / "batch_runner.py"
    seen = "    (out / 'device.bin').write_text(os.environ['CUDA_VISIBLE_DEVICES'])\n    time.sleep(seconds)"
    runner.write_text(runner.read_text().replace("    time.sleep(seconds)", seen))
    tasks = batch.slower(0.05).tasks()
    killed = False
    for _ in LocalEngine(2, devices=("3", "GPU-7"))(tasks):
        if not killed and len(workers_of(os.getpid())) == 2:
            os.kill(workers_of(os.getpid())[0], signal.SIGKILL)
            killed = True
    devices = [text.decode() for name, text in batch.results().items() if name.endswith("device.bin")]
    assert len(devices) == 12
    assert set(devices) == {"3", "GPU-7"}


@needs_proc
def test_random_kills_change_no_byte(batch):
    """Workers and drivers are killed at random until all is done; every scene is there once, as if undisturbed."""
    rng, killed = random.Random(1), {"driver": 0, "worker": 0}
    tasks = batch.slower(0.1).tasks()
    code = None
    while code is None:
        command = [sys.executable, "-c", DRIVER.format(paths=sys.path)]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as driver:
            driver.stdin.write(json.dumps([task.to_json() for task in tasks]))
            driver.stdin.close()
            while code is None and driver.stdout.readline():
                time.sleep(rng.random() * 0.2)
                workers = workers_of(driver.pid)
                if killed["driver"] < 2 and rng.random() < 0.4:
                    driver.kill()
                    killed["driver"] += 1
                    break
                if workers and killed["worker"] < 4:
                    os.kill(rng.choice(workers), signal.SIGKILL)
                    killed["worker"] += 1
            else:
                code = driver.wait()
    assert code == 0
    assert killed == {"driver": 2, "worker": 4}
    assert batch.results() == expected(NAMES)
    assert batch.folders() == NAMES
    assert set(batch.statuses(list(LocalEngine(1)(tasks))).values()) == {"skipped"}
