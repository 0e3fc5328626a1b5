"""A batch of many scenes whose workers and driver are killed at random: is every scene there once, with the same bytes?

    python -m benchmarks.batch_faults [--engine local|ray|hosts] [--scenes 200] [--seed 0] [--out FILE.json]

Tiny generated rooms are lifted and segmented by the command itself, by two workers. First undisturbed, by the local
engine; then into another folder, while SIGKILL ends a worker or the driver a random time after a scene has been done,
until a driver ends by itself. `hosts` is Ray on two hosts: two network namespaces of this machine, the head and the
driver in one, the workers in the other; it needs root.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import secrets
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from resuming import RUN, write_scenes
from two_hosts import HEAD, PORT, ray_cluster, refusal, two_hosts

ENVIRONMENT = {"OMP_NUM_THREADS": "1"}
WORKER = (b"sgwarp.cluster.worker", b"ray::_remote_work")
DRIVERS = 0.3  # share of the kills that hit the driver
RECORDS = ("*.json", "log.txt", "*.csv")  # hold times


@dataclass
class Place:
    """Where drivers and workers run."""

    engine: str
    roots: list[int] = field(default_factory=list)  # processes whose descendants may be workers, beside the driver's

    def start(self, data: Path, out: Path, *extra: str) -> subprocess.Popen[bytes]:
        words = ["batch", str(data), "--do", "lift,segment", "--out", str(out), "--workers", "2", "--threads", "1"]
        words += ["--engine", self.engine, *extra, "--options", "lift.encoder=files:{path}/labels"]
        command = [sys.executable, "-c", RUN, *words]
        if self.engine == "ray" and self.roots:  # on the head's host, with its /tmp/ray
            command = ["nsenter", "--target", str(self.roots[0]), "--mount", "--net", *command]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
        return subprocess.Popen(command, env={**os.environ, **ENVIRONMENT}, **quiet)

    def workers(self, driver: int) -> list[int]:
        """Processes that are at a scene."""
        return sorted(pid for pid in descendants([driver, *self.roots]) if is_worker(pid))


@contextmanager
def place(engine: str) -> Iterator[tuple[Place, tuple[str, ...]]]:
    """Where to run, and further words of the command line."""
    if engine != "hosts":
        yield Place(engine), ()
        return
    ENVIRONMENT.update(RAY_worker_niceness="0", RAY_AUTH_MODE="token", RAY_AUTH_TOKEN=secrets.token_hex(32))
    with two_hosts() as hosts, ray_cluster(hosts, 2, ENVIRONMENT) as roots:
        yield Place("ray", roots), ("--address", f"{HEAD}:{PORT}")


def descendants(roots: Sequence[int]) -> set[int]:
    """Processes below these, from /proc."""
    parents = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                parents[int(entry.name)] = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            except (OSError, IndexError):
                continue
    found, front = set[int](), set(roots)
    while front:
        front = {pid for pid, parent in parents.items() if parent in front} - found
        found |= front
    return found


def is_worker(pid: int) -> bool:
    try:
        line = Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False
    return any(mark in line for mark in WORKER)


def results(out: Path) -> dict[str, str]:
    """A hash of every file that is no record."""
    paths = [path for path in sorted(out.rglob("*")) if path.is_file() and ".locks" not in path.parts]
    kept = [path for path in paths if path.parent != out and not any(path.match(kind) for kind in RECORDS)]
    return {str(path.relative_to(out)): hashlib.sha256(path.read_bytes()).hexdigest() for path in kept}


def done(out: Path) -> dict[str, tuple[int, int]]:
    """Inode and time of each scene's record."""
    paths = out.glob("[!.]*/done.json")  # a folder at work gets its record before its name
    return {path.parent.name: (path.stat().st_ino, path.stat().st_mtime_ns) for path in paths}


