"""Output files appear whole or not at all."""

from __future__ import annotations

import os
import platform
import re
import secrets
import time
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from sgwarp.errors import InputError
from sgwarp.files.inputs import note_output, require_no_input

# Machine and process are part of a temporary name: so a later run knows that nobody writes it any more.
TEMPORARY = re.compile(r"\..*\.([0-9a-f]{4})-([0-9]+)-[0-9a-f]{8}(\.[^.]*)?")
OLD = 24 * 3600.0  # seconds; after that, a temporary file of another machine is left over, too
_swept: set[str] = set()  # folders in which this process has looked for what others left


@contextmanager
def atomic_path(path: str | os.PathLike[str], durable: bool = True) -> Iterator[Path]:
    """Yield a temporary path beside `path`, which takes its place when the block ends.

    The temporary name keeps the suffix (writers choose the format by it) and lies in the same folder (a rename across
    file systems is not atomic). The folder is created if needed. If the block raises, the temporary file is removed
    and a file that was already at `path` stays as it was. If `path` is a symbolic link, the file that it points to is
    replaced. What killed processes left in the folder is removed.

    Args:
        path: The file to write.
        durable: Wait until the disk holds the file before it takes its name, so that it is whole after a power cut.

    Raises:
        InputError: `path` is a folder, an input of the command that runs, or it cannot be written: no space, no
            permission, and whatever else the operating system objects to inside the block.
    """
    target = Path(os.path.realpath(path)) if os.path.islink(path) else Path(path)
    if target.is_dir():
        raise InputError(f"{target}: is a folder; give the name of a file")
    require_no_input(target)
    # The dot hides a half-written file from shell patterns such as *.png.
    token = f"{_machine()}-{os.getpid()}-{secrets.token_hex(4)}"
    temporary = target.with_name(f".{target.stem[:80]}.{token}{target.suffix}")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        _sweep_once(target.parent)
        temporary.touch()  # with the permissions of the umask, unlike tempfile's 0600
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error}); choose another folder") from None
    try:
        wanted = temporary.stat().st_mode
        yield temporary
        temporary.chmod(wanted)  # some writers replace the file by one that only its owner may read
        if durable:
            _flush(temporary)
        os.replace(temporary, target)
        note_output(target)
    except BrokenPipeError:  # of a terminal or a pipe that the block wrote to, not of the file
        raise
    except OSError as error:
        remedy = "make room, or choose another folder"
        raise InputError(f"{path}: cannot be written ({error.strerror or error}); {remedy}") from None
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def leftovers(folder: Path) -> list[Path]:
    """Temporary files in a folder that no process writes any more."""
    found = []
    with os.scandir(folder) as entries:
        for entry in entries:
            match = TEMPORARY.fullmatch(entry.name)
            if match and _is_over(entry, match[1], int(match[2])):
                found.append(Path(entry.path))
    return found


def remove_leftovers(folder: Path) -> None:
    """Remove what killed processes left in a folder; what cannot be removed stays."""
    with suppress(OSError):
        for path in leftovers(folder):
            with suppress(OSError):
                path.unlink(missing_ok=True)


def _sweep_once(folder: Path) -> None:
    name = str(folder.resolve())
    if name not in _swept:
        _swept.add(name)
        remove_leftovers(folder)


def _machine() -> str:
    return f"{zlib.crc32(platform.node().encode()) & 0xFFFF:04x}"


def _is_over(entry: os.DirEntry[str], machine: str, process: int) -> bool:
    try:
        if time.time() - entry.stat(follow_symlinks=False).st_mtime > OLD:
            return True
        if machine != _machine() or process == os.getpid() or os.name != "posix":
            return False
        os.kill(process, 0)  # asks only whether the process is there
    except (ProcessLookupError, OverflowError):
        return True
    except OSError:
        return False
    return _has_ended(process)


def _has_ended(process: int) -> bool:
    """Whether a process is listed only because nobody has asked how it ended, as in containers without an init."""
    try:
        state = Path(f"/proc/{process}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:  # another system than Linux, or it is gone just now
        return False
    return state.rpartition(")")[2].split()[:1] in (["Z"], ["X"])


def _flush(path: Path) -> None:
    handle = os.open(path, os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
