"""Tracking into a folder: one folder per frame, written whole; an interrupted run goes on where it stopped."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sgwarp.apps.tracking import pictures, state
from sgwarp.apps.tracking.answers import Answer, Questions, answer
from sgwarp.apps.tracking.tracker import TrackedFrame, Tracker, count_frames, views_at
from sgwarp.files.atomic import atomic_path
from sgwarp.files.documents import read_json
from sgwarp.files.images import write_ids, write_rgb
from sgwarp.files.inputs import own_files, require_no_inputs_in
from sgwarp.io.moving_views import FrameView, MovingViews
from sgwarp.io.sequences import GaussianSequence
from sgwarp.rendering.renderer import render
from sgwarp.runs.interrupt import deferred_interrupt
from sgwarp.runs.log import RunLog
from sgwarp.runs.progress import Report
from sgwarp.scene import View

FRAME_FILE = "frame.json"  # written last: a folder that holds one is complete
TRACKS = "tracks.json"


@dataclass(frozen=True)
class Output:
    """Where the answers go.

    Attributes:
        folder: `{frame:05d}/{stem}.png`, `{frame:05d}/frame.json`, tracks.json, pictures.
        masks: Cameras of the images; those that were lifted if None.
        features: Store the features of every frame in `features/`.
        pictures: Draw overlays, contact sheet, video and trajectories.
        every: Frames between two checkpoints.
        settings: What a run must have in common with the one that it goes on from.
    """

    folder: Path
    masks: MovingViews | None = None
    features: bool = False
    pictures: bool = True
    every: int = 10
    settings: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class _Told:
    """A frame, what was answered, and of which views."""

    tracked: TrackedFrame
    answer: Answer
    asked: list[FrameView]


def run_tracking(
    sequence: GaussianSequence,
    views: MovingViews,
    tracker: Tracker,
    questions: Questions,
    output: Output,
    *,
    frames: int | None = None,
    resume: bool = False,
    progress: Report | None = None,
) -> dict[str, Any]:
    """Track a scene and write what is asked; returns the content of tracks.json.

    Raises:
        InputError: See `Tracker.step`, `answer`, `load_state`.
        KeyboardInterrupt: Ctrl-C; what was done so far is kept for `resume`.
    """
    total = count_frames(sequence, views, frames)
    report, log = progress or (lambda done, total, name: None), tracker.log
    store = state.FeatureStore(output.folder / "features") if output.features else None
    first, channels = 0, torch.empty(0, dtype=torch.int64)
    earlier = state.load_state(output.folder, tracker, output.settings) if resume else None
    if earlier is not None:
        first, channels = earlier[0] + 1, earlier[1]
        log.leave_out("frames_done_before", first)
        if store is not None:
            store.resume(first - 1)
    report(first, total, "")
    last: _Told | None = None
    started = time.perf_counter()
    with deferred_interrupt() as interrupted:
        for index in range(first, total):
            last = _one(sequence, views, tracker, questions, output, index, channels, last)
            tracked, channels = last.tracked, last.answer.channels.cpu()
            if store is not None:
                with log.stage("write"):
                    store.write(tracked)
            if (index + 1) % output.every == 0 or index + 1 == total or interrupted():
                with log.stage("write"):
                    state.save_state(output.folder, tracker, index, output.settings, channels)
            rate = (index + 1 - first) / (time.perf_counter() - started)
            report(index + 1, total, f"frame {index}, {rate:.1f} frames/s")
            if interrupted():
                raise KeyboardInterrupt
    if store is not None:
        log.leave_out("stored_features_that_did_not_change", store.all_rows - store.rows)
    return _finish(output, total, log)


def _one(
    sequence: GaussianSequence,
    views: MovingViews,
    tracker: Tracker,
    questions: Questions,
    output: Output,
    index: int,
    before: Tensor,
    last: _Told | None,
) -> _Told:
    """Track one frame and write its folder; a frame in which nothing changed is answered as the one before."""
    log = tracker.log
    with log.stage("read"):
        frame = sequence.frame(index)
    shown = views_at(views, index)
    tracked = tracker.step(frame, shown)
    asked = shown if output.masks is None else views_at(output.masks, index)
    with log.stage("ask"):
        if last is not None and tracked.unchanged and _same_cameras(asked, last.asked):
            found = last.answer
            log.leave_out("answers_that_did_not_change")
        else:
            found = answer(tracked, questions, [view.view for view in asked])
    with log.stage("write"):
        _write(output, tracked, found, asked, before)
    return _Told(tracked, found, asked)


def _same_cameras(asked: list[FrameView], before: list[FrameView]) -> bool:
    """Whether the same views look from the same places."""
    return len(asked) == len(before) and all(
        (one.view.stem, one.view.camera.size) == (other.view.stem, other.view.camera.size)
        and torch.equal(one.view.camera.K, other.view.camera.K)
        and torch.equal(one.view.camera.world_to_camera, other.view.camera.world_to_camera)
        for one, other in zip(asked, before, strict=True)
    )


def _write(output: Output, tracked: TrackedFrame, found: Answer, asked: list[FrameView], before: Tensor) -> None:
    folder = output.folder / f"{tracked.index:05d}"
    for stem, image in found.images.items():
        write_ids(folder / f"{stem}.png", image)
    if output.pictures and asked:
        chosen = [view.view for view in asked][:: max(1, len(asked) // pictures.SIDE_BY_SIDE)][: pictures.SIDE_BY_SIDE]
        photographs = [_photograph(tracked, view) for view in chosen]
        images = [found.images[view.stem] for view in chosen]
        picture = pictures.frame_picture(photographs, images, found.names, found.values, f"frame {tracked.index}")
        write_rgb(output.folder / "overlays" / f"{tracked.index:05d}.jpg", picture)
    now = found.channels.cpu()
    row = {"frame": tracked.index, "objects": found.objects, "scores": found.scores}
    row |= {"changed_object": count_changes(before, now)}
    row |= {"views": [view.view.stem for view in asked], "left_out": round(tracked.work.left_out, 6)}
    with atomic_path(folder / FRAME_FILE) as temporary:
        temporary.write_text(json.dumps(row, allow_nan=False), encoding="utf-8")


def count_changes(before: Tensor, now: Tensor) -> int | None:
    """Gaussians that belong to another object than before, -1 for none [N]; None where their number changed."""
    if len(now) != len(before):
        return None
    return int(((now != before) & (now >= 0) & (before >= 0)).sum())


def _photograph(tracked: TrackedFrame, view: View) -> Any:
    if view.image_path is not None:
        return view.image()
    return render(tracked.gaussians, view.camera).clamp(0.0, 1.0).cpu()


def _finish(output: Output, total: int, log: RunLog) -> dict[str, Any]:
    """Gather the frames into tracks.json and draw the pictures; frames of an earlier, longer run go."""
    for path in output.folder.iterdir():
        if path.name.isdecimal() and int(path.name) >= total and (path / FRAME_FILE).is_file():
            require_no_inputs_in(path)
            shutil.rmtree(path)
    rows = [_read_row(output.folder / f"{index:05d}" / FRAME_FILE) for index in range(total)]
    tracks = gather(rows)
    with log.stage("write"):
        with atomic_path(output.folder / TRACKS) as temporary:
            temporary.write_text(json.dumps(tracks, allow_nan=False) + "\n", encoding="utf-8")
        log.outputs.append(str(output.folder / TRACKS))
        if output.pictures:
            drawn = [output.folder / "overlays" / f"{index:05d}.jpg" for index in range(total)]
            _draw(output.folder, [path for path in drawn if path.is_file()], tracks, log)
    return tracks


def _draw(folder: Path, drawn: Sequence[Path], tracks: dict[str, Any], log: RunLog) -> None:
    if drawn:
        pictures.write_contact_sheet(folder / "contact_sheet.jpg", drawn)
        pictures.write_video(folder / "video.mp4", drawn)
        log.outputs += [str(folder / name) for name in ("contact_sheet.jpg", "video.mp4")]
    if pictures.write_trajectories(folder / "trajectories.png", tracks):
        log.outputs.append(str(folder / "trajectories.png"))


def _read_row(path: Path) -> dict[str, Any]:
    with own_files():
        row: dict[str, Any] = read_json(path, "track again without --resume")
    return row


def gather(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Rows of the frames as tracks: of each object one list per quantity, an entry per frame, null where it is unknown.

    `switches` counts, per frame, the Gaussians that belong to another object than in the frame before.
    """
    names = list(dict.fromkeys(one["name"] for row in rows for one in row["objects"]))
    if all(name.isdecimal() for name in names):
        names.sort(key=int)  # ids, which come in the order of their first sight
    objects: dict[str, Any] = {}
    for name in names:
        found = [next((one for one in row["objects"] if one["name"] == name), None) for row in rows]
        keys = ("gaussians", "centroid", "extent", "visible", "pixels")
        blank: dict[str, Any] = {"gaussians": 0, "centroid": None, "extent": None, "visible": False, "pixels": {}}
        objects[name] = {key: [(one or blank)[key] for one in found] for key in keys}
    texts = list(rows[0]["scores"]) if rows else []
    return {
        "frames": [row["frame"] for row in rows],
        "views": rows[0]["views"] if rows else [],
        "objects": objects,
        "switches": [row["changed_object"] for row in rows],
        "scores": {text: [row["scores"][text] for row in rows] for text in texts},
        "left_out": [row["left_out"] for row in rows],
    }
