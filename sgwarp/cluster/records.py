"""What lies in the folder of results: a finished folder per scene, the one at work, and what failed.

    NAME/            finished, whole; done.json says how it came about
    NAME/failed.json why there are no results
    .NAME.partial/   at work, or left by a process that was killed; stages.json says what is there
    .locks/NAME      held by the process at work

A folder at work is renamed to NAME once it is complete, so NAME never holds half of anything.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import time
from collections.abc import Iterable, Iterator, Set
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sgwarp.errors import InputError
from sgwarp.files import documents
from sgwarp.files.atomic import atomic_path
from sgwarp.files.inputs import own_files

if TYPE_CHECKING:
    from sgwarp.cluster.tasks import Task

DONE, FAILED, STAGES = "done.json", "failed.json", "stages.json"
LOG = "log.txt"  # what the commands of a scene have printed
WAIT = 3.0  # seconds for a lock: workers of a killed driver end within one
CHUNK = 2**20


class Held(InputError):
    """Another process is at the scene."""


@dataclass(frozen=True)
class Place:
    """Where the results of a scene lie.

    Attributes:
        folder: Of all results.
        name: Of the scene.
    """

    folder: Path
    name: str

    @property
    def final(self) -> Path:
        return self.folder / self.name

    @property
    def partial(self) -> Path:
        return self.folder / f".{self.name}.partial"

    @property
    def old(self) -> Path:
        return self.folder / f".{self.name}.old"

    def prepare(self) -> None:
        """Remove what a process left that was killed while it replaced older results.

        Raises:
            InputError: What lies there was not written by a batch: it is not replaced.
        """
        names = [path.name for path in self.final.iterdir()] if self.final.is_dir() else []
        foreign = any(name[0] != "." for name in names) and not {DONE, FAILED, LOG} & set(names)
        if foreign or (self.final.exists() and not self.final.is_dir()):
            raise InputError(f"{self.final}: holds no results of a batch, and is not replaced; choose another --out")
        if (self.final / DONE).is_file():
            shutil.rmtree(self.old, ignore_errors=True)

    def finish(self) -> None:
        """Give the folder at work its name, in place of an older one."""
        shutil.rmtree(self.old, ignore_errors=True)
        if self.final.exists():
            os.rename(self.final, self.old)
        os.rename(self.partial, self.final)
        shutil.rmtree(self.old, ignore_errors=True)

    def fail(self, record: dict[str, Any]) -> None:
        """Write why there are no results; those of other options or inputs are no longer called done."""
        self.final.mkdir(parents=True, exist_ok=True)
        write_json(self.final / FAILED, record)
        (self.final / DONE).unlink(missing_ok=True)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Only one process works on a scene; the lock ends with its process.

        Raises:
            Held: Another one has it.
        """
        import fcntl

        path, end = self.folder / ".locks" / self.name, time.monotonic() + WAIT
        path.parent.mkdir(parents=True, exist_ok=True)
        while True:
            handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if _same_file(handle, path):
                    break
            except BlockingIOError:
                if time.monotonic() > end:
                    os.close(handle)
                    raise Held(f"{self.final}: another process works on it; wait until it has ended") from None
                time.sleep(0.1)
            os.close(handle)
        try:
            yield
        finally:
            with suppress(OSError):
                path.unlink()  # while it is held: who waits sees that the name is gone
            os.close(handle)


def _same_file(handle: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(handle), os.stat(path))
    except OSError:
        return False


def read_json(path: Path) -> dict[str, Any]:
    """The record in a file; empty if there is none, or none that can be read."""
    try:
        with own_files():
            record = documents.read_json(path)
    except InputError:
        return {}
    return record if isinstance(record, dict) else {}


def write_json(path: Path, record: dict[str, Any]) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")


def fingerprint(paths: tuple[str, ...], contents: bool) -> dict[str, dict[str, Any]]:
    """Of every input: number of files, bytes, a hash of names, sizes and times, and if asked one of the contents.

    Raises:
        InputError: An input is not there.
    """
    return {path: _fingerprint(Path(path), contents) for path in sorted(set(paths))}


def _fingerprint(path: Path, contents: bool) -> dict[str, Any]:
    files = [path] if os.path.isfile(path) else sorted(_files_below(path))
    if not os.path.exists(path):
        raise InputError(f"{path}: no such file or folder; check the list of scenes")
    states, whole, size = hashlib.sha256(), hashlib.sha256(), 0
    try:
        for file in files:
            status, name = file.stat(), os.fsencode(file.relative_to(path)) if file != path else b""
            size += status.st_size
            states.update(b"%d:%s %d %d\n" % (len(name), name, status.st_size, status.st_mtime_ns))
            if contents:
                whole.update(b"%d:%s %s\n" % (len(name), name, _hash(file)))
    except OSError as error:
        raise InputError(f"{error.filename or path}: cannot be read ({error.strerror or error})") from None
    found = {"files": len(files), "bytes": size, "state": states.hexdigest()}
    return found | ({"sha256": whole.hexdigest()} if contents else {})


def _files_below(folder: Path) -> Iterator[Path]:
    for place, folders, names in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        # A pipe among them would be read without end.
        yield from (path for name in names if not name.startswith(".") and os.path.isfile(path := Path(place) / name))


def _hash(path: Path) -> bytes:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(CHUNK):
            digest.update(chunk)
    return digest.hexdigest().encode()


def unchanged(inputs: dict[str, Any], paths: tuple[str, ...]) -> bool:
    """Whether recorded inputs are what lies there now: the same times and sizes, or else the same contents."""
    if set(inputs) != set(paths):
        return False
    try:
        for path in inputs:
            held, now = inputs[path], _fingerprint(Path(path), contents=False)
            if (held["files"], held["bytes"]) != (now["files"], now["bytes"]):
                return False
            if held["state"] != now["state"] and held["sha256"] != _fingerprint(Path(path), contents=True)["sha256"]:
                return False
    except (InputError, KeyError, TypeError):
        return False
    return True


def check_apart(tasks: Iterable[Task], out: Path, names: Set[str]) -> None:
    """Refuse results that would replace what they are made from, or lie in it.

    Args:
        tasks: With their inputs.
        out: Folder of all results.
        names: Of all scenes of the list.

    Raises:
        InputError: An input lies in a folder of results, or the folder of results in an input.
    """
    results = out.resolve()
    for task in tasks:
        for source in map(Path, task.inputs):
            place = source.resolve()
            if place == results or place in results.parents:
                raise InputError(f"--out {out}: lies in {source}, which scene {task.name} reads; choose another folder")
            if results in place.parents and place.relative_to(results).parts[0] in names:
                raise InputError(
                    f"--out {out}: scene {task.name} reads {source}, which its results would replace; choose another "
                    "folder, or add stages to --do of the batch that wrote it"
                )
