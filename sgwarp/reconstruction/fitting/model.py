"""The scene while it is fitted: parameters, their moments, and rows that come and go."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from sgwarp.ops.adam import Group, Taken, count_steps, update, values_of
from sgwarp.reconstruction.fitting.settings import FitSettings
from sgwarp.scene import SH_COUNTS, Gaussians

LEAST_SCALE, LEAST_FAINTNESS = 1e-9, 1e-6  # so that logarithms and logits are finite
REST_SHARE = 1 / 20  # of the rate of colours, for coefficients beyond degree 0
FORMS = {"means": "plain", "quats": "plain", "scales": "logarithm", "opacities": "logit", "sh": "plain"}


@dataclass(frozen=True, eq=False)
class Gradients:
    """Of the loss with respect to what is rendered, each shaped like it; `means2d` is [N, 2] or None."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor
    means2d: Tensor | None = None


class Model:
    """Gaussians with everything that their optimisation needs.

    Attributes:
        groups: Parameters by the name of the field of `Gaussians` that they stand for.
        steps: Of each Gaussian since it came, int32 [N].
        skipped: How many of the last ones it was not seen in, and has yet to make up for, int32 [N].
    """

    def __init__(self, groups: dict[str, Group], steps: Tensor, skipped: Tensor) -> None:
        self.groups = groups
        self.steps = steps
        self.skipped = skipped

    @classmethod
    def starting(cls, gaussians: Gaussians) -> Model:
        """From a scene; its colours keep the degree they have."""
        opacities = gaussians.opacities.clamp(LEAST_FAINTNESS, 1 - LEAST_FAINTNESS)
        parameters = {
            "means": gaussians.means.clone(),
            "quats": torch.nn.functional.normalize(gaussians.quats),
            "scales": gaussians.scales.clamp(min=LEAST_SCALE).log(),
            "opacities": torch.logit(opacities),
            "sh": gaussians.sh.clone(),
        }
        groups = {name: Group.starting(value, FORMS[name]) for name, value in parameters.items()}
        none = torch.zeros(len(gaussians), dtype=torch.int32, device=gaussians.device)
        return cls(groups, none, none.clone())

    def __len__(self) -> int:
        return len(self.steps)

    def __getitem__(self, name: str) -> Tensor:
        """The activated values that are rendered."""
        return self.groups[name].values

    def gaussians(self) -> Gaussians:
        """A copy of the scene as it is now."""
        fields = {name: group.values.detach().clone() for name, group in self.groups.items()}
        fields["quats"] = torch.nn.functional.normalize(fields["quats"])
        return Gaussians(**fields)

    def update(self, gradients: Gradients, means_rate: float, settings: FitSettings) -> Taken:
        """One step of the optimiser; returns who has taken it."""
        taken = count_steps(gradients.opacities, gradients.sh, self.steps, self.skipped, sparse=settings.sparse)
        mcmc = settings.strategy == "mcmc"
        pulls = {
            "scales": settings.scale_pull / (3 * len(self)) if mcmc else 0.0,
            "opacities": settings.opacity_pull / len(self) if mcmc else 0.0,
        }
        rates = {
            "means": means_rate,
            "quats": settings.quats_rate,
            "scales": settings.scales_rate,
            "opacities": settings.opacities_rate,
        }
        for name, rate in rates.items():
            update(self.groups[name], getattr(gradients, name), taken, rate, pull=pulls.get(name, 0.0))
        rest = settings.colors_rate * REST_SHARE
        sh = self.groups["sh"]
        update(sh, gradients.sh, taken, settings.colors_rate, leading=3, rate_of_rest=rest)
        return taken

    def raise_degree(self, degree: int) -> None:
        """Make room for the coefficients up to `degree`, starting from zero."""
        sh = self.groups["sh"]
        missing = SH_COUNTS[degree] - sh.parameters.shape[1]
        if missing > 0:
            grown = (torch.nn.functional.pad(t, (0, 0, 0, missing)) for t in (sh.parameters, sh.first, sh.second))
            parameters, first, second = grown
            self.groups["sh"] = Group(parameters, parameters, first, second, sh.form)

    def keep(self, rows: Tensor) -> None:
        """Only these rows (integers or a boolean mask), in this order."""
        for group in self.groups.values():
            group.parameters, group.first, group.second = (
                t[rows] for t in (group.parameters, group.first, group.second)
            )
            group.values = group.parameters if group.form == "plain" else group.values[rows]
        self.steps, self.skipped = self.steps[rows], self.skipped[rows]

    def append(self, rows: Tensor, changed: Mapping[str, Tensor] = {}) -> None:
        """Copies of these rows, with other parameters where given; they have taken no step."""
        for name, group in self.groups.items():
            new = changed.get(name, group.parameters[rows])
            none = torch.zeros_like(new)
            values = None if group.form == "plain" else torch.cat([group.values, values_of(new, group.form)])
            group.parameters = torch.cat([group.parameters, new])
            group.first, group.second = (torch.cat([t, none]) for t in (group.first, group.second))
            group.values = group.parameters if values is None else values
        none = torch.zeros(len(rows), dtype=torch.int32, device=self.steps.device)
        self.steps, self.skipped = torch.cat([self.steps, none]), torch.cat([self.skipped, none])

    def assign(self, rows: Tensor, changed: Mapping[str, Tensor]) -> None:
        """Other parameters for these rows, which have then taken no step."""
        for name, group in self.groups.items():
            if name in changed:
                group.parameters[rows] = changed[name]
                if group.form != "plain":
                    group.values[rows] = values_of(changed[name], group.form)
            group.first[rows] = 0.0
            group.second[rows] = 0.0
        self.steps[rows] = 0
        self.skipped[rows] = 0

    def state(self) -> dict[str, Tensor]:
        """Everything as tensors by name."""
        named = {"steps": self.steps, "skipped": self.skipped}
        for name, group in self.groups.items():
            named |= {f"{name}.{part}": getattr(group, part) for part in ("parameters", "first", "second", "values")}
        return named

    @classmethod
    def restored(cls, state: Mapping[str, Tensor]) -> Model:
        """What `state` returned."""
        groups = {}
        for name, form in FORMS.items():
            parameters, first, second, values = (
                state[f"{name}.{part}"] for part in ("parameters", "first", "second", "values")
            )
            groups[name] = Group(parameters, parameters if form == "plain" else values, first, second, form)
        return cls(groups, state["steps"], state["skipped"])
