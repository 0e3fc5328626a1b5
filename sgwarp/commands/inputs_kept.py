"""What a command reads is never written over: a folder of results may be, by a slip, that of the photographs.

`guarded` runs around every command. It knows the inputs that options name and the outputs that the command's `written`
names; what else is read and written is compared by `sgwarp.files.inputs` as it comes.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sgwarp.errors import InputError
from sgwarp.files.inputs import announce_outputs, identity, inputs_kept, note_input

if TYPE_CHECKING:
    from sgwarp.scene import View

WRITTEN = ("out", "ply", "render_out", "cache")  # options that say where outputs go; all other paths are read
LOG = "run.json"


@contextmanager
def guarded(command: Any) -> Iterator[None]:
    """Refuse, while the command runs, to write over a file that it reads.

    Raises:
        InputError: An output is a file that an option names as an input.
    """
    with inputs_kept():
        for path in _inputs(command):
            note_input(path)
        try:
            outputs = list(command.written()) if hasattr(command, "written") else []
        except ValueError:  # of an output without a name, such as "."; the command says what is wrong with it
            outputs = []
        for option, paths in outputs:
            announce_outputs(option, paths)
        yield


def keep_photographs(option: str, pictures: Iterable[Path], views: Sequence[View]) -> None:
    """Refuse pictures that would take the place of the views' photographs, masks or depth, or of other inputs.

    Raises:
        InputError: A picture is one of these files.
    """
    from sgwarp.io.views import note_files

    note_files(views)
    announce_outputs(option, pictures)


def keep_maps(option: str, folder: Path, source: str | None) -> None:
    """Refuse a folder of results that holds the maps or masks of a source such as files:DIR.

    Raises:
        InputError: It is such a folder.
    """
    place = Path((source or "").partition("?")[0].partition(":")[2] or os.devnull)
    if place.is_dir() and identity(folder) == identity(place):
        raise InputError(f"{option} {folder}: holds the images of {source}; choose another folder")


def _inputs(command: Any) -> Iterator[Path]:
    """Files that options name and that are not written."""
    for option in fields(command):
        if option.name not in WRITTEN:
            value = getattr(command, option.name)
            yield from (
                path
                for path in (value if isinstance(value, (list, tuple)) else (value,))
                if isinstance(path, Path) and path.is_file()
            )
