"""The transform between the world that views were taken in and that of a scene: a file, and its effect on views."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sgwarp.errors import InputError
from sgwarp.files.access import read_bytes
from sgwarp.files.arrays import read_array
from sgwarp.files.documents import parse_json
from sgwarp.scene import View

TOLERANCE = 1e-3


def read_world_transform(path: str | os.PathLike[str]) -> NDArray[np.float64]:
    """A similarity transform, float64 [4, 4], that takes points of the views' world to that of the scene.

    Args:
        path: nerfstudio's dataparser_transforms.json ("transform" [3, 4], then "scale"), or a matrix of 3 or 4 rows of
            4 numbers as JSON, text or .npy.

    Raises:
        InputError: The file is missing, or holds no rotation with a translation and one positive scale.
    """
    path = Path(path)
    if path.suffix.lower() == ".npy":
        return _checked(path, read_array(path), 1.0)
    text = read_bytes(path).decode("utf-8", "replace")
    try:
        content = parse_json(path, text)
    except InputError:  # four rows of numbers, then
        content = [line.replace(",", " ").split() for line in text.splitlines() if line.strip()]
    if isinstance(content, dict):
        return _checked(path, content.get("transform"), content.get("scale", 1.0))
    return _checked(path, content, 1.0)


def _checked(path: Path, rows: Any, scale: Any) -> NDArray[np.float64]:
    try:
        matrix = np.array(rows, np.float64)
        factor = float(scale)
    except (OverflowError, TypeError, ValueError):
        matrix, factor = np.empty(0), 1.0
    if matrix.shape not in ((3, 4), (4, 4)) or not np.isfinite(matrix).all():
        raise InputError(f'{path}: expected "transform" (3 x 4 numbers) and "scale", or a matrix of 3 or 4 rows')
    whole = np.eye(4)
    whole[:3] = factor * matrix[:3]
    size = float(np.cbrt(max(np.linalg.det(whole[:3, :3]), 0.0)))
    linear = whole[:3, :3]
    if not (0 < size < np.inf) or np.abs(linear.T @ linear / size**2 - np.eye(3)).max() > TOLERANCE:
        raise InputError(f"{path}: is not a rotation with a translation and one positive scale; correct it")
    return whole


def moved_views(views: Sequence[View], matrix: NDArray[np.float64]) -> list[View]:
    """The views after a similarity transform of the world: their pictures stay, depth scales.

    Args:
        views: Views of a data set.
        matrix: float64 [4, 4], points as columns.
    """
    matrix = np.asarray(matrix, np.float64)
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    rotation = torch.from_numpy(matrix[:3, :3] / scale)
    shift, linear = torch.from_numpy(matrix[:3, 3].copy()), torch.from_numpy(matrix[:3, :3].copy())
    moved = []
    for view in views:
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = view.camera.world_to_camera[:3, :3] @ rotation.T
        pose[:3, 3] = -pose[:3, :3] @ (linear @ view.camera.position + shift)
        camera = replace(view.camera, world_to_camera=pose, near=view.camera.near * scale, far=view.camera.far * scale)
        moved.append(replace(view, camera=camera))
    return moved
