"""The semantic component of a scene."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.scene.checks import as_tensor, float32, require, require_finite
from sgwarp.scene.gaussians import Gaussians


@dataclass(frozen=True, eq=False)
class Semantics:
    """The semantic component of a scene's Gaussians.

    Attributes:
        features: Mean of the lifted features, float32 or float16 [N, C]; zero where nothing was seen.
        weight: Sum of alpha T (weighted) or number of views (center) behind each feature, float32 [N].
        effective_views: (sum_v w)^2 / sum_v w^2, how many views share that weight, float32 [N].
        space: Name of the embedding space.
        fingerprint: `Gaussians.fingerprint` of the scene.
        labels: Names of the channels if the features are one-hot lifted ids, else None.
    """

    features: Tensor
    weight: Tensor
    effective_views: Tensor
    space: str
    fingerprint: str
    labels: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        put = object.__setattr__
        features = as_tensor(self.features)
        ok = features.ndim == 2 and features.is_floating_point()
        require(ok, f"features: expected floating point [N, C], got {features.dtype} {list(features.shape)}")
        put(self, "features", features)
        n = len(features)
        put(self, "weight", float32("weight", self.weight, (n,)))
        put(self, "effective_views", float32("effective_views", self.effective_views, (n,)))
        require_finite("weight", self.weight)
        require_finite("effective_views", self.effective_views)
        require(bool(self.space), "space: must name the embedding space")
        if self.labels is not None:
            named, channels = len(self.labels), features.shape[1]
            require(named == channels, f"labels: expected {channels}, got {named}")

    def __len__(self) -> int:
        return len(self.features)

    @property
    def seen(self) -> Tensor:
        """Gaussians that at least one view saw, bool [N]."""
        return self.weight > 0

    @property
    def coverage(self) -> float:
        """Share of the Gaussians that at least one view saw."""
        return float(self.seen.float().mean()) if len(self) else 0.0

    def without_faint(self, min_weight: float) -> Semantics:
        """The same with Gaussians of a smaller weight taken for unseen.

        Raises:
            InputError: `min_weight` is negative or not finite.
        """
        require(0 <= min_weight < math.inf, f"min_weight: expected a finite number from 0 on, got {min_weight}")
        if min_weight == 0:
            return self
        return replace(self, weight=torch.where(self.weight >= min_weight, self.weight, 0.0))

    def require_scene(self, gaussians: Gaussians) -> None:
        """Raise InputError if these features belong to another scene."""
        require(
            self.fingerprint == gaussians.fingerprint,
            f"semantics belong to scene {self.fingerprint}, this scene is {gaussians.fingerprint}; lift it again",
        )

    def require_space(self, space: str) -> None:
        """Raise InputError if a query or feature map lives in another space."""
        require(self.space == space, f"space '{space}' cannot be compared with semantics in space '{self.space}'")


def require_together(projected: Semantics, predicted: Semantics) -> None:
    """Raise InputError unless both belong to one scene, one space and one list of labels."""
    for name in ("fingerprint", "space", "labels"):
        mine, other = getattr(projected, name), getattr(predicted, name)
        if mine != other:
            raise InputError(f"projected semantics have {name} {mine!r}, the predicted ones {other!r}; they must agree")
    if projected.features.shape != predicted.features.shape:
        shapes = f"{list(projected.features.shape)} and {list(predicted.features.shape)}"
        raise InputError(f"projected and predicted features differ in shape: {shapes}")
