"""The render plan: stages that a rendering runs, and stages that scene and request do not need."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.scene import Gaussians

Values = Literal["colors", "features", "nothing"]


@dataclass(frozen=True)
class RenderPlan:
    """The kernels that a rendering runs; `print(plan)` lists them. `plan_render` derives it.

    Leaving out never changes what was asked for: the same image comes out bit for bit, only sooner.

    Attributes:
        values: What is composited: the scene's colours, features, or nothing (opacity and depth need none).
        sh_degree: Spherical harmonics are evaluated up to this degree; 0 where no colours are composited.
        channels: Of the image.
        depth: Whether depths are composited too.
        record: Whether what a backward pass starts from is written down.
        left_out: What is not computed, and how much of it: "harmonics" [coefficients per Gaussian], "colors"
            [channels], "depth" and "record" [images].
    """

    values: Values
    sh_degree: int
    channels: int
    depth: bool
    record: bool
    left_out: tuple[tuple[str, int], ...]

    @property
    def colored(self) -> int | None:
        """Up to which degree colours of harmonics are composited; None if none are."""
        return self.sh_degree if self.values == "colors" else None

    def __str__(self) -> str:
        what = {
            "colors": f"colours, harmonics of degree {self.sh_degree}",
            "features": f"{self.channels} feature channel{'s' * (self.channels > 1)}",
            "nothing": "opacity alone",
        }[self.values]
        done = [f"composite {what}"]
        done += ["depth"] * self.depth + ["what gradients start from"] * self.record
        reasons = {
            "harmonics": "{} coefficients per Gaussian, zero in the whole scene",
            "colors": "{} colour channels, which nobody asked for",
            "depth": "{} depth images, which nobody asked for",
            "record": "{} images that only gradients need",
        }
        skipped = [reasons[name].format(amount) for name, amount in self.left_out]
        return f"{', '.join(done)}; left out: {'; '.join(skipped) or 'nothing'}"


def plan_render(
    gaussians: Gaussians,
    values: Values = "colors",
    *,
    channels: int = 3,
    depth: bool = False,
    record: bool = False,
    settings: RasterSettings = RasterSettings(),  # noqa: B008 - frozen
    look: bool = True,
) -> RenderPlan:
    """Derive the plan of a rendering from the scene and the request.

    Args:
        gaussians: The scene.
        values: What is to be composited.
        channels: How many of them.
        depth: Whether depths are wanted.
        record: Whether gradients are wanted.
        settings: Its `sh_degree` bounds the degree.
        look: Look for coefficients that are zero everywhere, once per scene. Without it every degree counts as used:
            for scenes that change with every call, where looking costs more than it may save.
    """
    stored = gaussians.sh_degree if settings.sh_degree is None else min(gaussians.sh_degree, settings.sh_degree)
    degree = 0
    left_out = {}
    if values == "colors":
        degree = min(stored, gaussians.used_sh_degree) if look else stored
        left_out["harmonics"] = (stored + 1) ** 2 - (degree + 1) ** 2
    left_out["colors"] = 3 * (values == "nothing")
    left_out["depth"] = 2 * (not depth)
    left_out["record"] = (2 if depth else 1) * (not record)
    kept = tuple((name, amount) for name, amount in left_out.items() if amount)
    return RenderPlan(values, degree, 0 if values == "nothing" else channels, depth, record, kept)
