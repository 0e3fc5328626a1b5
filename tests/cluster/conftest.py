"""A batch of generated scenes whose stages are quick and need no library, in worker processes."""

import json
import os
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from sgwarp.cluster.tasks import OUT, Limits, Outcome, Stage, Task

RUNNER = """
import hashlib, json, os, time
from pathlib import Path
from sgwarp.errors import InputError
from sgwarp.files.atomic import atomic_path

def run(stage, arguments):
    source, out, seconds = Path(arguments[0]), Path(arguments[1]), float(arguments[2])
    text = source.read_text()
    if text == "fails":
        raise InputError(f"{source}: is of the kind that fails")
    if text == "breaks":
        raise ZeroDivisionError("two\\nlines")
    if text == "dies":
        os.kill(os.getpid(), 9)
    if text == "hangs":
        time.sleep(3600)
    if text == "eats":
        held = [bytearray(b"x" * 10_000_000) for _ in range(60)]
        time.sleep(3600)
    with (source.parent.parent / "starts.txt").open("a") as file:
        file.write(f"{source.parent.name} {stage}\\n")
    time.sleep(seconds)
    target = out / f"{stage}.bin"
    with atomic_path(target) as temporary:
        temporary.write_bytes(hashlib.sha512(f"{stage} {text}".encode()).digest() * 2000)
    print("worked on", source.name)
    (out / "run.json").write_text(json.dumps({"error": {"size": len(text)}, "outputs": [str(target)]}))
"""


NONE = Limits()


@dataclass(frozen=True)
class Batch:
    folder: Path
    seconds: float = 0.0
    stages: tuple[str, ...] = ("first", "second")

    def add(self, name: str, text: str) -> Path:
        (self.folder / "in" / name).mkdir(parents=True, exist_ok=True)
        path = self.folder / "in" / name / "data.txt"
        path.write_text(text)
        return path

    def tasks(self, out: str = "out", run: str = "run 1", limits: Limits = NONE, retry: bool = False) -> list[Task]:
        names = sorted(os.listdir(self.folder / "in"))
        found = []
        for name in names:
            if not (self.folder / "in" / name).is_dir():
                continue
            source = str(self.folder / "in" / name / "data.txt")
            stages = tuple(Stage(stage, (source, OUT, str(self.seconds))) for stage in self.stages)
            fixed = {"runner": "batch_runner:run", "run": run, "limits": limits, "retry": retry}
            found.append(Task(name, str(self.folder / out), stages, (str(Path(source).parent),), **fixed))
        return found

    def slower(self, seconds: float) -> "Batch":
        return replace(self, seconds=seconds)

    def results(self, out: str = "out") -> dict[str, bytes]:
        """Every file that stages wrote, in finished scenes and anywhere else."""
        folder = self.folder / out
        return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*.bin"))}

    def record(self, name: str, what: str = "done.json", out: str = "out") -> dict:
        return json.loads((self.folder / out / name / what).read_text())

    def folders(self, out: str = "out") -> list[str]:
        return sorted(path.name for path in (self.folder / out).iterdir() if path.name != ".locks")

    def statuses(self, outcomes: Iterable[Outcome]) -> dict[str, str]:
        found = [(outcome.name, outcome.status) for outcome in outcomes]
        assert len(dict(found)) == len(found), "a scene is reported twice"
        return dict(found)

    def starts(self) -> list[str]:
        path = self.folder / "in" / "starts.txt"
        return path.read_text().split("\n")[:-1] if path.is_file() else []


@pytest.fixture
def batch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Batch]:
    (tmp_path / "batch_runner.py").write_text(RUNNER)
    monkeypatch.syspath_prepend(str(tmp_path))
    made = Batch(tmp_path)
    for number in range(12):
        made.add(f"scene{number:02d}", f"scene {number}")
    yield made
    sys.modules.pop("batch_runner", None)
