"""Two hosts on one machine: two network namespaces joined by a cable, each with its own loopback and its own /tmp/ray.

Needs Linux, root and the program `ip` (Debian: iproute2).
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass

HEAD, OTHER = "10.77.0.1", "10.77.0.2"
PORT = 6399


@dataclass(frozen=True)
class Hosts:
    """Names of the namespaces; the head has the address HEAD, the other one OTHER. Then the ends of the cable."""

    head: str
    other: str
    head_end: str
    other_end: str

    def command(self, host: str, words: Sequence[str]) -> list[str]:
        """The command line that runs `words` on a host."""
        return ["ip", "netns", "exec", host, *words]


def refusal() -> str:
    """Why there can be no two hosts here; empty if there can."""
    if not sys.platform.startswith("linux") or os.geteuid() != 0:
        return "network namespaces need Linux and root"
    if shutil.which("ip") is None:
        return "the program ip is not installed (apt-get install iproute2)"
    name = f"sgwarp-try-{os.getpid()}"
    made = subprocess.run(["ip", "netns", "add", name], capture_output=True, text=True)
    if made.returncode:
        return f"ip netns add is refused: {made.stderr.strip()}"
    subprocess.run(["ip", "netns", "delete", name], capture_output=True)
    return ""


@contextmanager
def two_hosts() -> Iterator[Hosts]:
    """Make the namespaces and the cable; they are gone afterwards.

    Raises:
        RuntimeError: The system refuses one of them.
    """
    number = os.getpid()
    hosts = Hosts(f"sgwarp-a-{number}", f"sgwarp-b-{number}", f"sga{number}", f"sgb{number}")
    ends = {hosts.head: (hosts.head_end, HEAD), hosts.other: (hosts.other_end, OTHER)}
    try:
        for host in ends:
            _ip("netns", "add", host)
        _ip("link", "add", ends[hosts.head][0], "type", "veth", "peer", "name", ends[hosts.other][0])
        for host, (end, address) in ends.items():
            _ip("link", "set", end, "netns", host)
            _ip("-n", host, "address", "add", f"{address}/24", "dev", end)
            for device in ("lo", end):
                _ip("-n", host, "link", "set", device, "up")
        yield hosts
    finally:
        for host in ends:
            subprocess.run(["ip", "netns", "delete", host], capture_output=True)


def _ip(*words: str) -> None:
    made = subprocess.run(["ip", *words], capture_output=True, text=True)
    if made.returncode:
        raise RuntimeError(f"ip {' '.join(words)}: {made.stderr.strip()}")


@contextmanager
def ray_cluster(hosts: Hosts, cores: int, environment: Mapping[str, str]) -> Iterator[list[int]]:
    """A head of Ray without cores on one host and a node with `cores` on the other; yields the processes of both."""
    start = [sys.executable, "-m", "ray.scripts.scripts", "start", "--block", "--disable-usage-stats"]
    start.append("--object-store-memory=100000000")
    head = [
        *start,
        "--head",
        f"--node-ip-address={HEAD}",
        f"--port={PORT}",
        "--num-cpus=0",
        "--include-dashboard=false",
    ]
    node = [*start, f"--address={HEAD}:{PORT}", f"--node-ip-address={OTHER}", f"--num-cpus={cores}"]
    # `ip netns exec` has made mounts of its own: nothing but the cable and the disk is shared.
    apart = 'mkdir -p /tmp/ray && mount -t tmpfs none /tmp/ray && mount -t tmpfs none /dev/shm && exec "$@"'
    processes = []
    try:
        for host, words in ((hosts.head, head), (hosts.other, node)):
            command = hosts.command(host, ["sh", "-c", apart, "sh", *words])
            quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
            processes.append(subprocess.Popen(command, env={**os.environ, **environment}, **quiet))
            if host == hosts.head:
                _wait_for(hosts, HEAD)
        yield [process.pid for process in processes]
    finally:
        for process in reversed(processes):
            process.terminate()
        for process in processes:
            with suppress(subprocess.TimeoutExpired):
                process.wait(30)
            process.kill()
        for host in (hosts.head, hosts.other):  # whatever is left of Ray there
            listed = subprocess.run(["ip", "netns", "pids", host], capture_output=True, text=True).stdout.split()
            for pid in map(int, listed):
                with suppress(ProcessLookupError):
                    os.kill(pid, 9)


def _wait_for(hosts: Hosts, address: str, seconds: float = 120.0) -> None:
    """Until the head answers at its port."""
    probe = f"import socket; socket.create_connection(({address!r}, {PORT}), 1).close()"
    end = time.monotonic() + seconds
    while subprocess.run(hosts.command(hosts.other, [sys.executable, "-c", probe]), capture_output=True).returncode:
        if time.monotonic() > end:
            raise RuntimeError(f"the head of Ray does not answer at {address}:{PORT}")
        time.sleep(0.5)
