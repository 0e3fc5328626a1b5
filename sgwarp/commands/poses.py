"""`sgwarp poses`: poses and points of photographs, by structure from motion."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from sgwarp.commands.inputs_kept import LOG
from sgwarp.commands.options import Options, check_folder
from sgwarp.errors import InputError
from sgwarp.runs.progress import show_progress

if TYPE_CHECKING:
    from sgwarp.reconstruction.sfm.poses import Registration
    from sgwarp.runs.log import RunLog

logger = logging.getLogger("sgwarp")
NAMED = 8  # photographs without a pose that are named


@dataclass(kw_only=True)
class Poses(Options):
    """Find the poses of photographs, or of the frames of a video, through COLMAP.

    Writes a COLMAP model to sparse/0, and images beside it, so that the folder can be given as --views.
    """

    photographs: tyro.conf.Positional[Path]
    """Folder of photographs, also in subfolders; or a video."""

    out: Path
    """Folder to write."""

    matching: Literal["auto", "exhaustive", "sequential"] = "auto"
    """Which photographs are compared: all with each other, or each with those that follow; auto: all, up to 150
    photographs; sequential for videos."""

    one_camera: bool = True
    """All photographs of one size were taken with one camera and zoom."""

    every: int | None = None
    """Keep the sharpest of every so many frames of a video; if not given, about 150 frames are kept."""

    seed: int = 0
    """Seed of everything random."""

    def written(self) -> Iterator[tuple[str, list[Path]]]:
        yield "--out", [self.out / name for name in ("sfm.json", "database.db", LOG)]

    def run(self) -> None:
        check_folder("--out", self.out)
        if not self.photographs.exists():
            raise InputError(f"{self.photographs}: no such file or folder; check the path")
        with self.logged(self.out) as log:
            find_poses(self.photographs, self.out, log, self.matching, self.one_camera, self.every, self.seed)
            log.outputs.append(str(self.out / "sparse" / "0"))


def find_poses(
    source: Path,
    out: Path,
    log: RunLog,
    matching: str = "auto",
    one_camera: bool = True,
    every: int | None = None,
    seed: int = 0,
) -> Registration:
    """Run structure from motion on a folder or a video, and say what it could place.

    Raises:
        InputError: pycolmap is not installed, or the photographs cannot be placed.
    """
    from sgwarp.reconstruction.sfm.features import SfmSettings
    from sgwarp.reconstruction.sfm.library import require_pycolmap
    from sgwarp.reconstruction.sfm.poses import estimate_poses
    from sgwarp.reconstruction.sfm.video import extract_frames, is_video

    require_pycolmap()
    with log.stage("poses"), show_progress("poses") as progress:
        folder = source
        if is_video(source):
            folder = out / "images"
            extract_frames(source, folder, every, progress)
            matching = "sequential" if matching == "auto" else matching
        settings = SfmSettings(matching=matching, one_camera=one_camera, seed=seed, threads=log.threads)  # type: ignore[arg-type]
        found = estimate_poses(folder, out, settings, progress)
    logger.info("%s: %s", source, found.summary())
    for name, reason in list(found.left_out.items())[:NAMED]:
        logger.warning("%s: has no pose: %s", name, reason)
    if len(found.left_out) > NAMED:
        logger.warning("and %d more have none; %s lists them", len(found.left_out) - NAMED, out / "sfm.json")
    log.leave_out("photographs_without_pose", len(found.left_out))
    log.error["reprojection_error"] = found.error
    return found
