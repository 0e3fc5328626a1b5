"""Names of views: label images and feature files are matched to photographs by them."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from pathlib import PurePath, PurePosixPath

from sgwarp.errors import InputError

IMAGE_ENDINGS = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
IMAGE_SUFFIXES = (*IMAGE_ENDINGS, *(ending.upper() for ending in IMAGE_ENDINGS))


def is_image_name(path: PurePath) -> bool:
    """Whether a file is named like an image that can be read."""
    return path.suffix.lower() in IMAGE_ENDINGS


def unique_stems(source: str | os.PathLike[str], names: Sequence[str]) -> list[str]:
    """One stem per listed photograph: its file name without extension.

    Where two photographs share it in different folders (a/0.png and b/0.png), all of them are named by their whole
    relative path instead, joined by underscores (a_0, b_0). Where they differ in the extension alone (0.png and 0.jpg),
    these two keep it.

    Args:
        source: The file that lists them, for the message.
        names: Relative paths, with or without extension.

    Raises:
        InputError: Two photographs have the same name even so.
    """
    whole = [PurePosixPath(name.replace("\\", "/")) for name in names]
    paths = [_without_extension(name) for name in names]
    ways = (
        [path.name for path in paths],
        _joined(paths),
        _with_endings([path.name for path in paths], [path.name for path in whole]),
        _with_endings(_joined(paths), _joined(whole)),
    )
    stems = next((way for way in ways if len(set(way)) == len(way)), ways[-1])
    first: dict[str, int] = {}
    for index, stem in enumerate(stems):
        if stem in first:
            raise InputError(
                f"{source}: {names[first[stem]]!r} and {names[index]!r} are both view {stem!r}; rename or drop one"
            )
        first[stem] = index
    return stems


def _joined(paths: Sequence[PurePosixPath]) -> list[str]:
    return ["_".join(part for part in path.parts if part not in ("..", "/")) for path in paths]


def _with_endings(stems: Sequence[str], names: Sequence[str]) -> list[str]:
    """The stems, but the names where others have the same stem."""
    counts = Counter(stems)
    return [name if counts[stem] > 1 else stem for stem, name in zip(stems, names, strict=True)]


def _without_extension(name: str) -> PurePosixPath:
    path = PurePosixPath(name.replace("\\", "/"))
    return path.with_suffix("") if is_image_name(path) else path
