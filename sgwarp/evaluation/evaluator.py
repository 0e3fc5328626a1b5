"""Scenes of a data set, one after the other. A scene is done once its record is there; a killed run goes on after it.

OUT/scenes/{scene}/result.json   written last, whole or not at all
OUT/scenes/{scene}/*.png         sheets
OUT/results.json, .md, .tex      over all scenes
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sgwarp.datasets.base import SceneData
from sgwarp.datasets.catalogue import Reader, find_reader
from sgwarp.errors import InputError
from sgwarp.evaluation.cases import in_scene
from sgwarp.evaluation.profiles.base import Profile
from sgwarp.evaluation.results import FILE, SceneResult, read_result, write_result
from sgwarp.evaluation.settings import Settings
from sgwarp.files.inputs import require_no_inputs_in
from sgwarp.runs.log import RunLog
from sgwarp.runs.memory import peak, reset_peak
from sgwarp.runs.progress import Report
from sgwarp.version import __version__


@dataclass
class Evaluation:
    """What an evaluation gave.

    Attributes:
        profile: The protocol.
        settings: The choices.
        results: Of each scene that could be scored, in order.
        failed: Why the others could not, by name.
        figures: Over all scenes.
        absent: Scenes of the published list that the data set does not have.
    """

    profile: Profile
    settings: Settings
    results: list[SceneResult] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)
    figures: dict[str, float] = field(default_factory=dict)
    absent: list[str] = field(default_factory=list)

    @property
    def seconds(self) -> dict[str, float]:
        """By stage, over all scenes."""
        stages: dict[str, float] = {}
        for result in self.results:
            for name, value in result.seconds.items():
                stages[name] = stages.get(name, 0.0) + value
        return stages


def evaluate(
    profile: Profile,
    data: Path,
    out: Path,
    settings: Settings,
    *,
    scenes: Sequence[str] | None = None,
    log: RunLog | None = None,
    progress: Report | None = None,
) -> Evaluation:
    """Score the scenes of a data set by a protocol; those done before under the same choices are taken over.

    Args:
        profile: The protocol.
        data: Root of the data set.
        out: Folder of the results.
        settings: The choices.
        scenes: Names; those of the published list that there are, or all, if None.
        log: Receives what was left out, and the seconds of all stages of all scenes.
        progress: Called before the first scene and after each.

    Raises:
        InputError: The data set has none of the scenes, or none of them could be scored.
    """
    log = log if log is not None else RunLog(device=settings.device)
    report = progress or (lambda done, total, name: None)
    reader = find_reader(profile.reader)
    chosen, absent = choose_scenes(profile, reader, data, scenes)
    found = Evaluation(profile, settings, absent=absent)
    log.leave_out("scenes_not_in_the_data", len(absent))
    report(0, len(chosen), "")
    for done, name in enumerate(chosen, start=1):
        try:
            result, again = evaluate_scene(profile, reader, data, out, name, settings)
        except InputError as error:
            found.failed[name] = str(error)
        else:
            found.results.append(result)
            log.leave_out("scenes_done_before", again)
        report(done, len(chosen), name)
    if not found.results:
        raise InputError(next(iter(found.failed.values())))
    found.figures = profile.total(found.results)
    for name, seconds in found.seconds.items():
        log.stages[name] = log.stages.get(name, 0.0) + seconds
    return found


def evaluate_scene(
    profile: Profile, reader: Reader, data: Path, out: Path, name: str, settings: Settings
) -> tuple[SceneResult, bool]:
    """Score one scene, unless it is done; returns the record, and whether it was there before.

    Raises:
        InputError: It cannot be read, lifted or asked.
    """
    scene = reader.open_scene(data, name)
    folder = out / "scenes" / name.replace("/", "__")
    identity = _identity(profile, scene, settings)
    _keep_data(folder, scene)
    before = read_result(folder / FILE, identity)
    if before is not None:
        return before, True
    log, result = RunLog(device=settings.device), SceneResult(name)
    reset_peak()
    case = profile.make(scene, settings, profile.split, log)
    require_no_inputs_in(folder)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True, exist_ok=True)
    try:
        profile.score(case, result, folder)
    except InputError:
        _remove(folder, out)
        raise
    result.seconds = {stage: round(value, 4) for stage, value in log.stages.items()}
    result.peak_memory, result.gaussians = peak(), len(case.gaussians)
    result.bytes_per_gaussian = case.bytes_per_gaussian
    result.views = {"lifted": 0 if settings.semantics else len(case.lifted), "scored": len(case.scored)}
    result.left_out = dict(log.left_out)
    result.sheets = [f"scenes/{folder.name}/{sheet}" for sheet in result.sheets]
    write_result(folder / FILE, result, identity)
    return result, False


def _keep_data(folder: Path, scene: SceneData) -> None:
    """Refuse to put a record where the data lies: what is there before a record is written is removed.

    Raises:
        InputError: The scene's views or Gaussians lie in the folder of its record.
    """
    record = folder.resolve()
    for path in (scene.folder, scene.gaussians):
        if path is not None and path.resolve().is_relative_to(record):
            raise InputError(f"{path}: lies in {folder}, where the record of this scene goes; choose another --out")


def _remove(folder: Path, out: Path) -> None:
    """Remove what a scene that failed has left, and the folders above it up to `out` if nothing else is in them."""
    shutil.rmtree(folder, ignore_errors=True)
    with suppress(OSError):
        for place in (folder.parent, out):
            place.rmdir()


def choose_scenes(
    profile: Profile, reader: Reader, data: Path, wanted: Sequence[str] | None
) -> tuple[list[str], list[str]]:
    """Scenes to score, and those of the published list that are not there.

    Raises:
        InputError: There is nothing to score, or a scene that was asked for is not there.
    """
    there = reader.list_scenes(data)
    if not there:
        raise InputError(f"{data}: holds no scene of data set '{reader.NAME}'; expected {reader.ABOUT}")
    if wanted:
        unknown = [name for name in wanted if name not in there]
        if unknown:
            raise InputError(f"{data}: has no scene '{unknown[0]}'; there are: {', '.join(there[:8])}")
        twice = next((name for name in wanted if list(wanted).count(name) > 1), None)
        if twice is not None:  # it would count twice in every mean
            raise InputError(f"--scenes: '{twice}' stands there twice; leave one")
        return list(wanted), []
    listed = [name for name in profile.scenes if name in there]
    if profile.scenes and not listed:
        raise InputError(
            f"{data}: has none of the {len(profile.scenes)} scenes of profile '{profile.name}' "
            f"({profile.scenes[0]}, ..); name others with --scenes"
        )
    return (listed, [name for name in profile.scenes if name not in there]) if profile.scenes else (there, [])


def _identity(profile: Profile, scene: SceneData, settings: Settings) -> dict[str, Any]:
    """What the record of a scene depends on."""
    files = {}
    for name in ("gaussians", "semantics", "predicted"):
        pattern = getattr(settings, name)
        path = in_scene(pattern, scene) if pattern else scene.gaussians if name == "gaussians" else None
        if path is not None and path.exists():
            status = path.stat()
            files[name] = [str(path), status.st_size, status.st_mtime_ns]
    return {"profile": profile.name, "version": __version__, "settings": settings.identity, "files": files} | {
        "classes": list(scene.classes)
    }
