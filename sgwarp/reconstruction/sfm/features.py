"""Features of photographs and their matches, in a COLMAP database."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any, Literal

from sgwarp.errors import InputError
from sgwarp.files.images import read_size
from sgwarp.reconstruction.sfm.library import require_pycolmap, require_room, run_cancellable
from sgwarp.runs.progress import Report

Matching = Literal["auto", "exhaustive", "sequential"]
MOST_EXHAUSTIVE = 150  # photographs of which every one is compared with every other
OVERLAP = 12  # photographs after each that it is compared with in a sequence, and at doubling distances
PHOTOGRAPHS_AT_ONCE, PAIRS_AT_ONCE = 8, 64  # between two reports of the progress
LARGEST = 1600  # photographs are made this small for features [pixels]
# At most 8192 features a photograph, of 24 bytes and 128 of their descriptor; of a pair as many matches, 8 bytes each,
# stored twice: as found, and as checked.
PHOTOGRAPH_BYTES, PAIR_BYTES = 8192 * 152, 2 * 8192 * 8
SMALL, FAINT = 1000, 0.0015  # photographs whose sides are shorter have few features: fainter ones count, too [pixels]


@dataclass(frozen=True)
class SfmSettings:
    """How poses are found.

    Attributes:
        matching: "exhaustive" compares all photographs with each other, "sequential" each with those that follow (a
            video, or photographs in the order they were taken); "auto" is exhaustive up to 150 photographs.
        one_camera: All photographs of one size were taken with one camera and zoom.
        camera_model: Of COLMAP.
        seed: Of everything random.
        threads: Host threads.
    """

    matching: Matching = "auto"
    one_camera: bool = True
    camera_model: str = "SIMPLE_RADIAL"
    seed: int = 0
    threads: int = -1


def extract_features(database: Path, folder: Path, names: Sequence[str], settings: SfmSettings, report: Report) -> None:
    """Store the features of photographs; those that are stored already are skipped.

    Raises:
        InputError: pycolmap is not installed, or a photograph is not an image.
    """
    groups: dict[tuple[int, int], list[str]] = defaultdict(list)
    for name in names:
        groups[read_size(folder / name)].append(name)
    done = 0
    for group in groups.values():  # COLMAP takes one camera for photographs of one size only
        for start in range(0, len(group), PHOTOGRAPHS_AT_ONCE):
            chunk = group[start : start + PHOTOGRAPHS_AT_ONCE]
            report(done, len(names), "finding features")
            camera = _camera_of(database, set(group)) if settings.one_camera else None
            store_features(database, folder, chunk, settings, camera)
            done += len(chunk)
    report(done, len(names), "finding features")


def store_features(
    database: Path, folder: Path, names: Sequence[str], settings: SfmSettings, camera: int | None
) -> None:
    """Store the features of some photographs of one size, taken with a camera of the database or with new ones."""
    pycolmap = require_pycolmap()
    require_room(database, len(names) * PHOTOGRAPH_BYTES)
    options, reader = pycolmap.FeatureExtractionOptions(), pycolmap.ImageReaderOptions()
    options.max_image_size, options.num_threads, options.use_gpu = LARGEST, settings.threads, False
    if max(read_size(folder / names[0])) < SMALL:
        options.sift.peak_threshold = FAINT
    reader.camera_model = settings.camera_model
    if camera is not None:
        reader.existing_camera_id = camera
    mode = pycolmap.CameraMode.SINGLE if settings.one_camera else pycolmap.CameraMode.PER_IMAGE

    def extract(token: Any) -> None:
        pycolmap.extract_features(
            database,
            folder,
            image_names=list(names),
            camera_mode=mode,
            reader_options=reader,
            extraction_options=options,
            device=pycolmap.Device.cpu,
            cancellation_token=token,
        )

    run_cancellable(database, extract)


def _camera_of(database: Path, names: set[str]) -> int | None:
    """The camera of those of these photographs that are stored already, or None."""
    if not database.is_file():
        return None
    with require_pycolmap().Database.open(database) as data:
        return next((image.camera_id for image in data.read_all_images() if image.name in names), None)


def match_features(database: Path, pairs: Sequence[tuple[str, str]], settings: SfmSettings, report: Report) -> None:
    """Store which features of two photographs are the same, checked by their geometry; known pairs are skipped."""
    pycolmap = require_pycolmap()
    if any(len(name.split()) != 1 for pair in pairs for name in pair):  # the library's lists are separated by spaces
        _match_all(database, pairs, settings, report)
        return
    options, pairing = pycolmap.FeatureMatchingOptions(), pycolmap.ImportedPairingOptions()
    options.num_threads, options.use_gpu = settings.threads, False
    listed = database.with_name("pairs.txt")
    pairing.match_list_path = listed

    def match(token: Any) -> None:
        pycolmap.match_image_pairs(
            database,
            matching_options=options,
            pairing_options=pairing,
            device=pycolmap.Device.cpu,
            cancellation_token=token,
        )

    try:
        for start in range(0, len(pairs), PAIRS_AT_ONCE):
            report(start, len(pairs), "matching photographs")
            chunk = pairs[start : start + PAIRS_AT_ONCE]
            require_room(database, len(chunk) * PAIR_BYTES)
            listed.write_text("".join(f"{a} {b}\n" for a, b in chunk), encoding="utf-8")
            run_cancellable(database, match)
    finally:
        listed.unlink(missing_ok=True)
    report(len(pairs), len(pairs), "matching photographs")


def _match_all(database: Path, pairs: Sequence[tuple[str, str]], settings: SfmSettings, report: Report) -> None:
    """The same in one call, which chooses the pairs alike and tells nothing of its progress."""
    pycolmap = require_pycolmap()
    options, sequence = pycolmap.FeatureMatchingOptions(), pycolmap.SequentialPairingOptions()
    options.num_threads, options.use_gpu = settings.threads, False
    sequence.overlap, sequence.quadratic_overlap = OVERLAP, True
    count = len({name for pair in pairs for name in pair})
    require_room(database, len(pairs) * PAIR_BYTES)
    common = {"matching_options": options, "device": pycolmap.Device.cpu}

    def match(token: Any) -> None:
        if len(pairs) == count * (count - 1) // 2:
            pycolmap.match_exhaustive(database, cancellation_token=token, **common)
        else:
            pycolmap.match_sequential(database, pairing_options=sequence, cancellation_token=token, **common)

    run_cancellable(database, match, lambda: report(0, len(pairs), "matching photographs"))


def choose_pairs(names: Sequence[str], matching: Matching) -> list[tuple[str, str]]:
    """Which photographs are compared: all with each other, or each with those after it, ever more sparsely."""
    count = len(names)
    if matching == "exhaustive" or (matching == "auto" and count <= MOST_EXHAUSTIVE):
        return list(combinations(names, 2))
    steps = sorted({*range(1, OVERLAP + 1), *(2**k for k in range(count.bit_length()))})
    return [(names[i], names[i + step]) for i in range(count) for step in steps if i + step < count]


def require_photographs(folder: Path, names: Sequence[str], least: int) -> None:
    """Raise InputError unless there are enough photographs."""
    if len(names) < least:
        raise InputError(
            f"{folder}: holds {len(names)} photographs; structure from motion needs at least {least} that overlap"
        )
