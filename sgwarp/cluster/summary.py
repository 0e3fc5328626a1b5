"""What became of many scenes: a line while they are at work, a table afterwards."""

from __future__ import annotations

import csv
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from sgwarp.cluster.tasks import Outcome
from sgwarp.files.atomic import atomic_path

SHOWN = 20  # failures in the printed table
SIZES = ("gaussians", "views")


@dataclass
class Tally:
    """Outcomes so far.

    Attributes:
        outcomes: In the order in which the scenes ended.
        began: When the first scene was handed out [s, monotonic].
    """

    outcomes: list[Outcome] = field(default_factory=list)
    began: float = field(default_factory=time.monotonic)

    def count(self, status: str) -> int:
        return sum(outcome.status == status for outcome in self.outcomes)

    def line(self, total: int, before: int) -> str:
        """Failed, scenes per hour, time left.

        Args:
            total: Scenes, those still to do as well.
            before: How many of the outcomes were known before the work began.
        """
        worked = len(self.outcomes) - before
        seconds = max(time.monotonic() - self.began, 1e-9)
        parts = [f"{self.count('failed')} failed"]
        if worked:
            left = (total - len(self.outcomes)) * seconds / worked
            parts += [f"{worked * 3600 / seconds:.0f} scenes/h", f"{duration(left)} left"]
        return ", ".join(parts)


def duration(seconds: float) -> str:
    """Hours, minutes and seconds."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{rest:02d}"


def table(outcomes: Sequence[Outcome]) -> str:
    """Lines for people: how many of each kind, the seconds of each stage, who failed why."""
    counts = Counter(outcome.status for outcome in outcomes)
    lines = [", ".join(f"{counts[status]} {status}" for status in ("done", "skipped", "failed")) + " scenes"]
    for stage in stages_of(outcomes):
        taken = sorted(outcome.seconds[stage] for outcome in outcomes if stage in outcome.seconds)
        middle = taken[len(taken) // 2]
        lines.append(f"  {stage}: {middle:.2f} s per scene (median), {taken[-1]:.2f} s at most")
    failed = sorted((outcome for outcome in outcomes if outcome.status == "failed"), key=lambda found: found.name)
    lines += [f"  {outcome.name}: {outcome.error}" for outcome in failed[:SHOWN]]
    if len(failed) > SHOWN:
        lines.append(f"  and {len(failed) - SHOWN} more that failed")
    return "\n".join(lines)


def write_table(outcomes: Sequence[Outcome], path: Path) -> None:
    """A CSV file, one line per scene: status, seconds per stage, memory, figures, error."""
    stages = stages_of(outcomes)
    figures = sorted(
        {(stage, name) for outcome in outcomes for stage in outcome.figures for name in outcome.figures[stage]}
    )
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        heads = [f"{stage} [s]" for stage in stages] + [f"{stage} {name}" for stage, name in figures]
        writer.writerow(["scene", "status", *heads, *SIZES, "peak memory [bytes]", "error"])
        for outcome in sorted(outcomes, key=lambda found: found.name):
            cells = [outcome.seconds.get(stage, "") for stage in stages]
            cells += [outcome.figures.get(stage, {}).get(name, "") for stage, name in figures]
            cells += [outcome.size.get(what, "") for what in SIZES]
            writer.writerow([outcome.name, outcome.status, *cells, outcome.peak_memory or "", outcome.error])


def stages_of(outcomes: Iterable[Outcome]) -> list[str]:
    """All stages that some scene went through, in their order."""
    return list(dict.fromkeys(stage for outcome in outcomes for stage in outcome.seconds))
