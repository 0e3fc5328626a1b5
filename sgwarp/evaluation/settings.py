"""What an evaluation may vary; a scene's results belong to one set of these."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, Literal

from sgwarp.encoders.calibration import Scoring
from sgwarp.errors import InputError
from sgwarp.querying.ensembles import Ensemble

Views = Literal["released", "strict"]


@dataclass(frozen=True)
class Settings:
    """Choices of one evaluation. In names of files, {scene} is the scene's name and {path} its folder.

    Attributes:
        encoder: As of `sgwarp lift`, or "truth": the label images of the data set, with "?noise=0.15" a share of their
            regions wrong. {level} stands for each of `levels`, which are lifted one by one.
        levels: Of the encoder; none for an encoder that is lifted once.
        method: Of `evaluation.methods`.
        gaussians: The trained scenes; those that lie with the data, or made of depth images, if empty.
        semantics: Lifted before, by `sgwarp lift`; then nothing is lifted.
        predicted: By `sgwarp predict`, asked together with the lifted semantics.
        ensemble: How the two become one.
        scoring: Of classes, see `class_votes`; what the encoder is calibrated for if None.
        classes: Names to ask for, where the data set names none.
        threshold: Of `score_texts`, above which a Gaussian is selected.
        views: "strict" never lifts from views that are scored; "released" lifts all, as the published scripts do.
        hold_out: Every so many views is kept for scoring, where the data set does not say which.
        every: Lift every so many of the training views.
        share_of_views: Lift from this share of them.
        share_of_gaussians: Keep this share, at random, and enlarge what is kept so that surfaces stay closed.
        count: Gaussians made of depth images.
        forgetting: Of moving scenes, weight of the past after one more frame; 0 takes every frame alone.
        sheets: Views to draw per scene.
        seed: Of noise and shares.
        device: Where to compute.
        cache: Folder of feature maps; None for no cache.
    """

    encoder: str = "conse"
    levels: tuple[str, ...] = ()
    method: str = "weighted"
    gaussians: str = ""
    semantics: str = ""
    predicted: str = ""
    ensemble: Ensemble = "max"
    scoring: Scoring | None = None
    classes: tuple[str, ...] = ()
    threshold: float = 0.5
    views: Views = "strict"
    hold_out: int = 8
    every: int = 1
    share_of_views: float = 1.0
    share_of_gaussians: float = 1.0
    count: int = 100_000
    forgetting: float = 0.9
    sheets: int = 3
    seed: int = 0
    device: str = "cpu"
    cache: str | None = None

    def __post_init__(self) -> None:
        for name in ("share_of_views", "share_of_gaussians"):
            if not 0 < getattr(self, name) <= 1:
                raise InputError(f"{name}: expected a share in (0, 1], got {getattr(self, name)}")
        for name, least in (("hold_out", 2), ("every", 1), ("count", 1), ("sheets", 0)):
            if getattr(self, name) < least:
                raise InputError(f"{name}: expected {least} or more, got {getattr(self, name)}")
        if not math.isfinite(self.threshold):
            raise InputError(f"threshold: expected a finite number, got {self.threshold}")
        if not 0 <= self.forgetting <= 1:
            raise InputError(f"forgetting: expected 0 to 1, got {self.forgetting}")
        if bool(self.levels) != ("{level}" in self.encoder):
            raise InputError("levels: go together with {level} in the name of the encoder; give both or none")

    @property
    def identity(self) -> dict[str, Any]:
        """What a scene's results depend on: all but where they are computed and kept."""
        chosen = asdict(self)
        del chosen["device"], chosen["cache"]
        return chosen | {"levels": list(self.levels), "classes": list(self.classes)}
