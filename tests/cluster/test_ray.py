"""The Ray engine does what the local one does, and starts nothing that others could reach."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import pytest

from sgwarp.cluster.local import LocalEngine
from sgwarp.cluster.ray_engine import RayEngine
from sgwarp.cluster.tasks import Limits, Task
from sgwarp.errors import InputError

pytestmark = [
    pytest.mark.skipif(find_spec("ray") is None, reason="needs Ray"),
    pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc"),
    pytest.mark.filterwarnings("default"),  # Ray's own
]


def workers() -> list[int]:
    """Processes of Ray that are at a scene."""
    return [int(entry.name) for entry in Path("/proc").iterdir() if entry.name.isdigit() and is_worker(entry)]


def is_worker(entry: Path) -> bool:
    try:
        return b"ray::_remote_work" in (entry / "cmdline").read_bytes()
    except OSError:
        return False


def listening(pids: set[int]) -> set[str]:
    """Addresses on which processes wait for connections."""
    import psutil

    found = set()
    for pid in pids:
        try:
            connections = psutil.Process(pid).net_connections(kind="inet")
        except (psutil.Error, OSError):
            continue
        found |= {connection.laddr.ip for connection in connections if connection.status == "LISTEN"}
    return found


def limited(tasks: list[Task]) -> list[Task]:
    """With the limits that scene05 and scene07 exceed."""
    limits = {"scene05": Limits(memory=350_000_000), "scene07": Limits(seconds=6.0)}
    return [replace(task, limits=limits.get(task.name, task.limits)) for task in tasks]


@pytest.mark.slow
def test_ray_gives_the_same_bytes_through_faults(batch):
    batch.add("scene02", "fails")
    batch.add("scene05", "eats")
    batch.add("scene07", "hangs")
    killed, addresses, niceness = [], set(), set()
    stop = threading.Event()

    def disturb() -> None:
        import psutil

        while not stop.wait(0.1):
            if not addresses and workers():
                family = {child.pid for child in psutil.Process().children(recursive=True)}
                addresses.update(listening(family))
            if not niceness and (found := workers()):
                with suppress(OSError):  # it has ended
                    niceness.add(os.getpriority(os.PRIO_PROCESS, found[0]))
            if len(killed) < 2 and workers():
                killed.append(workers()[0])
                os.kill(killed[-1], signal.SIGKILL)
                time.sleep(1.0)

    thread = threading.Thread(target=disturb)
    thread.start()
    try:
        through_ray = batch.statuses(RayEngine(2)(limited(batch.slower(0.1).tasks("ray"))))
    finally:
        stop.set()
        thread.join()
    assert len(killed) == 2
    assert os.environ["RAY_USAGE_STATS_ENABLED"] == "0"
    assert addresses
    assert niceness == {os.getpriority(os.PRIO_PROCESS, 0)}
    assert addresses <= {"127.0.0.1", "::1", "::ffff:127.0.0.1"}
    local = batch.statuses(LocalEngine(2)(limited(batch.slower(0.1).tasks("local"))))
    assert through_ray == local
    assert {name for name, status in local.items() if status == "failed"} == {"scene02", "scene05", "scene07"}
    assert batch.results("ray") == batch.results("local")
    assert len(batch.results("ray")) == 18
    assert "more than the limit of 0.35 GB" in batch.record("scene05", "failed.json", "ray")["error"]
    assert "time limit of 6 s" in batch.record("scene07", "failed.json", "ray")["error"]


DRIVER = """
import json, sys
sys.path[:0] = {paths!r}
from sgwarp.cluster.ray_engine import RayEngine
from sgwarp.cluster.tasks import Task
for outcome in RayEngine(1)([Task.from_json(values) for values in json.loads(sys.stdin.read())]):
    print(outcome.name, outcome.status, flush=True)
"""


def test_a_killed_driver_takes_its_ray_with_it_and_loses_nothing(batch):
    import psutil

    tasks = batch.slower(0.3).tasks()[:6]
    command = [sys.executable, "-c", DRIVER.format(paths=sys.path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as driver:
        driver.stdin.write(json.dumps([task.to_json() for task in tasks]))
        driver.stdin.close()
        assert driver.stdout.readline() == "scene00 done\n"
        family = psutil.Process(driver.pid).children(recursive=True)
        family = [process for process in family if "Agent" not in process.name()]  # do no scenes, and end later
        driver.kill()
    assert family
    _, living = psutil.wait_procs(family, timeout=60)
    assert not living
    found = batch.statuses(list(LocalEngine(1)(tasks)))
    assert found["scene00"] == "skipped"
    assert set(found.values()) == {"skipped", "done"}
    assert batch.folders() == [task.name for task in tasks]
    batch.statuses(list(LocalEngine(1)(batch.tasks("undisturbed")[:6])))
    assert batch.results() == batch.results("undisturbed")


def test_a_cluster_that_is_not_there_is_bad_input(batch, monkeypatch):
    class Ray:
        def init(self, **settings):
            assert settings["address"] == "10.0.0.1:6379"
            raise ConnectionError("no answer\nat all")

    monkeypatch.setattr("sgwarp.cluster.ray_engine._import_ray", lambda alone: Ray())
    with pytest.raises(InputError, match=r"--address 10.0.0.1:6379: Ray does not answer \(no answer\).*RAY_AUTH_MODE"):
        list(RayEngine(1, address="10.0.0.1:6379")(batch.tasks()))
