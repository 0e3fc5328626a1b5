"""The ensemble of projected and predicted scores (paper, Sec. III-D)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, get_args

import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.scene import Semantics
from sgwarp.scene.semantics import require_together

Ensemble = Literal["2d", "3d", "max", "sum", "mean"]


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


def score_together(
    score: Callable[[Semantics], Tensor], projected: Semantics, predicted: Semantics | None, how: Ensemble = "max"
) -> Tensor:
    """Scores of the projected semantics, or of both as one, [N, Q].

    Args:
        score: Scores of one of them, [N, Q].
        projected: Lifted from views.
        predicted: By the network, for the same Gaussians; None if there are none.
        how: See `combine`.

    Raises:
        InputError: The two belong to different scenes or spaces, or an unknown ensemble.
    """
    if predicted is None:
        return score(projected)
    require_together(projected, predicted)
    return combine(score(projected), score(predicted), (projected.seen, predicted.seen), how)
