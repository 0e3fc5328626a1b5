"""The local engine: worker processes on this machine, with nothing but the standard library."""

from __future__ import annotations

import json
import os
import selectors
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from sgwarp.cluster.tasks import Outcome, Task
from sgwarp.cluster.working import give_up
from sgwarp.errors import InputError

TRIES = 4  # processes that a scene may use up before it is recorded as failed
KILLS = 20  # workers killed from outside before their first scene, in a row, until the run is given up
BOOT = "import json, sys; sys.path[:] = json.loads(sys.argv[1]); from sgwarp.cluster.worker import serve; serve({})"


@dataclass(frozen=True)
class Call:
    """A function that each worker calls before its first task: "module:function" and its arguments, plain values."""

    function: str
    arguments: Sequence[Any] = ()


@dataclass(frozen=True)
class LocalEngine:
    """Worker processes that stay, so that what they have loaded stays as well.

    Attributes:
        workers: How many.
        prepare: Called in each worker before its first task.
        warm: Called in the first worker before the others start: what it compiles and downloads is there for them.
        environment: Added to that of the workers.
        devices: CUDA devices, as CUDA_VISIBLE_DEVICES names them: each worker sees one, in turn. All if empty.
    """

    workers: int = 1
    prepare: Call | None = None
    warm: Call | None = None
    environment: dict[str, str] = field(default_factory=dict)
    devices: tuple[str, ...] = ()

    def __call__(self, tasks: Iterable[Task]) -> Iterator[Outcome]:
        """Outcomes, as scenes end; workers that are killed are replaced, and their scenes done again."""
        pool = _Pool(self, deque(tasks))
        try:
            yield from pool.run()
        finally:
            pool.close()


class _Worker:
    """A process, the calls that it is to make first, and the task it is at; None while it prepares."""

    def __init__(self, engine: LocalEngine, calls: Sequence[Call], device: str | None) -> None:
        command = [sys.executable, "-c", BOOT.format(os.getpid()), json.dumps([os.path.abspath(p) for p in sys.path])]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        self.device = device
        environment = {**os.environ, **engine.environment}
        if device is not None:
            environment["CUDA_VISIBLE_DEVICES"] = device
        # A session of its own: Ctrl-C reaches the driver alone, which then ends the workers.
        self.process = subprocess.Popen(command, **pipes, env=environment, start_new_session=True)  # type: ignore[call-overload]
        self.task: Task | None = None
        self.preparing = len(calls)
        for call in calls:
            self.send({"call": call.function, "arguments": list(call.arguments)})

    def send(self, message: dict[str, Any]) -> None:
        with suppress(BrokenPipeError):  # its end is noticed when its answer is read
            self.process.stdin.write(json.dumps(message).encode() + b"\n")
            self.process.stdin.flush()

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()
        self.process.stdout.close()
        with suppress(BrokenPipeError):
            self.process.stdin.close()


class _Pool:
    """Workers, what waits, and how often each scene has cost one its life."""

    def __init__(self, engine: LocalEngine, waiting: deque[Task]) -> None:
        self.engine = engine
        self.waiting = waiting
        self.selector = selectors.DefaultSelector()
        self.deaths: dict[str, int] = {}
        self.warmed = engine.warm is None
        self.unprepared = 0  # workers that ended before their first task, in a row

    def run(self) -> Iterator[Outcome]:
        for _ in range(min(len(self.waiting), self.engine.workers if self.warmed else 1)):
            self._start()
        while self.selector.get_map():
            for key, _ in self.selector.select():
                worker: _Worker = key.data
                line = worker.process.stdout.readline()
                outcome = self._answered(worker, line) if line.endswith(b"\n") else self._ended(worker)
                if outcome is not None:
                    yield outcome
            while self.waiting and len(self.selector.get_map()) < (self.engine.workers if self.warmed else 1):
                self._start()

    def _start(self) -> None:
        calls = (self.engine.prepare, None if self.warmed else self.engine.warm)
        worker = _Worker(self.engine, [call for call in calls if call is not None], self._free_device())
        self.selector.register(worker.process.stdout, selectors.EVENT_READ, worker)
        if not worker.preparing:
            self._next(worker)

    def _free_device(self) -> str | None:
        """The device that the fewest workers have."""
        taken = [key.data.device for key in self.selector.get_map().values()]
        return min(self.engine.devices, key=taken.count, default=None)

    def _next(self, worker: _Worker) -> None:
        """Give the worker a task, or send it home."""
        if not self.waiting:
            self.selector.unregister(worker.process.stdout)
            worker.kill()
            return
        worker.task = self.waiting.popleft()
        worker.send({"task": worker.task.to_json()})

    def _answered(self, worker: _Worker, line: bytes) -> Outcome | None:
        self.unprepared = 0
        if worker.preparing:
            worker.preparing -= 1
            if worker.preparing:
                return None
            self.warmed = True
        outcome = None if worker.task is None else Outcome(**json.loads(line))
        self._next(worker)
        return outcome

    def _ended(self, worker: _Worker) -> Outcome | None:
        """The worker was killed, or ended itself at a limit: do its scene again, or give it up."""
        self.selector.unregister(worker.process.stdout)
        code, task = worker.process.wait(), worker.task
        worker.kill()
        if task is None:
            self.unprepared += 1
            if self.unprepared >= (TRIES if code >= 0 else KILLS):
                raise InputError(f"workers end before their first scene, the last one {_how(code)}; see above")
            self._start()
            return None
        self.deaths[task.name] = self.deaths.get(task.name, 0) + 1
        if self.deaths[task.name] >= TRIES:
            return give_up(task, f"{TRIES} processes ended at it, the last one {_how(code)}")
        self.waiting.appendleft(task)  # it is settled at once if it has recorded why it ended
        return None

    def close(self) -> None:
        for key in list(self.selector.get_map().values()):
            key.data.kill()
        self.selector.close()


def _how(code: int) -> str:
    """How a process ended, from its exit code."""
    if code >= 0:
        return f"with code {code}"
    if -code == signal.SIGKILL:
        return "killed by signal 9; was there not enough memory? Use fewer --workers"
    return f"by signal {-code} ({signal.strsignal(-code)})"
