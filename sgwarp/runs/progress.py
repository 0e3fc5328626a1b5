"""Progress on stderr: a rich bar on a terminal, a plain line without rich, next to nothing in a log file."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import TextIO

from sgwarp.errors import printable

Report = Callable[[int, int, str], None]  # items done, items in all, name of the item at work

ShowProgress = Callable[[str], AbstractContextManager[Report]]  # takes the title of what goes on in the block
LOG_INTERVAL = 30.0  # seconds between two lines in a log file


@contextmanager
def hide_progress(title: str) -> Iterator[Report]:
    """Show nothing: what library code does unless its caller wants otherwise."""
    yield lambda done, total, name: None


@contextmanager
def show_progress(title: str, stream: TextIO | None = None) -> Iterator[Report]:
    """Yield `report(done, total, name)`, to be called before the first item and after each.

    On a terminal the line is redrawn in place. Elsewhere a line appears every 30 seconds, so a short run logs nothing.
    """
    stream = stream or sys.stderr
    if not stream.isatty():
        with _lines(title, stream) as report:
            yield report
        return
    try:
        from rich.console import Console
        from rich.markup import escape
        from rich.progress import Progress
    except ImportError:
        with _redrawn_line(title, stream) as report:
            yield report
        return
    with Progress(console=Console(file=stream), transient=True) as bar:
        task = bar.add_task(title, total=None)
        yield lambda done, total, name: bar.update(
            task, completed=done, total=total, description=f"{title} {escape(printable(name))}"
        )


@contextmanager
def _lines(title: str, stream: TextIO) -> Iterator[Report]:
    last = time.monotonic()

    def report(done: int, total: int, name: str) -> None:
        nonlocal last
        if time.monotonic() - last >= LOG_INTERVAL:
            last = time.monotonic()
            print(f"{title} {done}/{total} {printable(name)}", file=stream, flush=True)

    yield report


@contextmanager
def _redrawn_line(title: str, stream: TextIO) -> Iterator[Report]:
    width = 0

    def report(done: int, total: int, name: str) -> None:
        nonlocal width
        line = f"{title} {done}/{total} {printable(name)}"
        stream.write("\r" + line.ljust(width))
        stream.flush()
        width = len(line)

    try:
        yield report
    finally:
        stream.write("\r" + " " * width + "\r")
        stream.flush()
