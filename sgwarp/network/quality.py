"""Coverage of a scene by the projection, and whether the network is needed at all."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch

from sgwarp.scene import Semantics
from sgwarp.scene.semantics import require_together

TWO_VIEWS = 1.5  # effective views from which on a feature rests on more than one view


class ProjectionQuality(NamedTuple):
    """Coverage and reliability of lifted semantics.

    Attributes:
        coverage: Share of the Gaussians that some view saw.
        reliability: Share of those whose feature rests on more than one view.
    """

    coverage: float
    reliability: float

    def suffices(self, coverage: float = 0.98, reliability: float = 0.8) -> bool:
        """Whether the scene can do without the network."""
        return self.coverage >= coverage and self.reliability >= reliability


def projection_quality(semantics: Semantics) -> ProjectionQuality:
    """Coverage and reliability of lifted semantics; both are 0 if nothing was seen."""
    views = semantics.effective_views[semantics.seen]
    reliable = float((views >= TWO_VIEWS).float().mean()) if len(views) else 0.0
    return ProjectionQuality(semantics.coverage, reliable)


def filled(projected: Semantics, predicted: Semantics) -> Semantics:
    """The projection where a view saw a Gaussian, the prediction elsewhere.

    A predicted feature gets the median weight of the projected ones, so that neither outweighs the other.

    Raises:
        InputError: The two belong to different scenes, spaces or labels.
    """
    require_together(projected, predicted)
    seen = projected.seen
    from_network = ~seen & predicted.seen
    usual = projected.weight[seen].median() if bool(seen.any()) else projected.weight.new_ones(())
    return replace(
        projected,
        features=torch.where(
            from_network[:, None], predicted.features.to(projected.features.dtype), projected.features
        ),
        weight=torch.where(from_network, usual, projected.weight),
    )
