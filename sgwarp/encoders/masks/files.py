"""Masks made elsewhere: label images, or stacks of masks, one file per view stem.

- {stem}.png: ids, 0 = no mask; the pixels of every other id are one mask.
- {stem}.npz: masks [M, h, w] (bool, may overlap), and if there are any scores [M] and ranks [M] (0, 1, 2 for small,
  middle, large; -1 for none).
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sgwarp.encoders.base import UNRANKED, MaskGenerator, Masks, MissingMap
from sgwarp.encoders.building import Request
from sgwarp.encoders.names import Part
from sgwarp.errors import InputError
from sgwarp.files.access import read_bytes
from sgwarp.files.arrays import read_arrays
from sgwarp.files.images import read_ids
from sgwarp.io.companions import Companions
from sgwarp.scene import View


class FileMasks:
    """A MaskGenerator that reads its masks.

    Args:
        folder: Where the files are; they are found by the photographs' names (`sgwarp.io.companions`), and turned and
            undistorted like the photographs.
        views: The views that will be asked for; without them only plain stems are found.

    Raises:
        InputError: The folder is missing.
    """

    identity = "masks of files"
    needs_image = False

    def __init__(self, folder: str | os.PathLike[str], views: Sequence[View] = ()) -> None:
        self.folder = Path(folder)
        if not self.folder.is_dir():
            raise InputError(f"{self.folder}: no such folder; give the one that holds {{stem}}.png or {{stem}}.npz")
        self._companions = Companions(self.folder, views)

    def _path(self, view: View) -> Path:
        there = self._companions.find(view, (".png", ".npz"))
        if not there:
            raise MissingMap(f"{self.folder}: holds no {view.stem}.png or {view.stem}.npz")
        return there[0]

    def identity_of(self, view: View) -> str:
        return hashlib.sha256(read_bytes(self._path(view))).hexdigest()

    def everything(self, view: View, image: Tensor) -> Masks:
        """The masks of a view.

        Raises:
            MissingMap: It has no file.
            InputError: The file cannot be read, or is not in the shape of the image.
        """
        path = self._path(view)
        masks = _from_ids(path, view) if path.suffix.lower() == ".png" else _from_stack(path, view)
        (h, w), (height, width) = masks.masks.shape[1:], image.shape[:2]
        if abs(h * width - w * height) > max(height, width):
            raise InputError(f"{path}: is {w} x {h}, not the shape of view {view.stem} ({width} x {height})")
        return masks

    def in_boxes(self, image: Tensor, boxes: Tensor) -> Tensor:
        raise InputError(
            f"{self.folder}: masks from files cannot be asked for the mask of a box; use sam:PATH for that"
        )


def _carried(path: Path, array: Any, view: View) -> Any:
    """What belongs to the photograph as stored, as it belongs to the image of the view's camera."""
    try:
        return np.ascontiguousarray(view.carry(array))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _from_ids(path: Path, view: View) -> Masks:
    ids = torch.from_numpy(_carried(path, read_ids(path), view))
    labels = ids.unique()
    labels = labels[labels != 0]
    count = len(labels)
    return Masks(ids == labels[:, None, None], torch.ones(count), torch.full((count,), UNRANKED))


def _from_stack(path: Path, view: View) -> Masks:
    arrays = read_arrays(path)
    if "masks" not in arrays or arrays["masks"].ndim != 3:
        raise InputError(f"{path}: expected an array masks [M, h, w]")
    count = len(arrays["masks"])
    scores = torch.from_numpy(np.asarray(arrays.get("scores", np.ones(count)), np.float32))
    ranks = torch.from_numpy(np.asarray(arrays.get("ranks", np.full(count, UNRANKED)), np.int64))
    try:
        stack = _carried(path, np.moveaxis(arrays["masks"].astype(bool), 0, 2), view)
        return Masks(torch.from_numpy(np.ascontiguousarray(np.moveaxis(stack, 2, 0))), scores, ranks)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def make_masks(part: Part, request: Request) -> MaskGenerator:
    """Masks from a folder."""
    return FileMasks(part.argument, request.views)
