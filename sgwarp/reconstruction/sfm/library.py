"""pycolmap, which is optional: found, silenced, and run where Ctrl-C and a progress bar reach it."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sgwarp.errors import InputError

SPARE = 32 * 2**20  # bytes beside the rows: SQLite's log, and pages that it has not yet merged
POLL = 0.25  # seconds between two looks at what has been done


def require_pycolmap() -> Any:
    """The library.

    Raises:
        InputError: It is not installed.
    """
    try:
        import pycolmap
    except ImportError:
        raise InputError("structure from motion needs pycolmap; run: pip install 'sgwarp[sfm]'") from None
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)  # what matters is reported by us, in one line
    return pycolmap


def has_pycolmap() -> bool:
    """Whether the library is installed."""
    try:
        require_pycolmap()
    except InputError:
        return False
    return True


def require_room(database: Path, more: int) -> None:
    """Look whether the disk has room for what is stored next; where it has none, the library ends the process.

    Args:
        database: On this disk.
        more: What is stored next [bytes].

    Raises:
        InputError: There is less.
    """
    try:
        free = shutil.disk_usage(database.parent).free
    except OSError:
        return
    if free < more + SPARE:
        needed = (more + SPARE) / 2**20
        raise InputError(
            f"{database}: the disk has {free / 2**20:.0f} MB left and structure from motion needs {needed:.0f}; make "
            "room or choose another place"
        )


def run_cancellable(database: Path, call: Callable[[Any], Any], watch: Callable[[], None] | None = None) -> Any:
    """Run a long call of the library in a thread.

    Nothing else in this process may open the database meanwhile: the library brings its own SQLite, and closing the
    file in one copy of SQLite drops the locks of the other.

    Args:
        database: Where the call reads and writes, for messages.
        call: Takes the token by which it is canceled.
        watch: Called four times a second meanwhile, to report progress.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed; the call has ended by then, and what it stored remains.
        InputError: The library gives up, as it does where the database cannot be written.
        Exception: What else the call raises.
    """
    token = require_pycolmap().CancellationToken()
    outcome: list[Any] = []
    failure: list[BaseException] = []

    def work() -> None:
        try:
            outcome.append(call(token))
        except BaseException as error:  # handed on to the caller's thread
            failure.append(error)

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    try:
        while thread.is_alive():
            thread.join(POLL)
            if watch is not None:
                watch()
    except KeyboardInterrupt:
        token.cancel()
        thread.join()
        raise
    if failure and isinstance(failure[0], RuntimeError):  # the library's only kind
        reason = " ".join(str(failure[0]).split())
        raise InputError(
            f"{database}: structure from motion cannot go on ({reason}); if the disk is full make room, and start again"
        ) from None
    if failure:
        raise failure[0]
    return outcome[0]
