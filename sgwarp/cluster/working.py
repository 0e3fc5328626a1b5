"""One scene, from its list of stages to its finished folder. The same in a worker of this machine and in one of Ray."""

from __future__ import annotations

import os
import shutil
import socket
import sys
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from sgwarp.cluster.records import (
    DONE,
    FAILED,
    LOG,
    STAGES,
    Held,
    Place,
    fingerprint,
    read_json,
    unchanged,
    write_json,
)
from sgwarp.cluster.tasks import OUT, Outcome, Task, named_function
from sgwarp.cluster.watching import watched
from sgwarp.errors import InputError, printable
from sgwarp.runs.memory import peak
from sgwarp.version import __version__

LONGEST = 1000  # characters of a recorded error


def settled(task: Task) -> Outcome | None:
    """What is known of a scene without doing anything; None if there is something to do."""
    place = Place(Path(task.folder), task.name)
    done, failed = read_json(place.final / DONE), read_json(place.final / FAILED)
    if failed and failed.get("run") == task.run:
        return Outcome(task.name, "failed", str(failed.get("error")))
    if failed and not task.retry and _same(failed, task):
        return Outcome(task.name, "failed", str(failed.get("error")))
    if done and _same(done, task) and not place.old.exists():
        known = done.get("seconds", {}), done.get("peak_memory", 0), done.get("figures", {}), done.get("size", {})
        return Outcome(task.name, "skipped", "", *known)
    return None


def _same(record: dict[str, Any], task: Task) -> bool:
    options, inputs = record.get("options"), record.get("inputs")
    ordered = isinstance(options, dict) and list(options.items()) == list(task.options.items())
    return ordered and isinstance(inputs, dict) and unchanged(inputs, task.inputs)


def work(task: Task) -> Outcome:
    """Do a scene, unless it is done; what goes wrong is recorded and returned, not raised."""
    place = Place(Path(task.folder), task.name)
    try:
        with place.locked():
            place.prepare()
            return settled(task) or _work(task, place)
    except Held as error:
        return Outcome(task.name, "held", _line(error))
    except (InputError, OSError) as error:  # the folder of results cannot be written
        return Outcome(task.name, "failed", _line(error))


def _work(task: Task, place: Place) -> Outcome:
    known: dict[str, Any] = {"scene": task.name, "version": __version__, "options": task.options, "inputs": {}}

    def fail(line: str) -> Outcome:
        line = printable(line)[:LONGEST]
        place.fail({**known, "run": task.run, "error": line, "peak_memory": peak()})
        return Outcome(task.name, "failed", line)

    try:
        with watched(task.limits, fail):
            known["inputs"] = fingerprint(task.inputs, contents=True)
            if task.fault:
                raise InputError(task.fault)
            stages = _resumed(task, place, known["inputs"])
            with written_to(place.partial / LOG):
                for stage in task.stages:
                    if stage.name not in stages:
                        stages[stage.name] = _do(task, place, stage.name, stage.arguments)
                        _write_stages(place, task, known["inputs"], stages)
                size = _measure(task, place)
    except Exception as error:
        return fail(_line(error))
    seconds = {name: stages[name]["seconds"] for name in task.options}
    figures = {name: stages[name]["figures"] for name in task.options}
    known |= {"seconds": seconds, "peak_memory": peak(), "figures": figures, "size": size}
    outputs = {name: stages[name]["outputs"] for name in task.options}
    write_json(place.partial / DONE, {**known, "outputs": outputs, "host": socket.gethostname()})
    (place.partial / STAGES).unlink(missing_ok=True)
    place.finish()
    return Outcome(task.name, "done", "", seconds, known["peak_memory"], figures, size)


def give_up(task: Task, line: str) -> Outcome:
    """Record that the processes of a scene ended without a word, again and again."""
    place = Place(Path(task.folder), task.name)
    known = settled(task)  # it may have recorded why before it ended
    if known is not None:
        return known
    record = {"scene": task.name, "version": __version__, "options": task.options, "run": task.run, "error": line}
    with suppress(InputError, OSError):  # without a record it is tried again in the next run
        place.fail({**record, "inputs": fingerprint(task.inputs, contents=True)})
    return Outcome(task.name, "failed", line)


def _measure(task: Task, place: Place) -> dict[str, int]:
    """How large the scene was."""
    if not task.measure:
        return {}
    stages = {stage.name: [word.replace(OUT, str(place.partial)) for word in stage.arguments] for stage in task.stages}
    return dict(named_function(task.measure)(stages))


