"""The files of photographs that a data set lists: under their names, or nearly so."""

from __future__ import annotations

import logging
import os
import unicodedata
from collections import Counter
from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from typing import Any

from sgwarp.errors import InputError
from sgwarp.io.names import inside, spellings, tails
from sgwarp.io.stems import IMAGE_SUFFIXES, is_image_name

USUAL = ("", "images")  # folders of a data set that a name may be relative to


class PhotographFiles:
    """Finds files by the names that a data set lists them under.

    Tools and people rename photographs after their poses were found: IMG_1.JPG becomes img_1.jpg on another system, or
    IMG_1.png when its background is cut out. A name that does not exist stands for the one file of its folder that
    differs in letter case or ending alone, and is not listed itself.

    A data set that was moved may list paths of the machine it was made on. Then the end of a path counts, as much of it
    as exists here, if no second listed name ends so.

    Args:
        source: What lists them, for the notice.
        names: All names that it lists.
    """

    def __init__(self, source: Path, names: Iterable[Any]) -> None:
        self.source = source
        listed = {name for name in names if isinstance(name, str)}
        self._listed = {PurePosixPath(name.replace("\\", "/")).name for name in listed}
        whole = {next(tails(name), ""): name for name in listed}  # ./a.png is a.png
        self._tails = Counter(tail for name in whole.values() for tail in tails(name))
        self._folders: dict[Path, list[Path]] = {}
        self._renamed: list[tuple[Path, Path]] = []
        self._moved: list[tuple[str, Path]] = []

    def locate(self, folder: Path, name: str) -> Path | None:
        """The file that is listed as `name` relative to a folder, or None.

        Raises:
            InputError: The name leads out of the data set, and nothing in it is called like its end.
        """
        refused = None
        for spelling in spellings(name):
            try:
                found = self.find(inside(self.source, folder, spelling))
            except InputError as error:
                refused = refused or error
                continue
            if found is not None:
                return found
        for tail in tails(name):
            for place in USUAL if self._tails[tail] == 1 else ():
                if (found := self.find(folder / place / tail)) is not None:
                    self._moved.append((name, found))
                    return found
        if refused is not None:
            raise refused
        return None

    def find(self, listed: Path) -> Path | None:
        """The file, or None if there is none or several may be meant."""
        if os.path.isfile(listed):
            return listed
        for suffix in IMAGE_SUFFIXES:  # Blender and instant-ngp leave the ending out
            if os.path.isfile(whole := listed.with_name(listed.name + suffix)):
                return whole
        files = self._files(listed.parent)
        for same in (
            [file for file in files if _folded(file.name) == _folded(listed.name)],
            [file for file in files if file.stem == _stem(listed)],
            [file for file in files if _folded(file.stem) == _folded(_stem(listed))],
        ):
            if len(same) == 1:
                self._renamed.append((listed, same[0]))
                return same[0]
        return None

    def say(self) -> None:
        """Log how many were found under another name."""
        if self._renamed:
            listed, found = self._renamed[0]
            logging.getLogger("sgwarp").warning(
                "%s: %d photographs have another ending or letter case than is listed, first %s for %s",
                *(self.source, len(self._renamed), found.name, listed.name),
            )
        if self._moved:
            name, found = self._moved[0]
            logging.getLogger("sgwarp").warning(
                "%s: %d photographs are listed with paths that do not exist here; files whose paths end alike are "
                "taken, first %s for %r",
                *(self.source, len(self._moved), found, name),
            )

    def _files(self, folder: Path) -> list[Path]:
        if folder not in self._folders:
            try:
                own = (path for path in folder.iterdir() if is_image_name(path))
                self._folders[folder] = [path for path in own if path.name not in self._listed]
            except (OSError, ValueError):  # ValueError: the name holds a null byte or half a character
                self._folders[folder] = []
        return self._folders[folder]


def _folded(name: str) -> str:
    """A name as it compares: in one letter case, and with accents in one form, of which systems have two."""
    return unicodedata.normalize("NFC", name).strip().casefold()


def _stem(path: Path) -> str:
    return path.stem if is_image_name(path) else path.name
