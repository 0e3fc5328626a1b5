"""What finding instances can be told."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from sgwarp.encoders.base import LEVELS
from sgwarp.errors import InputError
from sgwarp.ops.splatting.settings import RasterSettings

Grouping = Literal["association", "name"]


@dataclass(frozen=True)
class InstanceSettings:
    """Knobs of `instances`.

    Attributes:
        grouping: "association" joins masks that show the same Gaussians; "name" trusts the source's names or ids: those
            of a video tracker, or the part names of a detector.
        levels: Levels of the masks that are joined, each on its own, the finest first, of "default", "s", "m", "l".
        least_iou: Masks, or groups of them, are joined if they share this much of what both views show.
        least_shared: And if two of their masks share at least this much of the smaller one's mass.
        least_cosine: And if the mean features of their Gaussians agree this much; None asks no features.
        samples_per_mask: Gaussians of each mask that association looks at; 0 for all. The error of a share is at most
            1 / (2 sqrt(samples)).
        pixel_weight: A view counts as half an observation of a Gaussian that it shows with this weight [pixels]; much
            less than it is as good as hidden.
        least_confidence: Below it a Gaussian is undecided.
        least_gaussians: Instances with fewer Gaussians are dropped.
        neighbors: Nearest neighbors that refine Gaussians at boundaries; 0 for no refinement.
        candidates: Instances kept per Gaussian.
        raster: Thresholds of the rasterizer.

    Raises:
        InputError: A value is out of range.
    """

    grouping: Grouping = "association"
    levels: tuple[str, ...] = ("default",)
    least_iou: float = 0.3
    least_shared: float = 0.1
    least_cosine: float | None = None
    samples_per_mask: int = 512
    pixel_weight: float = 1.0
    least_confidence: float = 0.55
    least_gaussians: int = 10
    neighbors: int = 8
    candidates: int = 3
    raster: RasterSettings = RasterSettings()  # noqa: RUF009 - frozen

    def __post_init__(self) -> None:
        if self.grouping not in get_args(Grouping):
            raise InputError(f"grouping: '{self.grouping}' is not one of {', '.join(get_args(Grouping))}")
        if not self.levels or len(set(self.levels)) < len(self.levels) or not set(self.levels) <= set(LEVELS):
            raise InputError(f"levels: expected different ones of {', '.join(LEVELS)}, got {self.levels}")
        for name in ("least_iou", "least_shared", "least_confidence"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise InputError(f"{name}: expected a share from 0 to less than 1, got {getattr(self, name)}")
        if self.least_cosine is not None and not -1.0 <= self.least_cosine <= 1.0:
            raise InputError(f"least_cosine: expected a cosine from -1 to 1, got {self.least_cosine}")
        if not 0.0 < self.pixel_weight < float("inf"):
            raise InputError(f"pixel_weight: expected a positive number of pixels, got {self.pixel_weight}")
        for name, least in (("samples_per_mask", 0), ("neighbors", 0), ("least_gaussians", 1), ("candidates", 1)):
            if getattr(self, name) < least:
                raise InputError(f"{name}: expected {least} or more, got {getattr(self, name)}")
