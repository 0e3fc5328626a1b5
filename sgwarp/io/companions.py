"""Files that belong to photographs: masks, label images, depth, feature maps, one per view.

They are found by the photograph's name, however a tool spells it:

| photograph `cam0/IMG_1.JPG`, view `cam0_IMG_1` | |
|---|---|
| `cam0_IMG_1.png`, `IMG_1.png` | the view's stem |
| `cam0/IMG_1.png` | the photographs' folders mirrored |
| `cam0/IMG_1.JPG.png` | COLMAP's double ending |
| `cam0/img_1.PNG` | another letter case, if only one file fits |

A shorter path counts only where no second photograph ends in it.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path, PurePosixPath

from sgwarp.errors import InputError
from sgwarp.io.stems import is_image_name
from sgwarp.scene import View

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
MOST_FILES = 1_000_000  # of a folder; more than that is the wrong folder


class Companions:
    """The files of one folder, by view.

    Args:
        folder: Where they are, or the folders that mirror the photographs'.
        views: All views that will be asked for; they decide which short names are unique.

    Raises:
        InputError: The folder does not exist.
    """

    def __init__(self, folder: str | os.PathLike[str], views: Sequence[View]) -> None:
        self.folder = Path(folder)
        if not self.folder.is_dir():
            raise InputError(f"{self.folder}: no such folder; give the one that holds a file per view")
        self._files = dict(_files(self.folder))
        self._folded: dict[str, list[Path]] = {}
        for name, path in self._files.items():
            self._folded.setdefault(name.lower(), []).append(path)
        self._tails = Counter(tail.lower() for view in views for tail in set(_tails(view)))

    @property
    def paths(self) -> list[Path]:
        """All files of the folder."""
        return list(self._files.values())

    def find(self, view: View, endings: Sequence[str], beginnings: Sequence[str] = ("",)) -> list[Path]:
        """The files of a view, at most one for each beginning and ending of names, in their order."""
        found = []
        for beginning, ending in product(beginnings, endings):
            names = (_begun(name, beginning) for name in self._names(view, ending))
            path = next((path for name in names if (path := self._lookup(name))), None)
            if path is not None and path not in found:
                found.append(path)
        return found

    def _names(self, view: View, ending: str) -> Iterator[str]:
        """Relative names that the file may have, the surest first."""
        yield view.stem + ending
        for index, tail in enumerate(_tails(view)):
            if index == 0 or self._tails[tail.lower()] == 1:
                yield tail + ending
                yield _without_suffix(tail) + ending

    def _lookup(self, name: str) -> Path | None:
        if name in self._files:
            return self._files[name]
        same = self._folded.get(name.lower(), [])
        return same[0] if len(same) == 1 else None


def _files(folder: Path) -> Iterator[tuple[str, Path]]:
    """Relative names with slashes, and paths, of all files below a folder."""
    count = 0
    for root, folders, names in os.walk(folder):
        folders.sort()
        count += len(names)
        if count > MOST_FILES:
            raise InputError(f"{folder}: holds more than {MOST_FILES:,} files; give the folder of one kind of file")
        for name in names:
            path = Path(root) / name
            yield path.relative_to(folder).as_posix(), path


def _tails(view: View) -> Iterator[str]:
    """The photograph's path as its data set lists it, then without its first folder, and so on."""
    path = PurePosixPath((view.name or view.stem).replace("\\", "/"))
    parts = [part for part in path.parts if part not in ("..", ".", "/")]
    for start in range(len(parts)):
        yield "/".join(parts[start:])


def _begun(name: str, beginning: str) -> str:
    """The name with something before its last part."""
    folder, slash, last = name.rpartition("/")
    return f"{folder}{slash}{beginning}{last}"


def _without_suffix(name: str) -> str:
    path = PurePosixPath(name)
    return str(path.with_suffix("")) if is_image_name(path) else name
