"""Pictures for people: class colours with a legend, heat maps, depth. All are uint8 [H, W, 3] numpy arrays, RGB."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]

GOLDEN_RATIO = 0.618033988749895
SHADES = ((0.85, 0.95), (0.9, 0.6), (0.55, 0.7))  # saturation and value in turn: 20 classes differ by 64 of 255
LINE = 22  # height of a legend's line [pixels]
UNKNOWN_DIMMING = 0.35  # brightness of pixels about which nothing is known


def class_colours(count: int) -> Picture:
    """Well separated colours, uint8 [count, 3]; a class keeps its colour when others are appended."""
    rows = []
    for index in range(count):
        hue = (0.05 + index * GOLDEN_RATIO) % 1.0
        saturation, value = SHADES[index % len(SHADES)]
        rows.append([round(255 * channel) for channel in colorsys.hsv_to_rgb(hue, saturation, value)])
    return np.array(rows, dtype=np.uint8).reshape(-1, 3)


def to_picture(image: Any) -> Picture:
    """Float [H, W, 3] in [0, 1] (clipped) or uint8, array or tensor, as uint8."""
    pixels = np.asarray(image.detach().cpu() if hasattr(image, "detach") else image)
    if pixels.dtype == np.uint8:
        return pixels
    shares = np.fmax(pixels, 0.0)  # a copy, for what follows is in place; NaN becomes 0
    np.fmin(shares, 1.0, out=shares)
    shares *= 255.0
    shares += 0.5
    return shares.astype(np.uint8)


def overlay(image: Any, channel: Any, colours: Picture, strength: float = 0.6) -> Picture:
    """Class colours over a photograph; pixels of no class turn into a dim grey.

    Args:
        image: The photograph, [H, W, 3].
        channel: Row of `colours` per pixel, anything outside them is unknown, integers [H, W].
        colours: uint8 [Q, 3].
        strength: Share of the class colour, 0 to 1.
    """
    picture, index = to_picture(image).astype(np.float32), np.asarray(channel)
    known = (index >= 0) & (index < len(colours))
    result = np.repeat(picture.mean(axis=2, keepdims=True) * UNKNOWN_DIMMING, 3, axis=2)
    result[known] = (1 - strength) * picture[known] + strength * colours[index[known]]
    return (result + 0.5).astype(np.uint8)


def with_legend(picture: Picture, names: Sequence[str], colours: Picture) -> Picture:
    """The picture with the names of its classes in their colours on the right."""
    import cv2

    font, size = cv2.FONT_HERSHEY_SIMPLEX, 0.45
    width = 40 + max((cv2.getTextSize(name, font, size, 1)[0][0] for name in names), default=0)
    height = max(len(picture), LINE * len(names) + 8)
    legend = np.full((height, width, 3), 255, dtype=np.uint8)
    for row, (name, colour) in enumerate(zip(names, colours, strict=False)):
        top = 4 + row * LINE
        cv2.rectangle(legend, (8, top + 4), (24, top + LINE - 4), [int(c) for c in colour], -1)
        cv2.putText(legend, name, (32, top + LINE - 7), font, size, (0, 0, 0), 1, cv2.LINE_AA)
    padded = np.full((height, picture.shape[1], 3), 255, dtype=np.uint8)
    padded[: len(picture)] = picture
    return np.concatenate([padded, legend], axis=1)


def heat_map(image: Any, scores: Any, low: float | None = None, high: float | None = None) -> Picture:
    """Scores over a photograph, from transparent blue (`low`) to strong red (`high`).

    Args:
        image: The photograph, [H, W, 3].
        scores: [H, W]; pixels that are not finite are unknown and turn into a dim grey.
        low, high: Ends of the colour scale; the smallest and largest score in the picture if None.
    """
    import cv2

    picture = to_picture(image).astype(np.float32)
    values = np.asarray(scores.detach().cpu() if hasattr(scores, "detach") else scores, dtype=np.float32)
    known = np.isfinite(values)
    share = _between(values, known, low, high)
    colours = cv2.applyColorMap((share * 255).astype(np.uint8), cv2.COLORMAP_TURBO)[:, :, ::-1]
    strength = (0.25 + 0.6 * share)[..., None]
    mixed = (1 - strength) * picture + strength * colours
    grey = np.repeat(picture.mean(axis=2, keepdims=True) * UNKNOWN_DIMMING, 3, axis=2)
    return (np.where(known[..., None], mixed, grey) + 0.5).astype(np.uint8)


def mark_pixel(picture: Picture, pixel: tuple[int, int]) -> Picture:
    """A copy of the picture with a cross-hair at pixel (x, y)."""
    import cv2

    marked = picture.copy()
    for colour, thickness in (((0, 0, 0), 3), ((255, 255, 255), 1)):
        cv2.drawMarker(marked, pixel, colour, cv2.MARKER_CROSS, 21, thickness)
    return marked


def depth_picture(depth: Any) -> Picture:
    """Depth [H, W] from near (red) to far (blue); black where there is no surface (depth 0)."""
    import cv2

    values = np.asarray(depth.detach().cpu() if hasattr(depth, "detach") else depth, dtype=np.float32)
    hit = np.isfinite(values) & (values > 0)
    nearness = 1.0 - _between(values, hit, None, None)
    colours = cv2.applyColorMap((nearness * 255).astype(np.uint8), cv2.COLORMAP_TURBO)[:, :, ::-1]
    return np.where(hit[..., None], colours, 0).astype(np.uint8)


def _between(values: NDArray[np.float32], known: NDArray[np.bool_], low: float | None, high: float | None) -> Any:
    """Position of each value between low (0) and high (1), clipped; 0 where not known."""
    if not known.any():
        return np.zeros_like(values)
    low = float(values[known].min()) if low is None else low
    high = float(values[known].max()) if high is None else high
    span = high - low if high > low else 1.0
    return ((np.where(known, values, low) - low) / span).clip(0.0, 1.0)
