"""How much a view is worth: less, the less the lifted features of all views agree with its map."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from statistics import median

from torch import Tensor

from sgwarp.lifting.map_reader import MapReader
from sgwarp.lifting.residuals import residual
from sgwarp.scene import View

POWER = 2.0
LEAST = 0.01  # of a view's weight that is left to it


def view_reliabilities(reader: MapReader, views: Sequence[View], features: Tensor, weight: Tensor) -> dict[str, float]:
    """Weight of each view by stem, in (0, 1]: (median residual / its residual)^2, at most 1.

    The residual is that of the view's map against the features rendered into it, see `residual`.

    Args:
        reader: Of the maps.
        views: That were lifted.
        features: Sums of lifted features over all of them, float32 [N, C].
        weight: What they are to be divided by, float32 [N].
    """
    errors: dict[str, float] = {}
    for view in views:
        found = reader.read(view)
        if found is not None:
            with reader.log.stage("reliability"):
                errors[view.stem] = residual(reader.gaussians, view.camera, found, features, weight, reader.settings)
    return from_residuals(errors)


def from_residuals(errors: Mapping[str, float]) -> dict[str, float]:
    """`view_reliabilities` from the residuals; a view without one counts in full."""
    known = [error for error in errors.values() if math.isfinite(error)]
    usual = median(known) if known else 0.0

    def worth(error: float) -> float:
        return 1.0 if not error > usual else max(LEAST, (usual / error) ** POWER)

    return {stem: worth(error) for stem, error in errors.items()}
