"""VLPart (Sun et al., Going Denser with Open-Vocabulary Part Segmentation, 2023) through its exported files.

The network needs detectron2, which is not on PyPI; it is run elsewhere, and writes one file per view:

- {stem}.json: {"instances": [{"box": [x1, y1, x2, y2], "name": "dog:head", "score": 0.9, "mask": RLE}, ...]} with
  boxes in pixels of the image. "mask" may be left out; RLE is that of COCO, {"size": [h, w], "counts": ...}, the counts
  as numbers or as a string.
- {stem}.npz: arrays boxes [K, 4], names [K] (strings), scores [K], and if there are any masks [K, h, w] (bool).
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sgwarp.encoders.base import Instances, MapSource, MissingMap
from sgwarp.encoders.building import Request, source_of_instances
from sgwarp.encoders.names import Member
from sgwarp.errors import InputError
from sgwarp.files.access import read_bytes
from sgwarp.files.arrays import read_arrays
from sgwarp.files.documents import read_json
from sgwarp.files.image_headers import largest_image
from sgwarp.scene import View

SUFFIXES = (".json", ".npz")


class VLPartFiles:
    """An InstanceEncoder that reads what VLPart, or any other detector, has found.

    Args:
        folder: Where the files are.
        least_score: Least score of an instance.

    Raises:
        InputError: The folder is missing.
    """

    needs_image = False

    def __init__(self, folder: str | os.PathLike[str], least_score: float = 0.0) -> None:
        self.folder = Path(folder)
        self.least_score = least_score
        if not self.folder.is_dir():
            raise InputError(f"{self.folder}: no such folder; give the one that holds {{stem}}.json or {{stem}}.npz")
        self.identity = f"vlpart, {least_score}"

    def _path(self, view: View) -> Path:
        found = [path for path in (self.folder / f"{view.stem}{suffix}" for suffix in SUFFIXES) if os.path.isfile(path)]
        if not found:
            raise MissingMap(f"{self.folder}: holds no {view.stem}.json or {view.stem}.npz")
        return found[0]

    def has_map(self, view: View) -> bool:
        """Whether there is a file for the view."""
        return any(os.path.isfile(self.folder / f"{view.stem}{suffix}") for suffix in SUFFIXES)

    def identity_of(self, view: View) -> str:
        return hashlib.sha256(read_bytes(self._path(view))).hexdigest()

    def find(self, view: View, image: torch.Tensor) -> Instances:
        """Instances from the file of the view.

        Raises:
            InputError: It is missing, damaged, or boxes and masks do not fit the image.
        """
        path = self._path(view)
        found = _read_json(path) if path.suffix == ".json" else _read_npz(path)
        kept = (found.scores >= self.least_score).nonzero().flatten()
        names = tuple(plain_name(found.names[k]) for k in kept.tolist())
        masks = None if found.masks is None else found.masks[kept]
        height, width = image.shape[:2]
        if masks is not None and abs(masks.shape[1] * width - masks.shape[2] * height) > max(height, width):
            shape = f"{masks.shape[2]} x {masks.shape[1]}"
            raise InputError(f"{path}: masks are {shape}, not the shape of view {view.stem} ({width} x {height})")
        return Instances(found.boxes[kept], names, found.scores[kept], masks)


def plain_name(name: str) -> str:
    """The name of a class or part as one says it: "dog:head" and "dog_head" are "dog head"."""
    return " ".join(name.replace("_", " ").replace(":", " ").split())


def _read_json(path: Path) -> Instances:
    content = read_json(path)
    rows = content.get("instances") if isinstance(content, Mapping) else None
    if not isinstance(rows, list):
        raise InputError(f'{path}: expected {{"instances": [...]}}')
    try:
        boxes = [[float(row["box"][side]) for side in range(4)] for row in rows]
        names = [str(row["name"]) for row in rows]
        scores = [float(row["score"]) for row in rows]
        masks = [decode_rle(row["mask"]) for row in rows if row.get("mask") is not None]
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        raise InputError(f"{path}: an instance is damaged ({error!r})") from None
    if masks and (len(masks) < len(names) or len({mask.shape for mask in masks}) > 1):
        raise InputError(f"{path}: {len(masks)} of {len(names)} instances have a mask, or masks differ in size")
    stacked = torch.from_numpy(np.stack(masks)) if masks else None
    return _checked(path, torch.tensor(boxes, dtype=torch.float32).reshape(-1, 4), names, scores, stacked)


def _read_npz(path: Path) -> Instances:
    arrays = read_arrays(path, texts=True)
    missing = [name for name in ("boxes", "names", "scores") if name not in arrays]
    if missing:
        raise InputError(f"{path}: lacks the array {missing[0]}")
    try:
        boxes = torch.from_numpy(arrays["boxes"].astype(np.float32)).reshape(-1, 4)
        scores = [float(score) for score in arrays["scores"]]
    except (ValueError, TypeError, RuntimeError, OverflowError) as error:
        raise InputError(f"{path}: boxes [K, 4] and scores [K] must be numbers ({error})") from None
    masks = torch.from_numpy(arrays["masks"].astype(bool)) if "masks" in arrays else None
    if masks is not None and masks.ndim != 3:
        raise InputError(f"{path}: expected masks [K, h, w], got {list(masks.shape)}")
    try:
        names = [str(name) for name in arrays["names"]]
    except (ValueError, TypeError):
        raise InputError(f"{path}: names [K] must be texts") from None
    return _checked(path, boxes, names, scores, masks)


def _checked(
    path: Path, boxes: torch.Tensor, names: list[str], scores: list[float], masks: torch.Tensor | None
) -> Instances:
    try:
        found = Instances(boxes.to(torch.float32), tuple(names), torch.tensor(scores, dtype=torch.float32), masks)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    if not bool(torch.isfinite(boxes).all()) or bool((boxes[:, 2:] <= boxes[:, :2]).any()):
        raise InputError(f"{path}: boxes are x1, y1, x2, y2 with x1 < x2 and y1 < y2")
    if not all(name.strip() for name in names):
        raise InputError(f"{path}: an instance has no name")
    return found


def decode_rle(mask: Mapping[str, Any]) -> NDArray[np.bool_]:
    """A mask, bool [h, w], of COCO's run lengths: column by column, beginning with zeros.

    Raises:
        KeyError, ValueError, IndexError: It is damaged.
    """
    height, width = (int(side) for side in mask["size"])
    if not (height > 0 and width > 0 and height * width <= largest_image()):
        raise ValueError(f"a mask of {height} x {width} pixels")
    counts = mask["counts"]
    runs = _decode_counts(counts) if isinstance(counts, str) else [int(count) for count in counts]
    if sum(runs) != height * width or min(runs) < 0:
        raise ValueError(f"run lengths add up to {sum(runs)}, not {height} x {width}")
    values = np.repeat(np.arange(len(runs)) % 2 == 1, runs)
    return np.ascontiguousarray(values.reshape(width, height).T)


def _decode_counts(text: str) -> list[int]:
    """COCO's compressed run lengths: five bits a character, the third and later runs as differences to the one two
    before."""
    runs: list[int] = []
    place = 0
    while place < len(text):
        value, shift, more = 0, 0, True
        while more:
            bits = ord(text[place]) - 48
            if not 0 <= bits < 64:
                raise ValueError(f"character {text[place]!r} stands for no run length")
            value |= (bits & 31) << shift
            more = bool(bits & 32)
            place += 1
            shift += 5
            if not more and bits & 16:
                value -= 1 << shift
        runs.append(value + (runs[-2] if len(runs) > 2 else 0))
    return runs


def make_source(member: Member, request: Request) -> MapSource:
    """Its masks, as the text side embeds their names."""
    part = member.source
    return source_of_instances(VLPartFiles(part.argument, **part.options), member, request)
