"""3DGS as Markov chain Monte Carlo (Kheradmand et al. 2024): noise, relocation of the dead, growth up to a cap."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from sgwarp.ops.adam import Taken, add_noise
from sgwarp.reconstruction.fitting.model import Gradients, Model
from sgwarp.reconstruction.fitting.settings import FitSettings
from sgwarp.runs.seeds import generator, number
from sgwarp.scene import Camera

REFINE_UNTIL = 25_000  # of the reference's steps
GROWTH = 1.05  # of the count at each refinement, and more where that would not reach the cap
FULL_AT = 15_000  # of the reference's steps, by which the cap is reached
UNSEEN_TURNS = 2  # turns through all photographs in which a Gaussian is not seen before it is moved
MOST_COPIES = 51  # that the change of opacity and scale accounts for
LEAST_LEFT = 1e-6  # opacities end this far below 1


class MarkovChain:
    """The strategy "mcmc"."""

    wants_means2d = False

    def __init__(self, settings: FitSettings, extent: float, photographs: int) -> None:
        self.settings = settings
        self.extent = extent
        self.patience = UNSEEN_TURNS * photographs

    def after_step(self, model: Model, step: int, gradients: Gradients, taken: Taken, camera: Camera) -> None:
        """Refine at its intervals, and add noise; `step` counts from 1."""
        settings = self.settings
        if settings.refines_at(step, REFINE_UNTIL):
            self._relocate(model, step)
            self._grow(model, step)
        size = settings.means_rate_at(step, self.extent) * settings.noise
        seed = number(settings.seed, step, "noise")
        add_noise(model["means"], model["quats"], model["scales"], model["opacities"], seed, size)

    def _relocate(self, model: Model, step: int) -> None:
        """Move what has become transparent, or has left the view of all cameras, to where opaque Gaussians are."""
        alive = (model["opacities"] > self.settings.least_opacity) & (model.skipped < self.patience)
        dead, living = (~alive).nonzero().flatten(), alive.nonzero().flatten()
        if len(dead) and len(living):
            hosts = self._choose(model, living, len(dead), generator(self.settings.seed, step, "relocate"))
            changed = self._share(model, hosts)
            model.assign(dead, {name: group.parameters[hosts] for name, group in model.groups.items()} | changed)
            model.assign(hosts, changed)

    def _grow(self, model: Model, step: int) -> None:
        settings = self.settings
        rounds = max(1, (settings.scaled(FULL_AT) - step) // settings.refine_every)
        growth = max(GROWTH, (settings.cap / len(model)) ** (1 / rounds))
        wanted = min(settings.cap, int(growth * len(model))) - len(model)
        if wanted > 0:
            everyone = torch.arange(len(model), device=model.steps.device)
            hosts = self._choose(model, everyone, wanted, generator(self.settings.seed, step, "grow"))
            changed = self._share(model, hosts)
            model.assign(hosts, changed)
            model.append(hosts, changed)

    @staticmethod
    def _choose(model: Model, rows: Tensor, count: int, random: torch.Generator) -> Tensor:
        """Rows with a probability in proportion to their opacity, drawn on the CPU whatever the device."""
        edges = model["opacities"][rows].cpu().to(torch.float64).cumsum(0)
        drawn = torch.rand(count, generator=random, dtype=torch.float64) * edges[-1]
        return rows[torch.searchsorted(edges, drawn, right=True).clamp(max=len(rows) - 1).to(rows.device)]

    def _share(self, model: Model, hosts: Tensor) -> dict[str, Tensor]:
        """Opacity and scale of a Gaussian and its copies that together look like it alone; rows of `hosts`."""
        copies = torch.bincount(hosts, minlength=len(model))[hosts] + 1
        opacities, factors = shared_opacity_and_scale(model["opacities"][hosts], copies)
        opacities = opacities.clamp(self.settings.least_opacity, 1 - LEAST_LEFT)
        return {
            "opacities": torch.logit(opacities).to(torch.float32),
            "scales": model.groups["scales"].parameters[hosts] + factors.log().to(torch.float32)[:, None],
        }

    def state(self) -> dict[str, Tensor]:
        return {}

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """All it needs are the seed and the step."""


def shared_opacity_and_scale(opacities: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity and scale that keep the rendering when a Gaussian is split into copies (Kheradmand et al. 2024, eq. 9).

    Args:
        opacities: [M].
        copies: How many there are afterwards, int64 [M]; more than MOST_COPIES count as that many.

    Returns:
        Opacity of each, and factor of its scales, float64 [M] both.
    """
    copies = copies.clamp(max=MOST_COPIES)
    opacity = opacities.to(torch.float64)
    shared = -torch.expm1(torch.log1p(-opacity.clamp(max=1 - LEAST_LEFT)) / copies)
    # sum_{i=1..n} sum_{k<i} C(i-1, k) (-1)^k o^(k+1) / sqrt(k+1), where the sum over i is C(n, k+1).
    total = torch.zeros_like(shared)
    chosen = torch.ones_like(shared)
    for k in range(int(copies.max())):
        chosen = chosen * (copies - k) / (k + 1)  # C(n, k+1), zero from k = n on
        total += chosen * (-1.0) ** k * shared ** (k + 1) / (k + 1) ** 0.5
    return shared, opacity / total
