"""Whether a photograph fits the camera its data set names, and what is left out where one does not."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from pathlib import Path

from sgwarp.errors import InputError
from sgwarp.files.exif import NAMES, UPRIGHT, is_panorama, read_orientation
from sgwarp.files.images import read_size
from sgwarp.io.lens_models import PANORAMA_REMEDY
from sgwarp.io.undistort import Lens

LARGE = 200  # pixels, of which one more or less does not matter


class LeftOut:
    """Photographs that cannot be used, and why: said once per reason, and an error only if none is left."""

    def __init__(self, source: Path, unit: str) -> None:
        self.source = source
        self.unit = unit
        self._names: dict[str, list[str]] = {}

    def add(self, reason: str, name: str) -> None:
        self._names.setdefault(reason, []).append(name)

    def fail(self, error: InputError, name: str) -> None:
        """A photograph whose error is its own."""
        self.add(f"({error})", name)

    def count(self, reason: str) -> int:
        return len(self._names.get(reason, []))

    def first(self, reason: str) -> str | None:
        return next(iter(self._names.get(reason, [])), None)

    def say(self) -> None:
        """Log one notice for each reason; of errors that are photographs' own, the first stands for all."""
        log, own = logging.getLogger("sgwarp"), [reason for reason in self._names if reason.startswith("(")]
        for reason, names in self._names.items():
            if reason not in own:
                log.warning("%s: left out %d %s %s, first %r", self.source, len(names), self.unit, reason, names[0])
        if own:
            count = sum(len(self._names[reason]) for reason in own)
            log.warning(
                "%s: left out %d %s that cannot be used, first: %s", self.source, count, self.unit, own[0][1:-1]
            )

    @property
    def first_error(self) -> str | None:
        """The first error that was a photograph's own."""
        return next((reason[1:-1] for reason in self._names if reason.startswith("(")), None)


def fit_photograph(lens: Lens, path: Path) -> tuple[Lens, int]:
    """The lens at the size of a photograph, and the EXIF orientation that it has to be turned by.

    A photograph that fits as it is stored is taken as it is stored, as structure from motion does. One that fits only
    when it is turned as its EXIF data say is turned. One of another size but the same shape scales the lens.

    Raises:
        InputError: It does not have the shape of its camera, or cannot be read.
    """
    height, width = read_size(path)
    refuse_panorama(path, height, width)
    orientation = read_orientation(path)
    ways = [(width, height, UPRIGHT)]
    if orientation >= 5:
        ways.append((height, width, orientation))
    for w, h, way in ways:
        if (w, h) == (lens.width, lens.height):
            return lens, way
    for w, h, way in ways:
        # Tools round the smaller size up or down; encoders of videos leave out an odd row or column.
        rounded = max(abs(lens.height * w / lens.width - h), abs(lens.width * h / lens.height - w)) < 1
        odd = max(abs(lens.width - w), abs(lens.height - h)) <= 1 and min(w, h) >= LARGE
        if rounded or odd:
            return lens.resized(w, h), way
    noted = ""
    if orientation != UPRIGHT:
        noted = f" (EXIF orientation {orientation}: {NAMES[orientation]})"
    raise InputError(
        f"{path}: image is {width} x {height}{noted}, its camera says {lens.width} x {lens.height}, which is another "
        "shape; use the photographs that the cameras were found with, or resize one of them"
    )


def refuse_panorama(path: Path, height: int, width: int) -> None:
    """Raise InputError for a photograph that shows all around, whatever lens its camera is said to have."""
    if width == 2 * height and is_panorama(path):
        raise InputError(f"{path}: is a panorama (equirectangular); {PANORAMA_REMEDY}")


def say_orientations(source: Path, used: Iterable[tuple[Path, int]]) -> None:
    """Log how many photographs were turned, and how many note an orientation that was not applied."""
    turned, kept = [], []
    for path, way in used:
        noted = read_orientation(path)
        if way != UPRIGHT:
            turned.append(path)
        elif noted != UPRIGHT:
            kept.append((path, noted))
    log = logging.getLogger("sgwarp")
    if turned:
        log.warning("%s: turned %d photographs upright (EXIF orientation), as their cameras ask", source, len(turned))
    if kept:
        path, noted = kept[0]
        log.warning(
            "%s: %d photographs note an EXIF orientation (first %s: %d, %s); they fit their cameras as stored, and are "
            "taken so",
            source,
            len(kept),
            path.name,
            noted,
            NAMES[noted],
        )
