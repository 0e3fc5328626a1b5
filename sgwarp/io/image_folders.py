"""Where the photographs of a COLMAP model are: in `images`, or in the one folder that holds them."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from pathlib import Path

from sgwarp.errors import InputError

USUAL = "images"
ABOVE = 3  # folders above the model that are looked into
TRIED = 8  # photographs that a folder must hold one of
OPTION = "--images"


def find_image_folder(model: Path, names: Sequence[str], wanted: str | None = None) -> Path:
    """The folder that the names of a model's photographs are relative to.

    Args:
        model: Folder of the model; photographs are looked for in it and up to three folders above.
        names: Of the photographs.
        wanted: Name or path of the folder. If None, `images`, or else the only folder that holds the photographs.

    Raises:
        InputError: There is none, or several and none is named `images`.
    """
    above = (model, *list(model.resolve().parents)[:ABOVE])
    if found := next((place / (wanted or USUAL) for place in above if (place / (wanted or USUAL)).is_dir()), None):
        return found
    if wanted is not None:
        raise InputError(f"{model}: no folder '{wanted}' of photographs beside the model or up to {above[-1]}")
    for place in above:
        held = [folder for folder in (place, *_subfolders(place)) if _holds(folder, names)]
        if len(held) == 1:
            logging.getLogger("sgwarp").warning("%s: takes the photographs in %s", model, held[0])
            return held[0]
        if held:
            listed = ", ".join(sorted(folder.name for folder in held))
            raise InputError(f"{model}: photographs are in several folders ({listed}); choose one with {OPTION} NAME")
    raise InputError(
        f"{model}: no folder '{USUAL}' of photographs beside the model or up to {above[-1]}, nor another that holds "
        f"them; name it with {OPTION}"
    )


def _subfolders(place: Path) -> list[Path]:
    try:
        return sorted(entry for entry in place.iterdir() if entry.is_dir())
    except OSError:
        return []


def _holds(folder: Path, names: Sequence[str]) -> bool:
    return any(os.path.isfile(folder / name) for name in names[:TRIED])
