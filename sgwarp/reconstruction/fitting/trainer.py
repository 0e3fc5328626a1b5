"""Fitting a scene to posed photographs (Kerbl et al. 2023): render a view, compare, improve what it has seen."""

from __future__ import annotations

import dataclasses
import logging
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.metrics.images import psnr
from sgwarp.ops.photometric import photometric_loss
from sgwarp.ops.splatting.autograd import rasterize as rasterize_with_gradients
from sgwarp.ops.splatting.forward import rasterize
from sgwarp.reconstruction.fitting.checkpoint import Checkpoint, fingerprint
from sgwarp.reconstruction.fitting.coverage import report_start, seen_by_any
from sgwarp.reconstruction.fitting.densify import Densify
from sgwarp.reconstruction.fitting.exposure import Exposure
from sgwarp.reconstruction.fitting.frame import Frame
from sgwarp.reconstruction.fitting.initial import (
    adapted,
    checked_points,
    completed,
    gaussians_from_points,
    random_points,
)
from sgwarp.reconstruction.fitting.mcmc import MarkovChain
from sgwarp.reconstruction.fitting.measurement import Measurement as Measurement
from sgwarp.reconstruction.fitting.model import Gradients, Model
from sgwarp.reconstruction.fitting.photographs import (
    Masks,
    Photograph,
    read_photographs,
    require_enough,
    require_overlap,
)
from sgwarp.reconstruction.fitting.settings import FitSettings
from sgwarp.runs.interrupt import deferred_interrupt
from sgwarp.runs.isolation import isolated
from sgwarp.runs.log import RunLog
from sgwarp.runs.progress import Report
from sgwarp.runs.seeds import generator, view_at
from sgwarp.scene import Gaussians, View

logger = logging.getLogger("sgwarp")
EXTENT = 1.0  # of the cameras, in the frame that scenes are fitted in
FEW_POINTS = 20_000  # to start from, below which more are added where photographs agree
MOST_MEASURED = 64  # of the fitted views
REPORT_EVERY = 10  # steps between two reports of the progress
MEMORY = 0.99  # of the loss that is reported


