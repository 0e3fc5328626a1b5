"""What a command reads is never written over; readers and writers of files meet here.

While `inputs_kept` is open, every file that is read (`access.reading`), and every photograph that a data set names, is
an input. Such a file is refused as an output. Where an output was announced and is then read, the next stage of the
work is refused (not the reading: a reader may take a file that it cannot have for one to leave out). So the slip is
found before the work is done where names are known, and before anything is lost in any case. Files are compared by
what they are, not by name: links do not hide them.

A command's own state (a checkpoint that it goes on from, a map in its cache, a record of an earlier run) is read inside
`own_files`, and what it wrote itself is its own, too.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field

from sgwarp.errors import InputError

Name = str | os.PathLike[str]
Identity = tuple[int, int]


@dataclass
class _Watch:
    read: dict[Identity, str] = field(default_factory=dict)
    announced: dict[Identity, str] = field(default_factory=dict)
    made: set[Identity] = field(default_factory=set)
    slip: str = ""  # an announced output that was read


_watch: _Watch | None = None  # of the command that this process runs; its readers may be in other threads
_own: ContextVar[bool] = ContextVar("own", default=False)


@contextmanager
def inputs_kept() -> Iterator[None]:
    """Watch what is read and written in the block."""
    global _watch
    before, _watch = _watch, _Watch()
    try:
        yield
    finally:
        _watch = before


@contextmanager
def own_files() -> Iterator[None]:
    """What is read in the block is the command's own state, which it may write again."""
    token = _own.set(True)
    try:
        yield
    finally:
        _own.reset(token)


def note_input(path: Name, found: os.stat_result | None = None) -> None:
    """A file that is read, or named as belonging to what is read."""
    if _watch is None or _own.get():
        return
    known = identity(path) if found is None else (found.st_dev, found.st_ino)
    if known is None or known in _watch.made:
        return
    if known in _watch.announced:
        _watch.slip = _watch.slip or _watch.announced[known]
    _watch.read[known] = os.fspath(path)


def announce_outputs(option: str, paths: Iterable[Name]) -> None:
    """Files that will be written; `option` says in messages where their names come from.

    Raises:
        InputError: One of them is an input.
    """
    if _watch is None:
        return
    require_apart()
    for path in paths:
        known = identity(path)
        if known is not None:
            _refuse(option, path, known)
            _watch.announced[known] = f"{option} {os.fspath(path)}"


def require_apart() -> None:
    """Refuse to go on where an announced output was read.

    Raises:
        InputError: One was.
    """
    if _watch is not None and _watch.slip:
        raise InputError(f"{_watch.slip}: is read by this command; choose another name or folder")


def require_no_input(path: Name) -> None:
    """Refuse to write a file that was read.

    Raises:
        InputError: It was, or another output was.
    """
    require_apart()
    if _watch is not None and (known := identity(path)) is not None:
        _refuse("output", path, known)


def require_no_inputs_in(folder: Name) -> None:
    """Refuse to remove a folder that holds a file that was read.

    Raises:
        InputError: It does.
    """
    if _watch is None or not _watch.read:
        return
    for place, _, names in os.walk(folder):
        for name in names:
            require_no_input(os.path.join(place, name))


def note_output(path: Name) -> None:
    """A file that was written by this command."""
    if _watch is not None and (known := identity(path)) is not None:
        _watch.made.add(known)
        _watch.read.pop(known, None)  # of a file that is gone, whose number this one got


def identity(path: Name) -> Identity | None:
    """The file itself, whatever it is called; None if there is none."""
    try:
        found = os.stat(path)
    except (OSError, ValueError):
        return None
    return found.st_dev, found.st_ino


def _refuse(option: str, path: Name, known: Identity) -> None:
    assert _watch is not None
    if known in _watch.read:
        raise InputError(f"{option} {os.fspath(path)}: is read by this command; choose another name or folder")
