"""Names of files that a data set lists: they lead into the data set, or nowhere."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

from sgwarp.errors import InputError

VARIABLE = "SGWARP_OUTSIDE"
ADDRESS = "file://"


def inside(source: str | os.PathLike[str], folder: Path, name: str) -> Path:
    """The file below `folder` that `source` calls `name`.

    A data set of a stranger may name any file of the machine: absolute paths, and those that climb out of the folder,
    are followed only where the environment variable SGWARP_OUTSIDE is 1, and then said. Symbolic links are followed:
    they were made on this machine, or unpacked knowingly.

    Raises:
        InputError: The name leads out of the folder.
    """
    path = PurePosixPath(name.replace("\\", "/"))
    if path.is_absolute():
        with suppress(ValueError):  # unless it is a file of the data set by its whole path
            path = PurePosixPath(Path(path).relative_to(folder.absolute()))
    depth = 0
    for part in path.parts:
        depth += -1 if part == ".." else 1
        if depth < 0:
            break
    if path.is_absolute() or depth < 0 or (os.name == "nt" and ":" in name):
        if os.environ.get(VARIABLE) != "1":
            raise InputError(
                f"{source}: {name!r} lies outside the data set; move it, or set {VARIABLE}=1 if you trust the list"
            )
        logging.getLogger("sgwarp").warning("%s: %r lies outside the data set, and is read", source, name)
    return folder / path


def spellings(name: str) -> Iterator[str]:
    """A listed name, and the file name that it stands for where it was written as an address."""
    yield name
    plain = name[len(ADDRESS) :] if name.startswith(ADDRESS) else name
    if "%" in plain:
        plain = unquote(plain)
    if plain != name:
        yield plain


def tails(name: str) -> Iterator[str]:
    """What may be left of a name in another folder than it was written for: ever fewer of its folders."""
    *_, plain = spellings(name)
    parts = [part for part in plain.strip().replace("\\", "/").split("/") if part not in ("", ".", "..")]
    if parts and parts[0].endswith(":"):  # a drive
        parts = parts[1:]
    for start in range(len(parts)):
        yield "/".join(parts[start:])


def find_named(source: str | os.PathLike[str], folder: Path, name: str) -> Path | None:
    """The file that a data set calls `name`, or, where it was moved since, the end of that path; None without one.

    A name that leads out of the data set is as one that does not exist.
    """
    for spelling in spellings(name):
        with suppress(InputError):
            if os.path.isfile(path := inside(source, folder, spelling)):
                return path
    return next((folder / tail for tail in tails(name) if os.path.isfile(folder / tail)), None)
