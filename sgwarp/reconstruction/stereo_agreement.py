"""How well a photograph and its warped neighbors agree, window by window."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

WINDOW = 5  # that is compared [pixels]
NOISE = 2e-3  # deviation of brightness that counts as even, in [0, 1]
EVEN_WEIGHT = 3.0  # of the difference of brightness, beside 1 - correlation
UNSEEN = 2.0  # cost where fewer than two neighbors see a pixel


def difference(image: Array, warped: Array) -> Array:
    """Of the windows around each pixel, float32 [h, w]; infinite where one reaches beyond what was warped."""
    import cv2

    size = (WINDOW, WINDOW)
    mean, its_mean = cv2.blur(image, size), cv2.blur(warped, size)
    spread = cv2.blur(image * image, size) - mean * mean
    its_spread = cv2.blur(warped * warped, size) - its_mean * its_mean
    joint = cv2.blur(warped * image, size) - its_mean * mean
    scale = np.sqrt((spread + NOISE**2).clip(NOISE**2) * (its_spread + NOISE**2).clip(NOISE**2))
    cost = 1.0 - joint / scale + EVEN_WEIGHT * np.abs(its_mean - mean)
    cost[its_mean < 0] = np.inf
    return np.asarray(cost, np.float32)


def together(costs: Array) -> Array:
    """Mean over the better half of the neighbors that show a pixel, float32 [D, h, w] of [n, D, h, w]."""
    count = len(costs)
    seen = np.isfinite(costs).sum(axis=0)
    half = np.maximum((seen + 1) // 2, 1)
    costs.sort(axis=0)
    within = np.arange(count)[:, None, None, None] < half
    total = np.where(within & np.isfinite(costs), costs, 0).sum(axis=0) / half
    return np.where(seen >= min(2, count), total, np.float32(UNSEEN))


def least(costs: Array) -> Array:
    """Place of the least cost, from the middle one, between two by a parabola, float32 [h, w]."""
    count = len(costs)
    place = costs.argmin(axis=0).clip(1, count - 2)
    before, at, after = (np.take_along_axis(costs, (place + step)[None], axis=0)[0] for step in (-1, 0, 1))
    bend = before - 2 * at + after
    offset = np.where(bend > 1e-6, 0.5 * (before - after) / np.where(bend > 1e-6, bend, 1), 0).clip(-0.5, 0.5)
    return (place + offset - count // 2).astype(np.float32)
