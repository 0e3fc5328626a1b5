"""The steps of a fit: render a view, compare it with its photograph, improve what it has seen."""

from __future__ import annotations

import dataclasses
import logging
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.metrics.images import psnr
from sgwarp.ops.photometric import photometric_loss
from sgwarp.ops.splatting.autograd import rasterize as rasterize_with_gradients
from sgwarp.ops.splatting.forward import rasterize
from sgwarp.reconstruction.fitting.checkpoint import Checkpoint, fingerprint
from sgwarp.reconstruction.fitting.coverage import seen_by_any
from sgwarp.reconstruction.fitting.densify import Densify
from sgwarp.reconstruction.fitting.exposure import Exposure
from sgwarp.reconstruction.fitting.held_out_poses import refine_held_out_poses
from sgwarp.reconstruction.fitting.mcmc import MarkovChain
from sgwarp.reconstruction.fitting.measurement import Measurement
from sgwarp.reconstruction.fitting.model import Gradients, Model
from sgwarp.reconstruction.fitting.photographs import Photograph
from sgwarp.reconstruction.fitting.pose_refinement import PoseRefinement
from sgwarp.reconstruction.fitting.settings import FitSettings
from sgwarp.runs.log import RunLog
from sgwarp.runs.progress import Report
from sgwarp.runs.seeds import generator, view_at
from sgwarp.scene import Camera, Gaussians

logger = logging.getLogger("sgwarp")
MOST_MEASURED = 64  # of the fitted views
REPORT_EVERY = 10  # steps between two reports of the progress
MEMORY = 0.99  # of the loss that is reported


class Loop:
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
        self.poses = PoseRefinement([p.camera for p in photographs], device) if settings.refine_poses else None
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

        def rate() -> float:
            return (self.step - first) / max(time.perf_counter() - began, 1e-9)

        while self.step < settings.steps:
            if interrupted():
                return False
            if self.step % REPORT_EVERY == 0:
                report(self.step, settings.steps, self._text(rate()))
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
        report(self.step, settings.steps, self._text(rate()))
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
        correction = None if self.poses is None else self.poses.leaf(index)
        image = rasterize_with_gradients(
            leaves["means"],
            leaves["quats"],
            leaves["scales"],
            leaves["opacities"],
            camera.world_to_camera if self.poses is None else self.poses.world_to_camera(index, correction),
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
        if self.exposure is not None:
            assert colour_map is not None
            assert colour_map.grad is not None
            self.exposure.update(index, colour_map.grad, share)
        if self.poses is not None:
            assert correction is not None
            assert correction.grad is not None
            self.poses.update(index, correction.grad, share)
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

    def _shown_behind(self) -> Tensor | None:
        """The background that is measured with."""
        return torch.ones(3, device=self.device) if self.settings.background == "white" else None

    def measure(self) -> dict[str, float]:
        """PSNR of each held-out view, and a point of the curve."""
        values = self._psnr_of(self.held_out, [photograph.camera for photograph in self.held_out])
        mean = sum(values) / len(values) if values else math.nan
        if not self.curve or self.curve[-1].step != self.step:
            self.curve.append(Measurement(self.step, self.seconds, mean, self.loss, len(self.model)))
        return {photograph.stem: value for photograph, value in zip(self.held_out, values, strict=True)}

    def measure_refined(self, report: Report) -> tuple[dict[str, float], list[Camera]]:
        """PSNR of each held-out view from a pose refined to the scene as it is [dB], and its camera."""
        gaussians, share = self.model.gaussians(), self.settings.similarity_share
        with self.log.stage("held-out poses"):
            cameras = refine_held_out_poses(gaussians, self.held_out, self._shown_behind(), share, report)
        values = self._psnr_of(self.held_out, cameras)
        return {photograph.stem: value for photograph, value in zip(self.held_out, values, strict=True)}, cameras

    def measure_fitted(self) -> float:
        """Mean PSNR of the views that are fitted, of at most 64 of them [dB]."""
        every = 1 + (len(self.photographs) - 1) // MOST_MEASURED
        values = self._psnr_of(self.photographs[::every], self.cameras()[::every])
        return sum(values) / len(values)

    def cameras(self) -> list[Camera]:
        """Of the photographs that are fitted, refined if that was asked for."""
        given = [photograph.camera for photograph in self.photographs]
        return given if self.poses is None else self.poses.cameras()

    def _psnr_of(self, photographs: Sequence[Photograph], cameras: Sequence[Camera]) -> list[float]:
        """PSNR of the renderings of each photograph [dB]."""
        gaussians = self.model.gaussians()
        background = self._shown_behind()
        values = []
        with self.log.stage("measure"):
            for photograph, camera in zip(photographs, cameras, strict=True):
                image = rasterize(gaussians, camera, background=background).features
                values.append(psnr(image, photograph.image(background), photograph.mask))
        return values

    def remove_unseen(self) -> None:
        """Remove the Gaussians that lie outside what the cameras can see: noise and moves have left them there."""
        seen = seen_by_any(self.model.gaussians(), self.cameras())
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
            poses={} if self.poses is None else self.poses.state(),
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
            if self.poses is not None:
                self.poses.restore(saved.poses)
            self.step, self.seconds = saved.step, saved.seconds
            (loss, self._psnr), *points = saved.curve
            self._loss.fill_(loss)
            self.curve = [Measurement(*point) for point in points]  # type: ignore[arg-type]
        except (KeyError, TypeError, ValueError):
            raise InputError(f"{path}: is damaged; start again without --resume") from None
