"""An evaluation of many scenes, killed at random times: does it go on without losing or repeating a scene?

    python -m benchmarks.resuming [--scenes 200] [--seed 0] [--out benchmarks/resuming.json]

Tiny generated rooms are evaluated by the command itself, in a process that SIGKILL ends a random time after its first
record, until one ends by itself. A scene's record must never be written twice, and in the end every scene must have
one.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch

from sgwarp.datasets.synthetic import make_room
from sgwarp.datasets.synthetic_files import save_room

RUN = "import sys; from sgwarp.cli import main; sys.exit(main())"


def write_scenes(folder: Path, count: int) -> None:
    """Rooms of 400 Gaussians with four views of 24 x 18 pixels."""
    torch.set_num_threads(1)
    for seed in range(count):
        save_room(make_room(seed, 400), folder / f"room{seed:03d}", 4, 24, 18, seed)


def start(data: Path, out: Path) -> subprocess.Popen[bytes]:
    arguments = ["evaluate", "room", "--data", str(data), "--out", str(out), "--encoder", "truth", "--hold-out", "2"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", RUN, *arguments, "--sheets", "1", "--threads", "1"]
    return subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def records(out: Path) -> dict[str, tuple[int, int]]:
    """Inode and time of every record that is there."""
    found = {}
    for path in out.glob("scenes/*/result.json"):
        status = path.stat()
        found[path.parent.name] = (status.st_ino, status.st_mtime_ns)
    return found


def wait(process: subprocess.Popen[bytes], out: Path, done: int, seconds: float) -> int | None:
    """Wait for the first new record, and some seconds more; the exit code if the process ends meanwhile."""
    while len(records(out)) <= done:
        if process.poll() is not None:
            return process.returncode
        time.sleep(0.05)
    try:
        return process.wait(seconds)
    except subprocess.TimeoutExpired:
        return None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--longest", type=float, default=6.0, help="seconds from the first record to the latest kill")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("resuming.json"))
    options = parser.parse_args()
    rng, kills, repeated, lost = random.Random(options.seed), 0, 0, 0
    with tempfile.TemporaryDirectory() as place:
        data, out = Path(place) / "data", Path(place) / "out"
        write_scenes(data, options.scenes)
        began, before, progress = time.perf_counter(), records(out), []
        while True:
            process = start(data, out)
            code = wait(process, out, len(before), rng.uniform(0.0, options.longest))
            if code is None:
                process.send_signal(signal.SIGKILL)
                process.wait()
                kills += 1
            now = records(out)
            repeated += sum(now.get(name) not in (None, record) for name, record in before.items())
            lost += sum(name not in now for name in before)
            before = now
            progress.append(len(now))
            print(f"{len(now)} of {options.scenes} scenes after {len(progress)} runs", file=sys.stderr, flush=True)
            if code is not None:
                break
        whole = json.loads((out / "results.json").read_text())
        left = [path.name for path in out.rglob(".*") if path.is_file()]
    result = {
        "scenes": options.scenes,
        "kills": kills,
        "exit code of the last run": code,
        "scenes in the results": len(whole["scenes"]),
        "records written twice": repeated,
        "records lost": lost,
        "temporary files left": len(left),
        "scenes done after each run": progress,
        "seconds": round(time.perf_counter() - began, 1),
    }
    options.out.write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
