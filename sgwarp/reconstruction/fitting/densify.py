"""Adaptive density control of 3DGS (Kerbl et al. 2023, section 5): clone, split, remove, reset opacities."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from sgwarp.ops.adam import Taken, note_gradients
from sgwarp.ops.planar.projection import rotation_matrices
from sgwarp.reconstruction.fitting.model import Gradients, Model
from sgwarp.reconstruction.fitting.settings import FitSettings
from sgwarp.runs.seeds import generator
from sgwarp.scene import Camera

REFINE_UNTIL = 15_000  # of the reference's steps
RESET_EVERY = 3_000
LEAST_RESET = 1_000  # steps between two resets, however short the run: opacities need some hundred to recover
CHILDREN = 2  # of a Gaussian that is split
SHRINK = 0.8 * CHILDREN  # of their scales
UNSEEN_TURNS = 2  # turns through all photographs in which a Gaussian is not seen before it is removed
HUGE = 0.1  # scale beyond which a Gaussian is removed once opacities have been reset [extent]
FAINT = 0.01  # what opacities are reset to


class Densify:
    """The strategy "default"."""

    wants_means2d = True

    def __init__(
        self, settings: FitSettings, extent: float, photographs: int, count: int, device: torch.device
    ) -> None:
        self.settings = settings
        self.extent = extent
        self.patience = UNSEEN_TURNS * photographs
        self._forget(count, device)

    def _forget(self, count: int, device: torch.device) -> None:
        self.sums = torch.zeros(count, device=device)
        self.views = torch.zeros(count, dtype=torch.int32, device=device)

    def after_step(self, model: Model, step: int, gradients: Gradients, taken: Taken, camera: Camera) -> None:
        """Note what a step has shown, and at its intervals refine; `step` counts from 1."""
        settings = self.settings
        if step >= settings.scaled(REFINE_UNTIL):
            return
        assert gradients.means2d is not None
        note_gradients(gradients.means2d, taken, camera.width, camera.height, self.sums, self.views)
        reset_every = max(LEAST_RESET, settings.scaled(RESET_EVERY))
        if settings.refines_at(step, REFINE_UNTIL):
            self._grow(model, step)
            self._prune(model, remove_huge=step > reset_every)
            self._forget(len(model), model.steps.device)
        if step % reset_every == 0:
            reset_opacities(model)

    def _grow(self, model: Model, step: int) -> None:
        """Clone the small and split the large Gaussians that the loss wants to move; the steepest first at the cap."""
        mean = self.sums / self.views.clamp(min=1)
        wanted = (mean >= self.settings.grow_gradient).nonzero().flatten()
        room = self.settings.cap - len(model)
        if len(wanted) > room:
            wanted = wanted[mean[wanted].argsort(descending=True, stable=True)[: max(room, 0)]].sort().values
        large = model["scales"][wanted].amax(dim=1) > self.settings.split_scale * self.extent
        cloned, split = wanted[~large], wanted[large]
        before = len(model)
        model.append(cloned)
        self._split(model, split, step)
        kept = torch.ones(len(model), dtype=torch.bool, device=split.device)
        kept[split] = False
        model.keep(kept)
        assert len(model) == before + len(wanted)

    def _split(self, model: Model, rows: Tensor, step: int) -> None:
        """Two smaller Gaussians in place of each, at random within it; the caller removes the original."""
        rows = rows.repeat(CHILDREN)
        scales = model["scales"][rows]
        # On the CPU whatever the device, so that a seed means the same everywhere.
        random = torch.randn(len(rows), 3, generator=generator(self.settings.seed, step, "split")).to(scales)
        offsets = (rotation_matrices(model["quats"][rows]) @ (scales * random)[..., None])[..., 0]
        model.append(rows, {"means": model["means"][rows] + offsets, "scales": (scales / SHRINK).log()})

    def _prune(self, model: Model, remove_huge: bool) -> None:
        kept = (model["opacities"] >= self.settings.least_opacity) & (model.skipped < self.patience)
        if remove_huge:
            kept &= model["scales"].amax(dim=1) <= HUGE * self.extent
        if bool(kept.any()):
            model.keep(kept)

    def state(self) -> dict[str, Tensor]:
        return {"sums": self.sums, "views": self.views}

    def restore(self, state: Mapping[str, Tensor]) -> None:
        self.sums, self.views = state["sums"], state["views"]


def reset_opacities(model: Model) -> None:
    """No Gaussian more opaque than FAINT, so that those which are not needed stay behind and are removed."""
    group = model.groups["opacities"]
    most = torch.logit(torch.tensor(FAINT)).item()
    group.parameters.clamp_(max=most)
    group.values.clamp_(max=FAINT)
    group.first.zero_()
    group.second.zero_()
