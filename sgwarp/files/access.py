"""Opening input files: whatever the operating system objects to becomes one clear line."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sgwarp.errors import InputError


@contextmanager
def reading(path: str | os.PathLike[str]) -> Iterator[None]:
    """Turn an OSError inside the block into an InputError that names `path`."""
    try:
        yield
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; check the path") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a folder; give the name of a file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None


def read_bytes(path: str | os.PathLike[str]) -> bytes:
    """The whole content of a file.

    Raises:
        InputError: The file is missing, a folder or not readable.
    """
    with reading(path):
        return Path(path).read_bytes()
