"""`sgwarp distill` on what a batch lifted, by torchrun on two hosts, against one process: do losses agree?

    python -m benchmarks.distill_hosts [--scenes 4] [--epochs 2] [--out benchmarks/distill_hosts.json]

The hosts are two network namespaces of this machine, with a process each and gloo between them; it needs root.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from resuming import RUN, write_scenes
from two_hosts import HEAD, refusal, two_hosts

MASTER_PORT = 29511
ENVIRONMENT = {"OMP_NUM_THREADS": "1"}


def command(*words: object) -> list[str]:
    return [sys.executable, "-c", RUN, *map(str, words)]


def on_two_hosts(folder: Path, words: list[str]) -> None:
    script = folder / "run.py"
    script.write_text(RUN)
    with two_hosts() as hosts:
        processes = []
        for rank, (host, end) in enumerate(((hosts.head, hosts.head_end), (hosts.other, hosts.other_end))):
            torchrun = [sys.executable, "-m", "torch.distributed.run", "--nnodes", "2", "--nproc-per-node", "1"]
            torchrun += ["--node-rank", str(rank), "--master-addr", HEAD, "--master-port", str(MASTER_PORT)]
            environment = {**os.environ, **ENVIRONMENT, "GLOO_SOCKET_IFNAME": end}
            processes.append(subprocess.Popen(hosts.command(host, [*torchrun, str(script), *words]), env=environment))
        codes = [process.wait() for process in processes]
    if any(codes):
        raise SystemExit(f"torchrun ended with {codes}")


def run(count: int, epochs: int) -> dict[str, object]:
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        write_scenes(folder / "data", 1)
        for number in range(1, count):  # labels of other rooms differ
            shutil.copytree(folder / "data" / "room000", folder / "data" / f"room{number:03d}")
        lift = command("batch", folder / "data", "--do", "lift", "--out", folder / "results", "--threads", 1)
        environment = {**os.environ, **ENVIRONMENT}
        subprocess.run([*lift, "--options", "lift.encoder=files:{path}/labels"], check=True, env=environment)
        words = ["distill", folder / "results", "--arch", "14A", "--voxel", "0.3", "--epochs", epochs, "--threads", 1]
        words = [*map(str, words), "--scenes-per-step", "2", "--no-augment", "--up", "y"]
        subprocess.run(
            [*command(*words), "--out", str(folder / "one" / "net.safetensors")], check=True, env=environment
        )
        on_two_hosts(folder, [*words, "--out", str(folder / "two" / "net.safetensors")])
        one, two = (json.loads((folder / name / "net_curves.json").read_text()) for name in ("one", "two"))
    losses = [[row["loss"] for row in rows] for rows in (one, two)]
    largest = max(abs(a - b) / abs(a) for a, b in zip(*losses, strict=True))
    return {
        "scenes": count,
        "losses, one process": losses[0],
        "losses, two hosts": losses[1],
        "largest difference": largest,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=4)
    parser.add_argument("--epochs", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("distill_hosts.json"))
    options = parser.parse_args()
    if reason := refusal():
        raise SystemExit(reason)
    result = run(options.scenes, options.epochs)
    options.out.write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