@dataclass(frozen=True, eq=False)
class Fitted:
    """Result of a fit.

    Attributes:
        gaussians: The scene.
        curve: Measurements on the way, the last one of `gaussians`.
        held_out: PSNR of each held-out view by its stem [dB].
        fitted_psnr: Mean PSNR of the views that it was fitted to [dB]; far above that of the held-out ones, it is
            overfitted.
        complete: False if it was interrupted.
    """

    gaussians: Gaussians
    curve: list[Measurement]
    held_out: dict[str, float]
    fitted_psnr: float
    complete: bool


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
        held_out: Posed photographs to measure on; nothing is fitted to them.
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
    frame = Frame.around(views)
    with log.stage("read"):
        photographs, shown = (
            read_photographs(
                [*map(frame.view, group)], downscale=downscale, largest=largest, masks=given, device=device
            )
            for group in (views, held_out)
        )
    require_enough(photographs)
    run = _Run(settings, photographs, shown, EXTENT, torch.device(device), log)
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
    with deferred_interrupt() as interrupted:
        complete = run.go(report, path, checkpoint_every, interrupted)
    if path is not None:
        run.try_to_save(path)
    if complete:
        run.remove_unseen()
    measured, on_fitted = run.measure(), run.measure_fitted()
    if path is not None and complete and not keep_checkpoint:
        path.unlink(missing_ok=True)
    return Fitted(frame.restored(run.model.gaussians()), run.curve, measured, on_fitted, complete)


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
        positions, colours, size = random_points(photographs, settings, report)
        return gaussians_from_points(positions, colours, settings, EXTENT, device, size)
    positions, colours = checked_points(*start)
    positions = frame.points(positions)
    require_overlap(photographs, positions.to(torch.float32), held_out)  # before the cap thins them
    if len(positions) < min(FEW_POINTS, settings.cap // 2):
        positions, colours = completed(positions, colours, photographs, settings, report)
    return gaussians_from_points(positions, colours, settings, EXTENT, device)


class _Run:
    """A fit in progress."""

    model: Model
    strategy: Densify | MarkovChain

    def __init__(
        self,
        settings: FitSettings,
        photographs: Sequence[Photograph],
        held_out: Sequence[Photograph],
        extent: float,
        device: torch.device,
        log: RunLog,
    ) -> None:
        self.settings = settings
        self.photographs = photographs
        self.held_out = held_out
        self.extent = extent
        self.device = device
        self.log = log
        self.exposure = Exposure(len(photographs), device) if settings.exposure else None
        self.step = 0
        self.seconds = 0.0
        # Steps leave these on the device and nobody reads them until they are shown: on CUDA to read is to wait.
        self._loss = torch.full((), math.nan, dtype=torch.float64, device=device)
        self._unseen = torch.zeros((), dtype=torch.int64, device=device)
        self._looked_at: tuple[Tensor, Tensor, Tensor | None] | None = None
        self._psnr = math.nan
        self.curve: list[Measurement] = []

    def begin(self, gaussians: Gaussians) -> None:
        """Start from a scene."""
        self._adopt(Model.starting(gaussians))

    def _adopt(self, model: Model) -> None:
        self.model = model
        if self.settings.strategy == "mcmc":
            self.strategy = MarkovChain(self.settings, self.extent, len(self.photographs))
        else:
            self.strategy = Densify(self.settings, self.extent, len(self.photographs), len(model), self.device)

    def go(
        self, report: Report, checkpoint: Path | None, checkpoint_every: int, interrupted: Callable[[], bool]
    ) -> bool:
        """Take the remaining steps; returns False if interrupted before the last one."""
        try:
            return self._go(report, checkpoint, checkpoint_every, interrupted)
        finally:
            self._settle()
            self.log.leave_out("updates_of_unseen_gaussians", int(self._unseen))
            self._unseen.zero_()

    def _go(
        self, report: Report, checkpoint: Path | None, checkpoint_every: int, interrupted: Callable[[], bool]
    ) -> bool:
        settings = self.settings
        began, first = time.perf_counter(), self.step
        while self.step < settings.steps:
            if interrupted():
                return False
            if self.step % REPORT_EVERY == 0:
                report(self.step, settings.steps, self._text((self.step - first) / (time.perf_counter() - began)))
            with self._timed():
                refine = self._take_step()
            # Before the refinement, as the reference does: it may have just made all Gaussians transparent.
            if self.step % settings.evaluate_every == 0 and self.step < settings.steps:
                self._settle()
                self.measure()
            with self._timed():
                refine()
            if checkpoint is not None and self.step % checkpoint_every == 0 and self.step < settings.steps:
                self._settle()
                with self.log.stage("checkpoint"):
                    self.try_to_save(checkpoint)
        report(self.step, settings.steps, self._text((self.step - first) / max(time.perf_counter() - began, 1e-9)))
        return True

    @contextmanager
    def _timed(self, wait: bool = False) -> Iterator[None]:
        before = time.perf_counter()
        with self.log.stage("fit", wait):
            yield
        self.seconds += time.perf_counter() - before

    def _settle(self) -> None:
        """Charge the steps, not what comes next, with what the device has yet to do."""
        with self._timed(wait=True):
            pass

    @property
    def loss(self) -> float:
        """The running loss."""
        return float(self._loss)

    @property
    def psnr(self) -> float:
        """Of the photograph that was looked at last [dB]."""
        if self._looked_at is not None:
            self._psnr = psnr(*self._looked_at)
            self._looked_at = None
        return self._psnr

    def _take_step(self) -> Callable[[], None]:
        """Look at one photograph and update the Gaussians; the result refines their set."""
        settings, model = self.settings, self.model
        index = view_at(settings.seed, self.step, len(self.photographs))
        photograph = self.photographs[index]
        camera = photograph.camera
        model.raise_degree(settings.degree_at(self.step))
        leaves = {name: model[name].detach().requires_grad_() for name in model.groups}
        centres = torch.zeros(len(model), 2, device=self.device, requires_grad=self.strategy.wants_means2d)
        background = self._background()
        image = rasterize_with_gradients(
            leaves["means"],
            leaves["quats"],
            leaves["scales"],
            leaves["opacities"],
            camera.world_to_camera,
            camera.K,
            camera.width,
            camera.height,
            sh=leaves["sh"],
            background=background,
            means2d=centres if self.strategy.wants_means2d else None,
            near=camera.near,
            far=camera.far,
        ).features
        colour_map = None
        if self.exposure is not None:
            colour_map = self.exposure.leaf(index)
            image = self.exposure.apply(colour_map, image)
        truth = photograph.image(background)
        if photograph.mask is not None:
            image = torch.where(photograph.mask[..., None], image, truth)  # no difference, and no gradient
        loss = photometric_loss(image, truth, settings.similarity_share)
        loss.backward()
        grads = {name: leaf.grad for name, leaf in leaves.items()}
        gradients = Gradients(**grads, means2d=centres.grad)  # type: ignore[arg-type]
        share = self.step / settings.steps
        taken = model.update(gradients, settings.means_rate_at(self.step, self.extent), settings)
        if self.exposure is not None and colour_map is not None and colour_map.grad is not None:
            self.exposure.update(index, colour_map.grad, share)
        self._unseen += (taken.marks == 0).sum()
        value = loss.detach().to(torch.float64)
        self._loss = torch.where(self._loss.isnan(), value, MEMORY * self._loss + (1 - MEMORY) * value)
        self.step += 1
        if self.step % REPORT_EVERY == 0:
            self._looked_at = image.detach(), truth, photograph.mask
        return partial(self.strategy.after_step, model, self.step, gradients, taken, camera)

    def _background(self) -> Tensor | None:
        if self.settings.background == "black":
            return None
        if self.settings.background == "white":
            return torch.ones(3, device=self.device)
        return torch.rand(3, generator=generator(self.settings.seed, self.step, "background")).to(self.device)

    def measure(self) -> dict[str, float]:
        """PSNR of each held-out view, and a point of the curve."""
        values = self._psnr_of(self.held_out)
        mean = sum(values) / len(values) if values else math.nan
        if not self.curve or self.curve[-1].step != self.step:
            self.curve.append(Measurement(self.step, self.seconds, mean, self.loss, len(self.model)))
        return {photograph.stem: value for photograph, value in zip(self.held_out, values, strict=True)}

    def measure_fitted(self) -> float:
        """Mean PSNR of the views that are fitted, of at most 64 of them [dB]."""
        values = self._psnr_of(self.photographs[:: 1 + (len(self.photographs) - 1) // MOST_MEASURED])
        return sum(values) / len(values)

    def _psnr_of(self, photographs: Sequence[Photograph]) -> list[float]:
        """PSNR of the renderings of each photograph [dB]."""
        gaussians = self.model.gaussians()
        background = torch.ones(3, device=self.device) if self.settings.background == "white" else None
        values = []
        with self.log.stage("measure"):
            for photograph in photographs:
                image = rasterize(gaussians, photograph.camera, background=background).features
                values.append(psnr(image, photograph.image(background), photograph.mask))
        return values

    def remove_unseen(self) -> None:
        """Remove the Gaussians that lie outside what the cameras can see: noise and moves have left them there."""
        seen = seen_by_any(self.model.gaussians(), [photograph.camera for photograph in self.photographs])
        if bool(seen.any()) and not bool(seen.all()):
            self.log.leave_out("gaussians_no_camera_sees", int((~seen).sum()))
            self.model.keep(seen)

    def _text(self, rate: float) -> str:
        held_out = f", held out {self.curve[-1].psnr:.2f} dB" if self.curve and self.held_out else ""
        speed = f", {rate:.1f} it/s" if self.step else ""
        return f"loss {self.loss:.4f}, {self.psnr:.2f} dB{held_out}, {len(self.model):,} Gaussians{speed}"

    def try_to_save(self, path: Path) -> None:
        """Write a checkpoint; where that fails, say so and go on: the next one may be written again."""
        try:
            self.save(path)
        except InputError as error:
            logger.warning("%s; the fit goes on without it", error)
            self.log.leave_out("checkpoints")

    def save(self, path: Path) -> None:
        """Write a checkpoint."""
        Checkpoint(
            settings=dataclasses.asdict(self.settings),
            photographs=fingerprint(self.photographs, self.held_out),
            step=self.step,
            seconds=self.seconds,
            model=self.model.state(),
            strategy=self.strategy.state(),
            exposure={} if self.exposure is None else self.exposure.state(),
            curve=[[self.loss, self.psnr], *([*dataclasses.astuple(point)] for point in self.curve)],
        ).save(path)

    def restore(self, path: Path) -> None:
        """Go on from a checkpoint."""
        own = fingerprint(self.photographs, self.held_out)
        saved = Checkpoint.load(path, self.settings, own, self.device)
        try:
            self._adopt(Model.restored(saved.model))
            self.strategy.restore(saved.strategy)
            if self.exposure is not None:
                self.exposure.restore(saved.exposure)
            self.step, self.seconds = saved.step, saved.seconds
            (loss, self._psnr), *points = saved.curve
            self._loss.fill_(loss)
            self.curve = [Measurement(*point) for point in points]  # type: ignore[arg-type]
        except (KeyError, TypeError, ValueError):
            raise InputError(f"{path}: is damaged; start again without --resume") from None
