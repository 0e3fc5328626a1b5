"""The files of photographs that a data set lists: under their names, or nearly so."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from typing import Any

from sgwarp.io.stems import IMAGE_SUFFIXES, is_image_name


class PhotographFiles:
    """Finds files by the names that a data set lists them under.

    Tools and people rename photographs after their poses were found: IMG_1.JPG becomes img_1.jpg on another system, or
    IMG_1.png when its background is cut out. A name that does not exist stands for the one file of its folder that
    differs in letter case or ending alone, and is not listed itself.

    Args:
        source: What lists them, for the notice.
        names: All names that it lists.
    """

    def __init__(self, source: Path, names: Iterable[Any]) -> None:
        self.source = source
        self._listed = {PurePosixPath(name.replace("\\", "/")).name for name in names if isinstance(name, str)}
        self._folders: dict[Path, list[Path]] = {}
        self._renamed: list[tuple[Path, Path]] = []

    def find(self, listed: Path) -> Path | None:
        """The file, or None if there is none or several may be meant."""
        if os.path.isfile(listed):
            return listed
        for suffix in IMAGE_SUFFIXES:  # Blender and instant-ngp leave the ending out
            if os.path.isfile(whole := listed.with_name(listed.name + suffix)):
                return whole
        files = self._files(listed.parent)
        for same in (
            [file for file in files if file.name.lower() == listed.name.lower()],
            [file for file in files if file.stem == _stem(listed)],
            [file for file in files if file.stem.lower() == _stem(listed).lower()],
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

    def _files(self, folder: Path) -> list[Path]:
        if folder not in self._folders:
            try:
                own = (path for path in folder.iterdir() if is_image_name(path))
                self._folders[folder] = [path for path in own if path.name not in self._listed]
            except (OSError, ValueError):  # ValueError: the name holds a null byte or half a character
                self._folders[folder] = []
        return self._folders[folder]


def _stem(path: Path) -> str:
    return path.stem if is_image_name(path) else path.name
