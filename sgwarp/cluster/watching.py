"""A thread beside the work: ends the process when a scene takes too long or too much, or when its driver is gone."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from sgwarp.cluster.tasks import Limits
from sgwarp.runs.memory import reset_peak, resident

INTERVAL = 0.1  # seconds between two looks
GRACE = 5.0  # seconds after the time limit until the system ends a process whose interpreter is stuck
OVER = 75  # exit code of a process that ended itself after it had recorded why


@contextmanager
def watched(limits: Limits, record: Callable[[str], object]) -> Iterator[None]:
    """In the block, what goes beyond a limit is recorded and ends the process.

    Native code can be stuck without giving the interpreter back: then SIGALRM ends the process, without a record.

    Args:
        limits: Of the scene.
        record: Takes the line that says which limit; called once, in another thread.
    """
    ended = threading.Event()

    def watch() -> None:
        start = time.monotonic()
        while not ended.wait(INTERVAL):
            line = _over(limits, time.monotonic() - start)
            if line and not ended.is_set():
                try:
                    record(line)
                finally:
                    os._exit(OVER)

    reset_peak()
    if limits.seconds is not None:
        signal.setitimer(signal.ITIMER_REAL, limits.seconds * 1.5 + GRACE)
    watcher = threading.Thread(target=watch, name="sgwarp-watch", daemon=True)
    if limits.seconds is not None or limits.memory is not None:
        watcher.start()
    try:
        yield
    finally:
        ended.set()
        if watcher.is_alive():
            watcher.join()
        signal.setitimer(signal.ITIMER_REAL, 0)


def _over(limits: Limits, seconds: float) -> str:
    if limits.seconds is not None and seconds > limits.seconds:
        return f"took more than the time limit of {limits.seconds:g} s; raise --time-limit, or do less per scene"
    if limits.memory is not None and (held := resident()) > limits.memory:
        gigabytes = f"{held / 1e9:.2f} GB of memory, more than the limit of {limits.memory / 1e9:g} GB"
        return f"took {gigabytes}; raise --memory-limit, or use fewer views, pixels or Gaussians"
    return ""


def end_with(parent: int) -> None:
    """End this process when its parent has ended, however that came about."""

    def watch() -> None:
        never = threading.Event()
        while os.getppid() == parent:
            never.wait(INTERVAL)
        os._exit(1)

    threading.Thread(target=watch, name="sgwarp-parent", daemon=True).start()
