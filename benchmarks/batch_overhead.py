"""What a batch adds to scenes of five seconds: processor and wall-clock time per scene, by engine, against a loop.

    python -m benchmarks.batch_overhead [--scenes 6] [--seconds 5] [--out benchmarks/batch_overhead.json]

A scene is work of so many seconds of processor time, and a file. One worker; all engines in one run. Processor time is
that of this process and of all below it, so the figures hold on a busy machine as well. The start (until the first
scene has begun) and the end of an engine are counted apart: they are paid once in a batch.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from batch_faults import descendants

from sgwarp.cluster.local import Call, LocalEngine
from sgwarp.cluster.ray_engine import RayEngine
from sgwarp.cluster.tasks import OUT, Stage, Task, named_function

PREPARE = Call("sgwarp.commands.scene_stages:prepare")
TICK = os.sysconf("SC_CLK_TCK")


def run_stage(name: str, arguments: list[str]) -> None:
    """Work for so many seconds of processor time; the file says when it began and ended [s, wall clock]."""
    out, seconds = Path(arguments[0]), float(arguments[1])
    began, end = time.time(), time.process_time() + seconds
    total = 0
    while time.process_time() < end:
        total += sum(range(1000))
    (out / "times.json").write_text(json.dumps([began, time.time()]))


def tasks(folder: Path, count: int, seconds: float) -> list[Task]:
    source = folder / "input.bin"
    source.write_bytes(bytes(1_000_000))
    stages = (Stage("work", (OUT, str(seconds))),)
    names = [f"scene{number:02d}" for number in range(count)]
    return [
        Task(name, str(folder / "out"), stages, (str(source),), "batch_overhead:run_stage", "run") for name in names
    ]


def processor_time() -> float:
    """Of this process and all below it, ended ones included [s]."""
    total = 0.0
    for pid in {os.getpid()} | descendants([os.getpid()]):
        try:
            fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        total += sum(map(int, fields[11:15])) / TICK  # user and system, of its own and of children that have ended
    return total


def loop(chosen: list[Task]) -> Iterator[None]:
    for task in chosen:
        out = Path(task.folder) / task.name
        out.mkdir(parents=True)
        named_function(task.runner)("work", [word.replace(OUT, str(out)) for word in task.stages[0].arguments])
        yield


def measure(engine: Callable[[list[Task]], Iterator[object]], count: int, seconds: float) -> dict[str, float]:
    """Seconds: processor and wall-clock time per scene from the first to the last; wall-clock time of start and end."""
    with tempfile.TemporaryDirectory() as folder:
        chosen = tasks(Path(folder), count, seconds)
        began = time.time()
        marks = [(time.time(), processor_time()) for _ in engine(chosen)]
        ended = time.time()
        first = json.loads((Path(folder) / "out" / "scene00" / "times.json").read_text())
    wall, busy = ((marks[-1][k] - marks[0][k]) / (count - 1) for k in (0, 1))
    return {
        "processor per scene": round(busy, 3),
        "wall per scene": round(wall, 3),
        "wall, start": round(first[0] - began, 2),
        "wall, end": round(ended - marks[-1][0], 2),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=6)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("batch_overhead.json"))
    options = parser.parse_args()
    engines = {"loop": loop, "local": LocalEngine(1, PREPARE), "ray": RayEngine(1, prepare=PREPARE)}
    found = {name: measure(engine, options.scenes, options.seconds) for name, engine in engines.items()}
    for name in ("local", "ray"):
        for what in ("processor", "wall"):
            key = f"{what} per scene"
            found[name][f"{what} per scene over the loop's"] = round(found[name][key] / found["loop"][key], 4)
    result = {"scenes": options.scenes, "seconds": options.seconds, "load": os.getloadavg()[0], **found}
    options.out.write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
