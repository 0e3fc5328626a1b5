"""How well an edit stayed with its object: what changed outside of it, and what did not change inside."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from sgwarp.errors import InputError

VISIBLE = 0.04  # least change of a channel that counts, of 1


@dataclass(frozen=True)
class EditFigures:
    """Shares of pixels.

    Attributes:
        leakage: Changed pixels outside the object, over the pixels of the object.
        completeness: Changed pixels inside it, over the pixels of the object.
    """

    leakage: float
    completeness: float


def measure_edit(before: Tensor, after: Tensor, mask: Tensor) -> EditFigures:
    """Compare a view before and after an edit.

    Args:
        before, after: float32 [H, W, 3] in [0, 1].
        mask: The object's true pixels, bool [H, W]. For an operation that moves it, where it was and where it went.

    Raises:
        InputError: Shapes differ, or the mask is empty.
    """
    if before.shape != after.shape or mask.shape != before.shape[:2]:
        shapes = f"{list(before.shape)}, {list(after.shape)} and {list(mask.shape)}"
        raise InputError(f"expected two pictures [H, W, 3] and a mask [H, W], got {shapes}")
    if not bool(mask.any()):
        raise InputError("the mask is empty: the view does not show the object")
    changed = ((before.clamp(0, 1) - after.clamp(0, 1)).abs() > VISIBLE).any(dim=2)
    size = float(mask.sum())
    return EditFigures(float((changed & ~mask).sum()) / size, float((changed & mask).sum()) / size)
