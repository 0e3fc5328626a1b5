"""The log of a run: stages, times and error figures, side by side in `run.json`."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from sgwarp.files.atomic import atomic_path
from sgwarp.files.inputs import require_apart
from sgwarp.runs.progress import ShowProgress, hide_progress
from sgwarp.version import __version__

MOST_NAMED = 4  # files of one folder that are named one by one
Watch = Callable[[Callable[[], Any]], None]


def ignore(make: Callable[[], Any]) -> None:
    """Watch nothing."""


@dataclass
class RunLog:
    """Record of one run, filled while it goes and written once at the end.

    Attributes:
        command: The command line, or a name for a run from Python.
        version: Version of the package.
        device: "cpu" or a CUDA device.
        threads: Host threads used on the CPU.
        stages: Wall-clock seconds spent in each stage.
        left_out: What was skipped because the scene or the request did not need it: how many, or seconds saved.
        error: The run's own error figures.
        outputs: Files written.
        curve: How a run that improves step by step got there, one row of numbers per measurement; else left out.
        watch: Is given what makes a copy of the run's result so far, each time that it has grown; does nothing by
            default. Not written.
        show: Shows the progress of a stage, as `with log.show(title) as report`; nothing by default. Not written.
    """

    command: str = ""
    version: str = field(default=__version__, init=False)
    device: str = "cpu"
    threads: int = 1
    stages: dict[str, float] = field(default_factory=dict)
    left_out: dict[str, float] = field(default_factory=dict)
    error: dict[str, float] = field(default_factory=dict)
    outputs: list[str] = field(default_factory=list)
    curve: list[dict[str, float]] = field(default_factory=list)
    show: ShowProgress = field(default=hide_progress, repr=False)
    watch: Watch = field(default=ignore, repr=False)

    @contextmanager
    def stage(self, name: str, wait: bool = True) -> Iterator[None]:
        """Add the time spent in the block to stage `name`; one stage may be entered many times.

        On CUDA the block ends when its work is done; with `wait` off, when it is launched, and the next stage that
        waits is charged with the rest.

        Raises:
            InputError: What was read before is where an output would go.
        """
        require_apart()
        start = time.perf_counter()
        try:
            yield
        finally:
            if wait and self.device.startswith("cuda"):
                import torch

                torch.cuda.synchronize(self.device)
            self.stages[name] = self.stages.get(name, 0.0) + time.perf_counter() - start

    def leave_out(self, what: str, amount: float = 1) -> None:
        """Count what was left out; nothing is recorded for an amount of zero."""
        if amount:
            self.left_out[what] = self.left_out.get(what, 0) + amount

    def write(self, folder: Path) -> Path:
        """Write `run.json` into `folder`, whole or not at all; numbers that are not finite become null."""
        record = asdict(replace(self, show=hide_progress, watch=ignore))  # asdict copies whatever they belong to
        del record["show"], record["watch"]
        record["stages"] = {name: round(seconds, 4) for name, seconds in self.stages.items()}
        record["error"] = _finite(self.error)
        record["curve"] = [_finite(row) for row in self.curve]
        if not self.curve:
            del record["curve"]
        path = folder / "run.json"
        with atomic_path(path) as temporary:
            temporary.write_text(json.dumps(record, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        return path

    def summary(self) -> str:
        """One line: times, error figures, what was left out."""
        times = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in self.stages.items())
        errors = ", ".join(f"{name} {value:.4f}" for name, value in self.error.items())
        left = ", ".join(f"{amount:g} {what.replace('_', ' ')}" for what, amount in self.left_out.items())
        return "; ".join(part for part in (times, errors, f"left out: {left}" if left else "") if part)

    def where(self) -> str:
        """One line: the files written, or of a folder that has many their number; empty if there are none."""
        by_folder: dict[Path, list[str]] = {}
        for path in self.outputs:
            by_folder.setdefault(Path(path).parent, []).append(path)
        parts = []
        for folder, paths in by_folder.items():
            parts += paths if len(paths) <= MOST_NAMED else [f"{len(paths)} files in {folder}"]
        return f"wrote {', '.join(parts)}" if parts else ""


def _finite(numbers: dict[str, float]) -> dict[str, float | None]:
    return {name: value if math.isfinite(value) else None for name, value in numbers.items()}
