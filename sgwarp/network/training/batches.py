"""Lifted scenes in the results of `sgwarp batch`, from the records that it left."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sgwarp.errors import InputError
from sgwarp.files.documents import read_json

DONE, FAILED = "done.json", "failed.json"


@dataclass(frozen=True)
class Lifted:
    """Files of a lifted scene.

    Attributes:
        scene: Its Gaussians.
        semantics: What was lifted for them.
        views: Folder of its photographs.
    """

    scene: Path
    semantics: Path
    views: Path


def is_batch(folder: Path) -> bool:
    """Whether a folder holds results of a batch, or those of one scene."""
    return folder.is_dir() and any(_scenes(folder))


def batch_results(folder: Path) -> list[Lifted]:
    """The lifted scenes of a batch that are done; a notice says how many are not.

    Args:
        folder: Of all results, or of those of one scene.

    Raises:
        InputError: A record cannot be read, or is of a scene that was not lifted.
    """
    scenes = sorted(_scenes(folder))
    found = [_lifted(scene) for scene in scenes if (scene / DONE).is_file()]
    if len(found) < len(scenes):
        left = len(scenes) - len(found)
        logging.getLogger("sgwarp").warning("%s: %d of %d scenes are not done, and left out", folder, left, len(scenes))
    return found


def _scenes(folder: Path) -> Iterator[Path]:
    for place in (folder, *(path for path in folder.iterdir() if path.name[0] != ".")):
        if (place / DONE).is_file() or (place / FAILED).is_file():
            yield place


def _lifted(folder: Path) -> Lifted:
    record: Any = read_json(folder / DONE)
    try:
        words = list(map(str, record["options"]["lift"]))
        views = Path(words[words.index("--views") + 1])
    except (KeyError, TypeError, ValueError, IndexError):
        raise InputError(f"{folder / DONE}: the batch did not lift this scene; add lift to its --do") from None
    fitted = folder / "scene.ply"
    return Lifted(fitted if fitted.is_file() else Path(words[0]), folder / "scene.safetensors", views)
