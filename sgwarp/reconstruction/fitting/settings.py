"""Settings of a fit; the defaults are those of the 3DGS reference implementation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

from sgwarp.errors import InputError

Strategy = Literal["default", "mcmc"]
Background = Literal["black", "white", "random"]
REFERENCE_STEPS = 30_000  # to which the reference implementations state their schedules


@dataclass(frozen=True)
class FitSettings:
    """Settings of a fit.

    Rates and thresholds are those of the 3DGS reference implementation (Kerbl et al. 2023), and for `mcmc` those of
    Kheradmand et al. 2024 as gsplat has them. Both state their schedules for 30,000 steps; here they shrink in
    proportion to `steps`, except the interval of refinement and that of the degree of the colours.

    Attributes:
        steps: How many photographs are looked at.
        strategy: "default" clones and splits Gaussians whose projection the loss wants to move, removes transparent
            ones and resets opacities; "mcmc" moves transparent Gaussians to where opaque ones are, adds noise, and
            grows by 5 % at a time up to the cap.
        cap: Never more Gaussians than this.
        sh_degree: Highest degree of the view-dependent colours, 0 to 3; it rises by one every `degree_every` steps.
        background: Behind the scene while fitting: "random" keeps it from showing through the scene.
        similarity_share: Weight of D-SSIM in the loss, the rest is L1.
        sparse: Update only the Gaussians that a step's view has seen.
        exposure: Also fit an affine map of the colours for every photograph.
        refine_poses: Also fit a small rigid motion of every camera.
        refine_held_out: Also measure with the poses of held-out views fitted to the finished scene.
        seed: Of everything random.
        evaluate_every: Steps between two measurements on the held-out views.
        refine_every: Steps between two refinements of the set of Gaussians.
        means_rate, last_means_rate: Rates of the centres at the first and the last step [1 / extent of the cameras].
        scales_rate, quats_rate, opacities_rate, colors_rate: Rates; coefficients beyond degree 0 have a 20th.
        grow_gradient: "default" grows where the mean gradient of the projected centre is larger [1 / half image].
        split_scale: "default" splits what is larger and clones what is smaller [1 / extent].
        least_opacity: What is more transparent is removed ("default") or moved ("mcmc").
        noise: Of "mcmc", in rates of the centres.
        opacity_pull, scale_pull: Of "mcmc", weights of the mean opacity and the mean scale in the loss.
    """

    steps: int = 10_000
    strategy: Strategy = "mcmc"
    cap: int = 100_000
    sh_degree: int = 3
    background: Background = "black"
    similarity_share: float = 0.2
    sparse: bool = True
    exposure: bool = False
    refine_poses: bool = False
    refine_held_out: bool = False
    seed: int = 0
    evaluate_every: int = 500
    refine_every: int = 100
    degree_every: int = 1000
    means_rate: float = 1.6e-4
    last_means_rate: float = 1.6e-6
    scales_rate: float = 5e-3
    quats_rate: float = 1e-3
    opacities_rate: float = 0.05
    colors_rate: float = 2.5e-3
    grow_gradient: float = 2e-4
    split_scale: float = 0.01
    least_opacity: float = 0.005
    noise: float = 5e5
    opacity_pull: float = 0.01
    scale_pull: float = 0.01

    def __post_init__(self) -> None:
        for name, choices in (("strategy", Strategy), ("background", Background)):
            if getattr(self, name) not in get_args(choices):
                raise InputError(f"{name}: '{getattr(self, name)}' is not one of {', '.join(get_args(choices))}")
        for name in ("steps", "cap", "sh_degree", "seed", "evaluate_every", "refine_every", "degree_every"):
            value = getattr(self, name)
            if not isinstance(value, int):
                raise InputError(f"{name}: expected a whole number, got {value!r}")
            if value < 1 and name not in ("sh_degree", "seed"):
                raise InputError(f"{name}: expected at least 1, got {value}")
        if not 0 <= self.sh_degree <= 3:
            raise InputError(f"sh_degree: expected 0 to 3, got {self.sh_degree}")
        if not 0 <= self.similarity_share <= 1:
            raise InputError(f"similarity_share: expected 0 to 1, got {self.similarity_share}")
        rates = [name for name in self.__dataclass_fields__ if name.endswith(("_rate", "_pull")) or name == "noise"]
        for name in (*rates, "grow_gradient", "split_scale", "least_opacity"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise InputError(f"{name}: expected a number that is not negative, got {getattr(self, name)}")

    def scaled(self, reference_step: int) -> int:
        """The step of this run that corresponds to one of the reference's 30,000."""
        return round(reference_step * self.steps / REFERENCE_STEPS)

    def means_rate_at(self, step: int, extent: float) -> float:
        """Rate of the centres, falling exponentially."""
        if self.means_rate <= 0 or self.last_means_rate <= 0:
            return self.means_rate * extent
        share = step / self.steps
        return extent * math.exp((1 - share) * math.log(self.means_rate) + share * math.log(self.last_means_rate))

    def degree_at(self, step: int) -> int:
        """Degree of the colours; what is above it is neither evaluated nor updated nor stored."""
        return min(self.sh_degree, step // self.degree_every)

    def refines_at(self, step: int, stop: int) -> bool:
        """Whether the set of Gaussians is refined after this step; `stop` is the reference's last such step."""
        return self.scaled(500) < step < self.scaled(stop) and step % self.refine_every == 0
