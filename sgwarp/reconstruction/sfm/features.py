"""Features of photographs and their matches, in a COLMAP database."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from sgwarp.errors import InputError
from sgwarp.files.images import read_size
from sgwarp.reconstruction.sfm.library import count_rows, require_pycolmap, run_cancellable
from sgwarp.runs.progress import Report

Matching = Literal["auto", "exhaustive", "sequential"]
MOST_EXHAUSTIVE = 150  # photographs of which every one is compared with every other
OVERLAP = 12  # photographs after each that it is compared with in a sequence, and at doubling distances
LARGEST = 1600  # photographs are made this small for features [pixels]


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
        InputError: pycolmap is not installed.
    """
    pycolmap = require_pycolmap()
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size, options.num_threads, options.use_gpu = LARGEST, settings.threads, False
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = settings.camera_model
    groups: dict[tuple[int, int], list[str]] = defaultdict(list)
    for name in names:
        groups[read_size(folder / name)].append(name)

    def watch() -> None:
        report(count_rows(database, "keypoints"), len(names), "finding features")

    mode = pycolmap.CameraMode.SINGLE if settings.one_camera else pycolmap.CameraMode.PER_IMAGE
    for group in groups.values():  # COLMAP takes one camera for photographs of one size only

        def extract(token: Any, group: list[str] = group) -> None:
            pycolmap.extract_features(
                database,
                folder,
                image_names=group,
                camera_mode=mode,
                reader_options=reader,
                extraction_options=options,
                device=pycolmap.Device.cpu,
                cancellation_token=token,
            )

        run_cancellable(extract, watch)


def match_features(database: Path, count: int, settings: SfmSettings, report: Report) -> None:
    """Store which features of two photographs are the same, checked by their geometry; known pairs are skipped."""
    pycolmap = require_pycolmap()
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads, options.use_gpu = settings.threads, False
    chosen = settings.matching
    if chosen == "auto":
        chosen = "exhaustive" if count <= MOST_EXHAUSTIVE else "sequential"
    pairs = count * (count - 1) // 2

    def watch() -> None:
        report(min(count_rows(database, "two_view_geometries"), pairs), pairs, "matching photographs")

    def match(token: Any) -> None:
        common = {"matching_options": options, "device": pycolmap.Device.cpu, "cancellation_token": token}
        if chosen == "exhaustive":
            pycolmap.match_exhaustive(database, **common)
            return
        pairing = pycolmap.SequentialPairingOptions()
        pairing.overlap, pairing.quadratic_overlap = OVERLAP, True
        pycolmap.match_sequential(database, pairing_options=pairing, **common)

    run_cancellable(match, watch)


def require_photographs(folder: Path, names: Sequence[str], least: int) -> None:
    """Raise InputError unless there are enough photographs."""
    if len(names) < least:
        raise InputError(
            f"{folder}: holds {len(names)} photographs; structure from motion needs at least {least} that overlap"
        )