def _do(task: Task, place: Place, name: str, arguments: tuple[str, ...]) -> dict[str, Any]:
    """Run a stage in the folder at work; returns its record."""
    start = time.perf_counter()
    named_function(task.runner)(name, [word.replace(OUT, str(place.partial)) for word in (*arguments, *task.common)])
    seconds = time.perf_counter() - start
    # The command's log lies beside its output or in it; there the next command would write over it.
    logs = [place.partial / "run.json", *place.partial.glob("*/run.json")]
    log = max(filter(Path.is_file, logs), key=lambda path: path.stat().st_mtime_ns, default=None)
    run = read_json(log) if log else {}
    if log:
        text = log.read_text(encoding="utf-8").replace(str(place.partial), str(place.final))
        (place.partial / f"{name}.run.json").write_text(text, encoding="utf-8")
        log.unlink()
    outputs = [os.path.relpath(path, place.partial) for path in run.get("outputs", [])]
    record = {"seconds": round(seconds, 4), "figures": run.get("error", {}), "outputs": outputs}
    return {"arguments": list(arguments), **record}


def _resumed(task: Task, place: Place, inputs: dict[str, Any]) -> dict[str, Any]:
    """Records of the leading stages that are done already; the folder at work is there afterwards.

    Either a killed process has left them, with files of the stage that it was killed in: a fit goes on from its
    checkpoint. Or the scene was finished, and stages were added since.
    """
    finished = not place.partial.exists()
    held = _finished_stages(place) if finished else read_json(place.partial / STAGES)
    before, now = held.get("stages", {}), task.options
    fits = _contents(held.get("inputs")) == _contents(inputs)
    fits &= list(before) == list(now)[: len(before)]
    fits &= all(record["arguments"] == now[name] for name, record in before.items() if name in now)
    if held.get("options") and not finished:  # the stage at work had these
        fits &= held["options"] == now
    stages = before if fits else {}
    if place.partial.exists() and not (held and fits):
        shutil.rmtree(place.partial)
    if finished and stages:
        shutil.copytree(place.final, place.partial, copy_function=_link, ignore=shutil.ignore_patterns(DONE, FAILED))
    place.partial.mkdir(parents=True, exist_ok=True)
    _write_stages(place, task, inputs, stages)
    return stages


def _write_stages(place: Place, task: Task, inputs: dict[str, Any], stages: dict[str, Any]) -> None:
    write_json(place.partial / STAGES, {"inputs": inputs, "options": task.options, "stages": stages})


def _finished_stages(place: Place) -> dict[str, Any]:
    """Those of the finished folder, as the folder at work records them."""
    done = read_json(place.final / DONE)
    try:
        stages = {
            name: {"arguments": arguments, **{what: done[what][name] for what in ("seconds", "figures", "outputs")}}
            for name, arguments in done.get("options", {}).items()
        }
    except (KeyError, TypeError):
        return {}
    return {"inputs": done.get("inputs"), "stages": stages}


def _link(source: str, target: str) -> None:
    """The same file under another name: results are only ever replaced, except the log, which grows."""
    if os.path.basename(source) != LOG:
        try:
            os.link(source, target)
            return
        except OSError:  # a file system without links
            pass
    shutil.copy2(source, target)


def _contents(inputs: Any) -> dict[str, str]:
    """Hashes of the contents alone: a copy of the same files has other times."""
    return {path: held.get("sha256", "") for path, held in (inputs or {}).items()}


@contextmanager
def written_to(path: Path) -> Iterator[None]:
    """In the block, what goes to stdout and stderr goes to a file, native libraries' lines included."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = os.dup(1), os.dup(2)
    with path.open("a", encoding="utf-8") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    try:
        yield
    except Exception:
        traceback.print_exc()
        raise
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        for number, handle in enumerate(kept, start=1):
            os.dup2(handle, number)
            os.close(handle)


def _line(error: Exception) -> str:
    """One line for a record; what only the developers of the package can understand bears its type."""
    text = (str(error).strip().splitlines() or [""])[0]
    if isinstance(error, InputError):
        return text
    if isinstance(error, MemoryError):
        return "there is not enough memory; use fewer views, pixels or Gaussians, or fewer workers"
    return f"{type(error).__name__}: {text}"
