"""Opening input files: whatever the operating system objects to becomes one clear line."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from typing import BinaryIO

from sgwarp.errors import InputError
from sgwarp.files.inputs import note_input


@contextmanager
def reading(path: str | os.PathLike[str]) -> Iterator[None]:
    """Turn an OSError inside the block into an InputError that names `path`, which must be a file.

    A pipe would be waited for without end, a device read without end: both are refused before the block.
    """
    if "\0" in os.fspath(path):
        raise InputError(f"{path}: no file can have this name; check the path")
    try:
        found = os.stat(path)
        if not stat.S_ISREG(found.st_mode) and not stat.S_ISDIR(found.st_mode):
            raise InputError(f"{path}: is a pipe or a device; copy what it gives into a file first")
        if not stat.S_ISDIR(found.st_mode):
            note_input(path, found)
        yield
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; check the path") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder; give the name of a file") from None
    except MemoryError:
        raise InputError(
            f"{path}: needs more memory than there is; use a machine with more, or a smaller file"
        ) from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None


@contextmanager
def open_input(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a file for reading bytes.

    Raises:
        InputError: The file is missing, a folder, a pipe or not readable.
    """
    with reading(path), open(path, "rb") as file:
        yield file


def read_bytes(path: str | os.PathLike[str], limit: int | None = None) -> bytes:
    """The whole content of a file.

    Args:
        path: The file.
        limit: Refuse a file of more bytes than this.

    Raises:
        InputError: The file is missing, a folder, a pipe, not readable or too large.
    """
    with open_input(path) as file:
        size = os.fstat(file.fileno()).st_size
        if limit is not None and size > limit:
            raise InputError(f"{path}: has {size} bytes, more than the {limit} that such a file may have")
        return file.read()
