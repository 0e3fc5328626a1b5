"""Sheets: image, truth, ours and error side by side, with a title over each."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sgwarp.files.images import write_rgb
from sgwarp.rendering.renderer import render
from sgwarp.scene import Gaussians, View
from sgwarp.visualization.pictures import Picture, class_colours, heat_map, mark_pixel, overlay, to_picture, with_legend

TITLE = 22  # height of the line above a picture [pixels]
GAP = 6
RIGHT, WRONG, MISSED = (70, 160, 90), (200, 50, 40), (230, 170, 40)


def photograph_of(gaussians: Gaussians, view: View) -> Tensor:
    """The view's photograph, or without one its rendering, float32 [H, W, 3]."""
    if view.image_path is not None:
        return view.image()
    return render(gaussians, view.camera).clamp(0.0, 1.0).cpu()


def draw_labels(path: Path, image: Any, truth: Tensor, ours: Tensor, classes: Sequence[str]) -> None:
    """Image, true classes, ours, and where they differ: green right, red another class, amber unknown, gray not scored.

    Args:
        path: PNG to write.
        image: [H, W, 3].
        truth, ours: Index into the classes, -1 for none, int64 [H, W].
        classes: Names.
    """
    colours = class_colours(len(classes))
    shown = [k for k in range(len(classes)) if bool(((truth == k) | (ours == k)).any())]
    parts = [to_picture(image), overlay(image, truth, colours, 0.8), overlay(image, ours, colours, 0.8)]
    parts.append(_error(image, ours == truth, ours < 0, truth >= 0))
    sheet = in_a_row(parts, ("image", "truth", "ours", "error"))
    write_rgb(path, with_legend(sheet, [classes[k] for k in shown], colours[shown]))


def draw_query(
    path: Path, image: Any, truth: Tensor, scores: Tensor, ours: Tensor, pixel: tuple[int, int] | None
) -> None:
    """Image with the object, score of a phrase with its best pixel, our mask, and the error.

    Args:
        path: PNG to write.
        image: [H, W, 3].
        truth, ours: Masks, bool [H, W].
        scores: [H, W].
        pixel: (x, y) of the best pixel, or None.
    """
    colours = np.array([[240, 90, 60]], dtype=np.uint8)
    heat = heat_map(image, scores)
    parts = [
        overlay(image, torch.where(truth, 0, -1), colours),
        mark_pixel(heat, pixel) if pixel is not None else heat,
        overlay(image, torch.where(ours, 0, -1), colours),
        _error(image, ours & truth, truth & ~ours, truth | ours),
    ]
    write_rgb(path, in_a_row(parts, ("truth", "score", "ours", "error")))


def _error(image: Any, right: Tensor, missed: Tensor, scored: Tensor) -> Picture:
    state = torch.where(right, 0, torch.where(missed, 2, 1))
    colours = np.array([RIGHT, WRONG, MISSED], dtype=np.uint8)
    return overlay(image, torch.where(scored, state, -1), colours, 0.75)


def in_a_row(parts: Sequence[Picture], titles: Sequence[str]) -> Picture:
    """Pictures of one height side by side, each under its title."""
    import cv2

    columns = []
    for part, title in zip(parts, titles, strict=True):
        head = np.full((TITLE, part.shape[1], 3), 255, dtype=np.uint8)
        cv2.putText(head, title, (4, TITLE - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
        columns += [np.concatenate([head, part]), np.full((len(part) + TITLE, GAP, 3), 255, dtype=np.uint8)]
    return np.concatenate(columns[:-1], axis=1)
