"""The Ray engine does what the local one does, and starts nothing that others could reach."""

import os
import signal
import threading
import time
from importlib.util import find_spec
from pathlib import Path

import pytest

from sgwarp.cluster.local import LocalEngine
from sgwarp.cluster.ray_engine import RayEngine
from sgwarp.cluster.tasks import Limits

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


def test_ray_gives_the_same_bytes_through_faults(batch):
    batch.add("scene02", "fails")
    batch.add("scene07", "hangs")
    limits, killed, addresses = Limits(seconds=6.0), [], set()
    stop = threading.Event()

    def disturb() -> None:
        import psutil

        while not stop.wait(0.1):
            if not addresses and workers():
                family = {child.pid for child in psutil.Process().children(recursive=True)}
                addresses.update(listening(family))
            if len(killed) < 2 and workers():
                killed.append(workers()[0])
                os.kill(killed[-1], signal.SIGKILL)
                time.sleep(1.0)

    thread = threading.Thread(target=disturb)
    thread.start()
    try:
        through_ray = batch.statuses(RayEngine(2)(batch.slower(0.1).tasks("ray", limits=limits)))
    finally:
        stop.set()
        thread.join()
    assert len(killed) == 2
    assert os.environ["RAY_USAGE_STATS_ENABLED"] == "0"
    assert addresses
    assert addresses <= {"127.0.0.1", "::1", "::ffff:127.0.0.1"}
    local = batch.statuses(LocalEngine(2)(batch.slower(0.1).tasks("local", limits=limits)))
    assert through_ray == local
    assert {name for name, status in local.items() if status == "failed"} == {"scene02", "scene07"}
    assert batch.results("ray") == batch.results("local")
    assert len(batch.results("ray")) == 20
    assert "time limit of 6 s" in batch.record("scene07", "failed.json", "ray")["error"]