@dataclass
class Disturbance:
    """Kills so far, and what they may not do."""

    rng: random.Random
    mean: float
    drivers: int = 0
    workers: int = 0
    rewritten: int = 0
    seen: dict[str, tuple[int, int]] = field(default_factory=dict)

    def look(self, out: Path) -> int:
        """Count scenes that were done and have been written again; how many are done."""
        now = done(out)
        # A listing may miss a folder while others are renamed.
        self.rewritten += sum(now.get(name, record) != record for name, record in self.seen.items())
        self.seen |= now
        return len(self.seen)

    def _progress(self, driver: subprocess.Popen[bytes], out: Path) -> int | None:
        """Wait until another scene is done, so that a run of kills ends; the exit code if the driver ends meanwhile."""
        before = len(self.seen)
        while self.look(out) <= before:
            if driver.poll() is not None:
                return driver.returncode
            time.sleep(0.05)
        return None

    def disturb(self, where: Place, driver: subprocess.Popen[bytes], out: Path) -> int | None:
        """Kill until the driver has ended; its exit code, or None if it was killed."""
        while True:
            if (code := self._progress(driver, out)) is not None:
                return code
            try:
                return driver.wait(self.rng.expovariate(1 / self.mean))
            except subprocess.TimeoutExpired:
                self.look(out)
            workers = where.workers(driver.pid)
            if self.rng.random() < DRIVERS and workers:
                driver.kill()
                driver.wait()
                self.drivers += 1
                return None
            if workers:
                os.kill(self.rng.choice(workers), signal.SIGKILL)
                self.workers += 1


def run(options: argparse.Namespace) -> dict[str, object]:
    with tempfile.TemporaryDirectory() as folder, place(options.engine) as (where, extra):
        data, whole, out = (Path(folder) / name for name in ("data", "undisturbed", "out"))
        write_scenes(data, options.scenes)
        first = Place("local").start(data, whole)
        said = first.communicate()[1].decode(errors="replace")
        if first.returncode:
            raise SystemExit(f"the undisturbed run ended with {first.returncode}: {said[-2000:]}")
        began, kills, runs = time.perf_counter(), Disturbance(random.Random(options.seed), options.mean), []
        code: int | None = None
        while code is None or code == 1 or code < 0:
            # A scene that lost several workers in one run is recorded as failed.
            retry = ("--retry-failed",) if code == 1 else ()
            driver = where.start(data, out, *extra, *retry)
            code = kills.disturb(where, driver, out)
            runs.append(kills.look(out))
            print(f"{runs[-1]} of {options.scenes} scenes after {len(runs)} runs", file=sys.stderr, flush=True)
            if code == 2:
                raise SystemExit(f"bad input: {driver.stderr.read().decode(errors='replace')}")
        expected, found = results(whole), results(out)
        names = sorted(path.name for path in data.iterdir())
        folders = sorted(path.name for path in out.iterdir() if path.is_dir() and path.name[0] != ".")
        left = [path.name for path in out.iterdir() if path.name[0] == "." and path.name != ".locks"]
        return {
            "scenes": options.scenes,
            "drivers killed": kills.drivers,
            "workers killed": kills.workers,
            "exit code of the last run": code,
            "scenes there": len(done(out)),
            "every scene there once": sorted(done(out)) == names == folders,
            "files": len(found),
            "files with other bytes than undisturbed": sum(found.get(name) != held for name, held in expected.items()),
            "files too many": len(set(found) - set(expected)),
            "folders left at work": len(left),
            "finished scenes written again": kills.rewritten,
            "scenes done after each run": runs,
            "seconds": round(time.perf_counter() - began, 1),
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--engine", choices=("local", "ray", "hosts"), default="local")
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--mean", type=float, default=6.0, help="seconds between kills, on average")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("batch_faults.json"))
    options = parser.parse_args()
    if options.engine == "hosts" and (reason := refusal()):
        raise SystemExit(reason)
    held = json.loads(options.out.read_text()) if options.out.exists() else {}
    held[options.engine] = run(options)
    options.out.write_text(json.dumps(held, indent=1) + "\n")
    print(json.dumps(held[options.engine], indent=1))


if __name__ == "__main__":
    main()
