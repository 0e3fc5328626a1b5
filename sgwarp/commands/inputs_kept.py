"""What a command reads is never written over: a folder of results may be, by a slip, that of the photographs."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sgwarp.errors import InputError

if TYPE_CHECKING:
    from sgwarp.scene import View


def keep_file(option: str, written: Path, read: Path | None) -> None:
    """Refuse to write a file over one that is read, by whatever name it is reached.

    Raises:
        InputError: They are the same.
    """
    if read is not None and _identity(written) in {_identity(read)} - {None}:
        raise InputError(f"{option} {written}: is read by this command; choose another name")


def keep_photographs(option: str, pictures: Iterable[Path], views: Sequence[View]) -> None:
    """Refuse pictures that would take the place of the views' photographs, masks or depth.

    Raises:
        InputError: A picture is one of these files.
    """
    files = (path for view in views for path in (view.image_path, view.mask_path, view.depth_path))
    read = {_identity(path) for path in files if path is not None} - {None}
    for picture in pictures:
        if _identity(picture) in read:
            raise InputError(f"{option}: {picture} belongs to the photographs of --views; choose another place")


def keep_maps(option: str, folder: Path, source: str | None) -> None:
    """Refuse a folder of results that holds the maps or masks of a source such as files:DIR.

    Raises:
        InputError: It is such a folder.
    """
    place = Path((source or "").partition("?")[0].partition(":")[2] or os.devnull)
    if place.is_dir() and _identity(folder) == _identity(place):
        raise InputError(f"{option} {folder}: holds the images of {source}; choose another folder")


def _identity(path: Path) -> tuple[int, int] | None:
    """The file itself, whatever it is called; None if there is none."""
    try:
        found = os.stat(path)
    except OSError:
        return None
    return found.st_dev, found.st_ino
