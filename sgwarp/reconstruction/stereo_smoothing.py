"""Costs of a plane sweep, made to agree with what neighboring pixels say (semi-global matching, Hirschmueller 2008).

In an even surface every depth fits as well. Along lines through the image the least cost of a depth takes in that of
the pixels before it, where a step to another depth costs something: depth crosses what is even from its border.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

STEP, JUMP = 0.1, 0.6  # cost of a step to the next plane, and of one to any other


def smoothed(costs: Array) -> Array:
    """Costs summed over the lines from the left, the right, above and below, float32 [D, h, w].

    Args:
        costs: Of each plane, float32 [D, h, w], finite.
    """
    total = np.zeros_like(costs)
    for axis in (1, 2):
        lines = np.ascontiguousarray(np.moveaxis(costs, axis, 0))  # [length, D, others]
        along = _gathered(lines) + _gathered(lines[::-1])[::-1]
        total += np.moveaxis(along, 0, axis)
    return total


def _gathered(lines: Array) -> Array:
    """Least cost of ways that begin anywhere before and end at each place, [length, D, others]."""
    found = np.empty_like(lines)
    found[0] = lines[0]
    for place in range(1, len(lines)):
        before = found[place - 1]
        least = before.min(axis=0)
        best = np.minimum(before, least + JUMP)
        np.minimum(best[1:], before[:-1] + STEP, out=best[1:])
        np.minimum(best[:-1], before[1:] + STEP, out=best[:-1])
        found[place] = lines[place] + best - least
    return found
