"""Output files appear whole or not at all."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sgwarp.errors import InputError


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path beside `path`, which takes its place when the block ends.

    The temporary name keeps the suffix (writers choose the format by it) and lies in the same folder (a rename across
    file systems is not atomic). The folder is created if needed. If the block raises, the temporary file is removed
    and a file that was already at `path` stays as it was.

    Raises:
        InputError: `path` is a folder, or its folder cannot be created or written to.
    """
    target = Path(path)
    if target.is_dir():
        raise InputError(f"{target}: is a folder; give the name of a file")
    # The dot hides a half-written file from shell patterns such as *.png.
    temporary = target.with_name(f".{target.stem[:80]}.{secrets.token_hex(4)}{target.suffix}")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary.touch()  # with the permissions of the umask, unlike tempfile's 0600
    except OSError as error:
        raise InputError(f"{target}: cannot be written ({error.strerror or error}); choose another folder") from None
    try:
        wanted = temporary.stat().st_mode
        yield temporary
        temporary.chmod(wanted)  # some writers replace the file by one that only its owner may read
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)
