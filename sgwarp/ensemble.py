"""Projected and predicted semantics together: the ensemble of their scores, and who needs the network at all."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, NamedTuple, get_args

import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.scene import Semantics

Ensemble = Literal["2d", "3d", "max", "sum", "mean"]
TWO_VIEWS = 1.5  # effective views from which on a feature rests on more than one view


def combine(projected: Tensor, predicted: Tensor, seen: tuple[Tensor, Tensor], how: Ensemble = "max") -> Tensor:
    """Scores of the projection and of the network as one, [N, Q].

    "2d" and "3d" take one of them alone; "max" the larger (the paper), "sum" their sum (its release), "mean" its half.
    Where only one of them knows a Gaussian it speaks for both; 0 where neither does.

    Args:
        projected, predicted: Scores, [N, Q].
        seen: Gaussians that the one and the other know, bool [N] each.
        how: See above.

    Raises:
        InputError: Unknown ensemble.
    """
    if how not in get_args(Ensemble):
        raise InputError(f"ensemble: '{how}' is not one of {', '.join(get_args(Ensemble))}")
    by_2d, by_3d = (mask.to(projected.device)[:, None] for mask in seen)
    if how == "2d":
        return torch.where(by_2d, projected, 0.0)
    if how == "3d":
        return torch.where(by_3d, predicted, 0.0)
    first = torch.where(by_2d, projected, predicted)
    second = torch.where(by_3d, predicted, projected)
    both = torch.maximum(first, second) if how == "max" else first + second
    return torch.where(by_2d | by_3d, both / 2 if how == "mean" else both, 0.0)


def seen_by(projected: Semantics, predicted: Semantics | None, how: Ensemble = "max") -> Tensor:
    """Gaussians that the ensemble has a score for, bool [N]."""
    if predicted is None or how == "2d":
        return projected.seen
    return predicted.seen if how == "3d" else projected.seen | predicted.seen


class ProjectionQuality(NamedTuple):
    """How much of a scene the projection knows.

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


def require_together(projected: Semantics, predicted: Semantics) -> None:
    """Raise InputError unless both belong to one scene, one space and one list of labels."""
    for name in ("fingerprint", "space", "labels"):
        mine, other = getattr(projected, name), getattr(predicted, name)
        if mine != other:
            raise InputError(f"projected semantics have {name} {mine!r}, the predicted ones {other!r}; they must agree")
    if projected.features.shape != predicted.features.shape:
        shapes = f"{list(projected.features.shape)} and {list(predicted.features.shape)}"
        raise InputError(f"projected and predicted features differ in shape: {shapes}")
