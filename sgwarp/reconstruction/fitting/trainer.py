"""Fitting a scene to posed photographs (Kerbl et al. 2023): what it starts from, runs and returns."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from sgwarp.errors import InputError
from sgwarp.reconstruction.fitting.coverage import report_start
from sgwarp.reconstruction.fitting.frame import Frame
from sgwarp.reconstruction.fitting.initial import (
    adapted,
    checked_points,
    completed,
    gaussians_from_photographs,
    gaussians_from_points,
)
from sgwarp.reconstruction.fitting.loop import Loop
from sgwarp.reconstruction.fitting.measurement import Measurement as Measurement
from sgwarp.reconstruction.fitting.photographs import (
    Masks,
    Photograph,
    read_photographs,
    require_enough,
    require_overlap,
)
from sgwarp.reconstruction.fitting.pixels import PixelStore
from sgwarp.reconstruction.fitting.settings import FitSettings
from sgwarp.runs.interrupt import deferred_interrupt
from sgwarp.runs.isolation import isolated
from sgwarp.runs.log import RunLog
from sgwarp.runs.progress import Report
from sgwarp.scene import Camera, Gaussians, View

logger = logging.getLogger("sgwarp")
EXTENT = 1.0  # of the cameras, in the frame that scenes are fitted in
FEW_POINTS = 20_000  # to start from, below which more are added where photographs agree


@dataclass(frozen=True, eq=False)
class Fitted:
    """Result of a fit.

    Attributes:
        gaussians: The scene.
        curve: Measurements on the way, the last one of `gaussians`.
        held_out: PSNR of each held-out view by its stem [dB], from the pose that it came with.
        fitted_psnr: Mean PSNR of the views that it was fitted to [dB]; far above that of the held-out ones, it is
            overfitted.
        complete: False if it was interrupted.
        views: The views that it was fitted to, with their poses refined if that was asked for.
        held_out_refined: PSNR of each held-out view from a pose refined to the finished scene [dB]; empty if that was
            not asked for.
        held_out_views: The held-out views with these poses; as they came if that was not asked for.
    """

    gaussians: Gaussians
    curve: list[Measurement]
    held_out: dict[str, float]
    fitted_psnr: float
    complete: bool
    views: tuple[View, ...] = ()
    held_out_refined: dict[str, float] = field(default_factory=dict)
    held_out_views: tuple[View, ...] = ()


@isolated
def fit(
    views: Sequence[View],
    start: Gaussians | tuple[Any, Any] | None = None,
    held_out: Sequence[View] = (),
    settings: FitSettings | None = None,
    *,
    downscale: int = 1,
    largest: int = 0,
    masks: Masks | Mapping[str, Any] | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    checkpoint_every: int = 1000,
    keep_checkpoint: bool = False,
    resume: bool = False,
    device: str | torch.device = "cpu",
    progress: Report | None = None,
    log: RunLog | None = None,
) -> Fitted:
    """Fit a scene to posed photographs.

    On the CPU the same seed gives the same bits, also if the run is interrupted and resumed.

    Args:
        views: Posed photographs to fit to, at least 3.
        start: What to start from: points (positions [N, 3], colours [N, 3] in [0, 1]) as `load_points` returns them, a
            scene, such as `gaussians_from_depth` returns, or None for random points in front of the cameras.
        held_out: Posed photographs to measure on; nothing is fitted to them, but their poses if
            `settings.refine_held_out`, and these after the scene.
        settings: Steps, strategy, cap and everything else.
        downscale: Divide width and height of the photographs by this.
        largest: Photographs that are then wider or higher are scaled down to this [pixels]; 0 for none.
        masks: Which pixels of a view count, also of those held out, [H, W] of its photograph, zero for those that do
            not; by the name of the view, or a function of the view. A view without one counts as a whole.
        checkpoint: File to keep the state of the run in, every `checkpoint_every` steps and when interrupted; it is
            removed when the run is complete.
        keep_checkpoint: Leave it, of the last step, to whoever still has to write the scene.
        resume: Go on from that file.
        device: Where to compute.
        progress: Called as `progress(done, total, text)`.
        log: Takes the times of the stages, and what was left out.

    Raises:
        InputError: There are fewer than 3 photographs, one is missing, damaged, of the wrong size or shows nothing of
            the points to start from; or the checkpoint belongs to another run.
    """
    settings, log = settings or FitSettings(), log or RunLog()
    report = progress or (lambda done, total, text: None)
    views, held_out = list(views), list(held_out)
    if not all(isinstance(view, View) for view in (*views, *held_out)):
        raise InputError("views: expected posed photographs, as load_views returns them")
    if not (start is None or isinstance(start, Gaussians) or (isinstance(start, tuple) and len(start) == 2)):
        raise InputError("start: expected points (positions and colours), a scene, or None")
    given = (lambda view: masks.get(view.stem)) if isinstance(masks, Mapping) else masks
    path = None if checkpoint is None else Path(checkpoint)
    require_enough(views)
    if resume and checkpoint is None:
        raise InputError("resume: name the file of the checkpoint")
    if checkpoint_every < 1:
        raise InputError(f"checkpoint_every: expected at least 1, got {checkpoint_every}")
    frame = Frame.around(views, start.means if isinstance(start, Gaussians) else None if start is None else start[0])
    store = PixelStore(device)
    with log.stage("read"):
        photographs, shown = (
            read_photographs(
                [*map(frame.view, group)],
                downscale=downscale,
                largest=largest,
                masks=given,
                device=device,
                store=store,
            )
            for group in (views, held_out)
        )
    require_enough(photographs)
    run = Loop(settings, photographs, shown, EXTENT, torch.device(device), log)
    with log.stage("start"):
        if resume:
            assert path is not None
            run.restore(path)
        else:
            if path is not None and path.exists():
                logger.warning("%s: is left from a run that did not end, and is replaced; --resume would go on", path)
            first = _starting(start, photographs, shown, frame, settings, report, device)
            report_start(photographs, first.means, frame)
            run.begin(first)

    def tell(done: int, total: int, text: str) -> None:
        report(done, total, text)
        log.watch(lambda: frame.restored(run.model.gaussians()))

    with deferred_interrupt() as interrupted:
        complete = run.go(tell, path, checkpoint_every, interrupted)
    if path is not None:
        run.try_to_save(path)
    if complete:
        run.remove_unseen()
    measured, on_fitted = run.measure(), run.measure_fitted()
    refined: dict[str, float] = {}
    shown_by = [photograph.camera for photograph in shown]
    if complete and settings.refine_held_out and shown:
        refined, shown_by = run.measure_refined(report)
    if path is not None and complete and not keep_checkpoint:
        path.unlink(missing_ok=True)
    fitted_to = _with_poses(frame, views, photographs, run.cameras() if settings.refine_poses else None)
    measured_on = _with_poses(frame, held_out, shown, shown_by if refined else None)
    result = frame.restored(run.model.gaussians())
    log.watch(lambda: result)
    return Fitted(result, run.curve, measured, on_fitted, complete, fitted_to, refined, measured_on)


def _with_poses(
    frame: Frame, views: Sequence[View], photographs: Sequence[Photograph], cameras: Sequence[Camera] | None
) -> tuple[View, ...]:
    """The views whose photographs are used, with the poses of cameras of the frame, or as they came."""
    if cameras is None:
        used = {photograph.stem for photograph in photographs}
        return tuple(view for view in views if view.stem in used)
    refined = {photograph.stem: camera for photograph, camera in zip(photographs, cameras, strict=True)}
    return tuple(frame.with_pose(view, refined[view.stem]) for view in views if view.stem in refined)


def _starting(
    start: Gaussians | tuple[Any, Any] | None,
    photographs: Sequence[Photograph],
    held_out: Sequence[Photograph],
    frame: Frame,
    settings: FitSettings,
    report: Report,
    device: str | torch.device,
) -> Gaussians:
    """What the first step sees, in the frame of the fit."""
    if isinstance(start, Gaussians):
        gaussians = adapted(frame.gaussians(start), settings).to(device)
        require_overlap(photographs, gaussians.means, held_out)
        return gaussians
    if start is None:
        return gaussians_from_photographs(photographs, settings, EXTENT, report).to(device)
    positions, colours = checked_points(*start)
    positions = frame.points(positions)
    require_overlap(photographs, positions.to(torch.float32), held_out)  # before the cap thins them
    if len(positions) < min(FEW_POINTS, settings.cap // 2):
        return completed(positions, colours, photographs, settings, EXTENT, report).to(device)
    return gaussians_from_points(positions, colours, settings, EXTENT, device)
