"""What the colors of a picture mean, and what is missing for it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sgwarp.scene import InstanceMap
from sgwarp.viewer.modes import BELOW, Mode
from sgwarp.viewer.questions import Answers
from sgwarp.visualization.pictures import class_colours

Row = tuple[str, str]  # a name and its color, #rrggbb
LISTED = 32  # instances


def legend(mode: Mode, answers: Answers | None, instances: InstanceMap | None = None, level: str = "") -> list[Row]:
    """Names and colors of what a picture shows.

    Args:
        mode: Kind of picture.
        answers: To what was asked, or None.
        instances: Of the scene.
        level: Of the instances that are shown; empty for the coarsest.
    """
    if mode == "depth":
        return [("near", _turbo(1.0)), ("far", _turbo(0.0)), ("no surface", "#000000")]
    if mode == "opacity":
        return [("opaque", "#ffffff"), ("nothing", "#000000")]
    if mode == "coverage":
        return _named(
            ("no view", "one view", "8 views or more"), np.array([(255, 0, 255), (230, 38, 26), (26, 191, 51)])
        )
    if mode == "instances" and instances is not None:
        return _objects(instances, level or instances.levels[-1])
    if answers is None or mode not in ("relevancy", "segmentation"):
        return []
    unknown = answers.unknown
    names = [f"{name} (unknown to the encoder)" if name in unknown else name for name in answers.questions.queries]
    if mode == "segmentation":
        return [*_named(names, answers.questions.colors), ("none of these", "#555555")]
    if len(names) > 1:
        dark = round(255 * BELOW)
        below = "#" + 3 * f"{dark:02x}"
        return [*_named(names, answers.questions.colors), ("below the threshold", below)]
    scale = [(f"{names[0]}: 1, as its best thousandth", _turbo(1.0)), ("0.5", _turbo(0.5))]
    return [*scale, ("0, as the scene's median", _turbo(0.0)), ("threshold (line)", "#ffffff")]


def missing(mode: Mode, answers: Answers | None) -> str:
    """What to do so that the mode shows more than the scene's own colors; empty if nothing is missing."""
    if answers is None and mode in ("relevancy", "segmentation"):
        return f"Nothing was asked yet: write a query, and {mode} is shown."
    return ""


def _objects(instances: InstanceMap, level: str) -> list[Row]:
    colors = class_colours(len(instances.table))
    rows = [one for one in instances.table if one.level == level][: LISTED + 1]
    found = [(one.label or f"object {one.id}", _hex(colors[one.id - 1])) for one in rows[:LISTED]]
    return found if len(rows) <= LISTED else [*found, ("and more", "#00000000")]


def _named(names: Sequence[str], colors: Any) -> list[Row]:
    return [(name, _hex(color)) for name, color in zip(names, colors, strict=False)]


def _hex(color: Any) -> str:
    return "#{:02x}{:02x}{:02x}".format(*map(int, color))


def _turbo(share: float) -> str:
    """The color of a heat map."""
    import cv2

    blue, green, red = cv2.applyColorMap(np.array([[round(255 * share)]], np.uint8), cv2.COLORMAP_TURBO)[0, 0]
    return _hex((red, green, blue))
