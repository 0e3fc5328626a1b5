"""Poses and points of a folder of photographs: COLMAP's incremental mapper, and a report of what it could place."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import re
import shutil
from collections.abc import Mapping, Sequence, Set
from dataclasses import asdict, dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from sgwarp.errors import InputError
from sgwarp.files.access import reading
from sgwarp.files.atomic import atomic_path
from sgwarp.files.documents import read_json
from sgwarp.files.images import read_size
from sgwarp.files.inputs import note_input, own_files
from sgwarp.io.foreign_captures import describe_unread
from sgwarp.io.photographs import refuse_panorama
from sgwarp.io.stems import IMAGE_ENDINGS, is_image_name
from sgwarp.reconstruction.sfm.features import (
    SfmSettings,
    choose_pairs,
    extract_features,
    match_features,
    require_photographs,
)
from sgwarp.reconstruction.sfm.library import require_pycolmap, run_cancellable
from sgwarp.runs.progress import Report

logger = logging.getLogger("sgwarp")
MODEL = Path("sparse") / "0"
MAPPING, WHOLE = "mapping", "whole"  # where COLMAP works, and where the model is written
NOTES = "sfm.json"
NOT_COLMAP = (".webp",)
LEAST_PHOTOGRAPHS = 3
# Folders of what belongs to photographs, without a final s; Polycam's corrected copies show each photograph again.
BESIDE = frozenset(("mask", "depth", "label", "semantic", "normal", "confidence", "segmentation", "corrected_image"))
BEGINNINGS, ENDINGS = ("mask_", "dynamic_mask_", "depth_"), ("_mask", ".mask", "-mask", "_depth")
FEW_FEATURES = 200  # in a photograph: blurred, dark, or of something even
FEW_MATCHES = 30  # with any other photograph
OUTLIER = 0.5  # error of a feature from which on it counts less and less in the last adjustment [pixels]
ADJUSTMENTS = 200  # steps of it at most
LEAST_ANGLE = 4.0  # between the first two photographs where none have COLMAP's 16 [degrees]


@dataclass(frozen=True)
class Registration:
    """What structure from motion could place.

    Attributes:
        registered: Names of the photographs with a pose.
        left_out: Why the others may have none, by name.
        points: How many.
        error: Mean reprojection error [pixels].
    """

    registered: tuple[str, ...]
    left_out: dict[str, str] = field(default_factory=dict)
    points: int = 0
    error: float = float("nan")

    def summary(self) -> str:
        """One line."""
        count = len(self.registered)
        return (
            f"{count} of {count + len(self.left_out)} photographs have poses; {self.points:,} points, mean "
            f"reprojection error {self.error:.2f} pixels"
        )


def photographs_in(folder: Path) -> list[str]:
    """Names of the photographs in a folder and its subfolders, relative to it, in order.

    Folders of what belongs to photographs (masks, depth, labels) are left out, and so are smaller copies of another
    folder (images_4 beside images), masks and depth that lie beside their photograph and are named after it, and hidden
    files.
    """
    with reading(folder):
        files = [path for path in folder.rglob("*") if is_image_name(path) and path.is_file()]
    names = sorted(path.relative_to(folder).as_posix() for path in files)
    names = [name for name in names if not any(part.startswith(".") for part in PurePosixPath(name).parts)]
    places = {PurePosixPath(name).parent for name in names}
    stems = {str(PurePosixPath(name).with_suffix("")).lower() for name in names}
    own = [name for name in names if not _belongs_to_others(PurePosixPath(name).parent, places)]
    return [name for name in own if not _belongs_to_photograph(PurePosixPath(name), stems)] or names


def _belongs_to_photograph(name: PurePosixPath, stems: Set[str]) -> bool:
    """Whether a file is the mask or the depth of a photograph beside it, by its name."""
    stem = name.stem.lower()
    bare = [stem[len(word) :] for word in BEGINNINGS if stem.startswith(word)]
    bare += [stem[: -len(word)] for word in ENDINGS if stem.endswith(word)]
    bare += [stem] * (PurePosixPath(name.stem).suffix.lower() in IMAGE_ENDINGS)  # COLMAP's IMG_1.JPG.png
    bare = [PurePosixPath(other).stem if PurePosixPath(other).suffix in IMAGE_ENDINGS else other for other in bare]
    return any(str(name.with_name(other)).lower() in stems for other in bare if other)


def _belongs_to_others(place: PurePosixPath, places: Set[PurePosixPath]) -> bool:
    """Whether a folder holds no photographs of its own, by its name."""
    copy = re.fullmatch(r"(.+)_[248]", place.name)
    if copy is not None and place.with_name(copy[1]) in places:
        return True
    return any(part.lower().rstrip("s") in BESIDE for part in place.parts)


def estimate_poses(
    folder: Path, out: Path, settings: SfmSettings | None = None, progress: Report | None = None
) -> Registration:
    """Find the poses of photographs, and points; write them as a COLMAP model.

    The model goes to `out`/sparse/0, a link to the photographs to `out`/images, and what was found to `out`/sfm.json.
    A model of the same photographs and settings is kept as it is; an interrupted run goes on where it was. The seed
    fixes what COLMAP draws at random; with several threads its sums may still differ in the last digits.

    Args:
        folder: Photographs, also in subfolders.
        out: Folder to write.
        settings: Matching, camera, seed.
        progress: Called as `progress(done, total, text)`.

    Raises:
        InputError: pycolmap is not installed, there are fewer than 3 photographs, they do not overlap enough, or `out`
            holds a model, a database or photographs that this program did not put there.
    """
    pycolmap = require_pycolmap()
    settings, report = settings or SfmSettings(), progress or (lambda done, total, text: None)
    names = photographs_in(folder)
    require_photographs(folder, names, LEAST_PHOTOGRAPHS)
    if unread := describe_unread(folder):
        logger.warning("%s: %s", folder, unread)
    _keep_photographs(folder, names, out)
    known = _read_notes(out)
    if not known:
        _keep_others(folder, out)
    out.mkdir(parents=True, exist_ok=True)
    own = _fingerprint(folder, names, settings)
    if known.get("fingerprint") == own and (out / MODEL / "images.bin").is_file():
        logger.info("%s: holds the poses of these photographs already", out)
        return Registration(tuple(known["registered"]), known["left_out"], known["points"], known["error"])
    database = out / "database.db"
    if known.get("fingerprint") != own:
        database.unlink(missing_ok=True)
        _write_notes(out, {"fingerprint": own})
    pycolmap.set_random_seed(settings.seed)
    unreadable = {name: reason for name in names if (reason := _why_unreadable(folder / name))}
    readable = [name for name in names if name not in unreadable]
    if unreadable and len(readable) < LEAST_PHOTOGRAPHS:
        name, reason = next(iter(unreadable.items()))
        raise InputError(f"{folder / name}: {reason} ({len(unreadable)} of {len(names)} photographs)")
    extract_features(database, folder, readable, settings, report)
    match_features(database, choose_pairs(readable, settings.matching), settings, report)
    model = _map(database, folder, out, settings, len(readable), report)
    _adjust(model, settings, database)
    found = Registration(
        tuple(sorted(model.image(number).name for number in model.reg_image_ids())),
        {},
        model.num_points3D(),
        float(model.compute_mean_reprojection_error()),
    )
    found.left_out.update(_reasons(database, unreadable, readable, found.registered))
    _keep(model, folder, out)
    _write_notes(out, {"fingerprint": own, **asdict(found)})
    database.unlink()
    return found


def _keep_photographs(folder: Path, names: Sequence[str], out: Path) -> None:
    """Refuse photographs that lie in one of the folders of `out` that are removed before they are written.

    Raises:
        InputError: One does.
    """
    removed = [(out / name).resolve() for name in (MAPPING, WHOLE, MODEL)]
    for name in names:
        note_input(folder / name)
        path = (folder / name).resolve()
        if any(path.is_relative_to(place) for place in removed):
            raise InputError(f"{folder / name}: would be removed by the results, which go there; choose another --out")


def _keep_others(folder: Path, out: Path) -> None:
    """Refuse a folder in which another program's results would be replaced: COLMAP names its own the same.

    Raises:
        InputError: There are such results.
    """
    images = out / "images"
    found = [path for path in (out / "database.db", out / MODEL) if os.path.lexists(path)]
    if os.path.lexists(images) and images.resolve() != folder.resolve():
        found.append(images)
    if found:
        raise InputError(f"{found[0]}: is there already, and `sgwarp poses` did not make it; choose another --out")


def _why_unreadable(path: Path) -> str | None:
    """Why COLMAP cannot read a photograph, or None if it can."""
    if path.suffix.lower() in NOT_COLMAP:
        return f"needs another format: COLMAP reads no {path.suffix.lower()[1:]}, convert it to JPEG or PNG"
    try:
        height, width = read_size(path)
    except InputError:
        return "cannot be read"
    try:
        refuse_panorama(path, height, width)
    except InputError as error:
        return str(error).removeprefix(f"{path}: ")
    return None


def _map(database: Path, folder: Path, out: Path, settings: SfmSettings, count: int, report: Report) -> Any:
    """The largest model that COLMAP can make."""
    options = require_pycolmap().IncrementalPipelineOptions()
    options.random_seed, options.num_threads = settings.seed, settings.threads
    options.min_model_size = LEAST_PHOTOGRAPHS
    work = out / MAPPING
    models = _attempt(database, folder, work, options, count, report)
    if not models:
        options.mapper.init_min_tri_angle = LEAST_ANGLE
        options.mapper.init_min_num_inliers = FEW_MATCHES
        models = _attempt(database, folder, work, options, count, report)
    if not models:
        raise InputError(
            f"{folder}: no two photographs overlap enough to place them; take more of them, closer together, sharp, "
            "and of something that is not even or shiny"
        )
    ordered = sorted(models.values(), key=lambda model: model.num_reg_images(), reverse=True)
    if len(ordered) > 1 and ordered[0].num_reg_images() < count:  # parts may overlap
        others = ", ".join(str(model.num_reg_images()) for model in ordered[1:])
        logger.warning(
            "%s: falls into %d parts that could not be joined; the largest is used (%d photographs; others: %s)",
            *(folder, len(ordered), ordered[0].num_reg_images(), others),
        )
    return ordered[0]


def _attempt(database: Path, folder: Path, work: Path, options: Any, count: int, report: Report) -> Any:
    """Models by number; none if no two photographs can be placed."""
    pycolmap = require_pycolmap()
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir()
    placed = 2

    def note() -> None:
        nonlocal placed
        placed += 1

    def run(token: Any) -> Any:
        return pycolmap.incremental_mapping(
            database, folder, work, options=options, next_image_callback=note, cancellation_token=token
        )

    models = run_cancellable(database, run, lambda: report(min(placed, count), count, "placing photographs"))
    shutil.rmtree(work, ignore_errors=True)
    return models


def _adjust(model: Any, settings: SfmSettings, database: Path) -> None:
    """Adjust all poses, the cameras and the points once more, so that wrong matches do not pull.

    The mapper minimizes squared errors, and keeps what is up to 4 pixels off. Cauchy's loss leaves such features next
    to no weight.
    """
    pycolmap = require_pycolmap()
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = OUTLIER
    options.ceres.solver_options.max_num_iterations = ADJUSTMENTS
    options.ceres.solver_options.num_threads = settings.threads
    every = pycolmap.BundleAdjustmentConfig()
    for number in model.reg_image_ids():
        every.add_image(number)
    every.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    # pycolmap.bundle_adjustment would do the same, and write to the terminal whatever the level of its log is.
    adjuster = pycolmap.create_default_bundle_adjuster(options, every, model)
    run_cancellable(database, lambda token: adjuster.solve())
    model.update_point_3d_errors()


def _reasons(
    database: Path, unreadable: Mapping[str, str], readable: Sequence[str], registered: Sequence[str]
) -> dict[str, str]:
    """Why photographs have no pose, as far as the database tells."""
    pycolmap = require_pycolmap()
    reasons = dict(unreadable)
    with pycolmap.Database.open(database) as data:
        images = {image.name: image.image_id for image in data.read_all_images()}
        best: dict[int, int] = {}
        for pair, geometry in zip(*data.read_two_view_geometries(), strict=True):
            for number in pycolmap.pair_id_to_image_pair(pair):
                best[number] = max(best.get(number, 0), len(geometry.inlier_matches))
        for name in set(readable) - set(registered):
            number = images.get(name, 0)
            features = data.num_keypoints_for_image(number) if number else 0
            if features < FEW_FEATURES:
                reasons[name] = f"only {features} features: blurred, dark, or of something even"
            elif best.get(number, 0) < FEW_MATCHES:
                reasons[name] = "overlaps no other photograph enough"
            else:
                reasons[name] = "overlaps others, but shows too few of the points that they have in common"
    return dict(sorted(reasons.items()))


def _keep(model: Any, folder: Path, out: Path) -> None:
    """Write the model whole or not at all, and link the photographs."""
    whole, target = out / WHOLE, out / MODEL
    shutil.rmtree(whole, ignore_errors=True)
    whole.mkdir()
    model.write_binary(str(whole))
    shutil.rmtree(target, ignore_errors=True)
    target.parent.mkdir(exist_ok=True)
    os.replace(whole, target)
    link = out / "images"
    if link.is_symlink():
        link.unlink()
    if link.exists():
        return  # frames of a video
    try:
        link.symlink_to(folder.resolve(), target_is_directory=True)
    except OSError:
        logger.warning("%s: cannot be made a link to the photographs; name them with --images %s", link, folder)


def _fingerprint(folder: Path, names: Sequence[str], settings: SfmSettings) -> str:
    """Of names, sizes and times of the files, and of the settings."""
    digest = hashlib.sha256(repr((settings.matching, settings.one_camera, settings.camera_model)).encode())
    digest.update(repr(settings.seed).encode())
    for name in names:
        facts = (folder / name).stat()
        digest.update(f"{name} {facts.st_size} {facts.st_mtime_ns}\n".encode())
    return digest.hexdigest()[:16]


def _read_notes(out: Path) -> dict[str, Any]:
    try:
        with own_files():
            notes = read_json(out / NOTES)
    except InputError:
        return {}
    return notes if isinstance(notes, dict) else {}


def _write_notes(out: Path, notes: dict[str, Any]) -> None:
    with atomic_path(out / NOTES) as temporary:
        temporary.write_text(json.dumps(notes, indent=1) + "\n", encoding="utf-8")
