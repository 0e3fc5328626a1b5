"""Names of files that a data set lists: they lead into the data set, or nowhere."""

from __future__ import annotations

import logging
import os
from contextlib import suppress
from pathlib import Path, PurePosixPath

from sgwarp.errors import InputError

VARIABLE = "SGWARP_OUTSIDE"


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
