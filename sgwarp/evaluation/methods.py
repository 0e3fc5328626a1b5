"""What can be compared on one scene: the lift modes, and rivals that start from the same scene, views and 2D maps.

The list is the one place where a method is named: `sgwarp evaluate --method` and `--ablate modes` go through it. A new
lift mode is there by itself. A rival is one entry of RIVALS with the function that makes it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any, Literal, Protocol, get_args

from sgwarp.errors import InputError
from sgwarp.lifting.lifter import LiftMode, Maps
from sgwarp.runs.log import RunLog
from sgwarp.runs.progress import Report
from sgwarp.scene import Gaussians, Semantics, View

Kind = Literal["mode", "rival", "images"]
METHOD_KINDS: tuple[str, ...] = get_args(Kind)

ABOUT_MODES = {
    "weighted": "all pixels a Gaussian contributes to, by its weight there",
    "center": "the pixel of its center, with a depth test (the paper)",
    "squared": "as weighted, with squared weights",
    "strongest": "only pixels where it contributes most (as OpenGaussian, Dr. Splat, LightSplat vote)",
    "robust": "geometric median of the views",
    "solve": "what renders best to the maps, near the weighted mean",
}


class Lifting(Protocol):
    """Semantics of a scene's Gaussians out of 2D maps of its views; stages, seconds and figures go to the log."""

    def __call__(
        self,
        gaussians: Gaussians,
        views: Sequence[View],
        maps: Maps,
        *,
        log: RunLog | None = None,
        progress: Report | None = None,
    ) -> Semantics: ...


@dataclass(frozen=True)
class Method:
    """One way to semantics.

    Attributes:
        name: As on the command line and in tables.
        about: One line.
        kind: "mode" of `lift`, "rival", or "images": the 2D maps of the asked views themselves, without any scene.
        make: "module:function" of a rival, a `Lifting`; imported when it is used.
        options: Further arguments of that function.
    """

    name: str
    about: str
    kind: Kind = "rival"
    make: str = ""
    options: Mapping[str, Any] = field(default_factory=dict)

    def lifting(self) -> Lifting:
        """The function that lifts.

        Raises:
            InputError: The method lifts nothing.
        """
        if self.kind == "images":
            raise InputError(f"method '{self.name}' answers from single views; it lifts nothing into the scene")
        module, _, name = self.make.partition(":")
        function: Callable[..., Semantics] = getattr(import_module(module), name)

        def call(
            gaussians: Gaussians,
            views: Sequence[View],
            maps: Maps,
            *,
            log: RunLog | None = None,
            progress: Report | None = None,
        ) -> Semantics:
            return function(gaussians, views, maps, log=log, progress=progress, **self.options)

        return call


IMAGES = Method("2d", "the 2D encoder alone, on the asked view itself", "images")
FIT = "sgwarp.evaluation.rivals.optimization:fit_features"
RIVALS: tuple[Method, ...] = (
    Method(
        "nearest",
        "features fused on points, and of each Gaussian those of its nearest point (OpenScene)",
        make="sgwarp.evaluation.rivals.nearest_points:fuse_nearest_points",
    ),
    Method("fitted", "gradient descent on all channels (Feature 3DGS)", make=FIT),
    Method(
        "fitted-low", "gradient descent on 16 channels and a decoder (Feature 3DGS)", make=FIT, options={"channels": 16}
    ),
)


def list_methods() -> tuple[Method, ...]:
    """Every method: the lift modes, the rivals, and the 2D encoder alone."""
    modes = (
        Method(mode, ABOUT_MODES.get(mode, f"lift mode {mode}"), "mode", "sgwarp.lifting.lifter:lift", {"mode": mode})
        for mode in get_args(LiftMode)
    )
    return (*modes, *RIVALS, IMAGES)


def find_method(name: str) -> Method:
    """The method of a name.

    Raises:
        InputError: There is none.
    """
    found = {method.name: method for method in list_methods()}
    if name not in found:
        raise InputError(f"method '{name}' does not exist; there are {', '.join(found)}")
    return found[name]
