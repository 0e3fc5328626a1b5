"""Feature maps and label images made elsewhere: one file, or pair of files, per view stem.

| files of a view | what they hold | becomes |
|---|---|---|
| {stem}.png | label or instance ids, 0 = unknown | one-hot ids in the space "labels" |
| {stem}.npy, .npz, .pt, .pth or .safetensors | features, [C, h, w] or [h, w, C] | dense map |
| {stem}_fmap_CxHxW.pt | features [C, h, w] (Feature 3DGS) | dense map |
| {stem}_s.npy with {stem}_f.npy | ids [L, h, w], -1 = none; vectors [M, C] (LangSplat) | id map of L levels |

Files are found by the photograph's name, however it is spelled: `sgwarp.io.companions` has the list. What they hold
belongs to the photograph as it is stored: it is turned and undistorted with it, unless the option `straight=yes` says
that it was made for the undistorted image.

A file space.json or meta.json beside them, {"space": "..."}, names the embedding space of the features.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from sgwarp.encoders.base import MapSource, MissingMap
from sgwarp.encoders.building import Request
from sgwarp.encoders.maps.feature_files import (
    FEATURE_SUFFIXES,
    Layout,
    channels_last,
    load_features,
    same_shape,
)
from sgwarp.encoders.names import Member
from sgwarp.errors import InputError
from sgwarp.files.arrays import read_array
from sgwarp.files.documents import read_json
from sgwarp.files.images import read_ids
from sgwarp.io.companions import Companions
from sgwarp.scene import FeatureMap, View

LABEL_SPACE = "labels"
CHANNELS_FIRST = "_fmap_CxHxW.pt"  # Feature 3DGS says its layout in the name
SPACE_FILES = ("space.json", "meta.json")

Kind = Literal["labels", "dense", "levels"]


class FileMaps:
    """Feature maps read from a folder, as a MapSource.

    Args:
        folder: Where the files are.
        views: The views that will be asked for. Label images share one set of channels: the ids found in all of them.
        layout: Where dense features have their channels, "chw" or "hwc"; if None, the view's shape decides.
        levels: Which levels of a LangSplat pair to keep, in this order; all of them if None.
        straight: The files belong to the undistorted images, not to the photographs as stored.

    Raises:
        InputError: The folder is missing, holds no map of any view or maps of two kinds, or a file cannot be read.
    """

    needs_image = False

    def __init__(
        self,
        folder: str | os.PathLike[str],
        views: Sequence[View],
        *,
        layout: Layout | None = None,
        levels: Sequence[int] | None = None,
        straight: bool = False,
    ) -> None:
        self.folder = Path(folder)
        self.layout = layout
        self.levels = levels
        self.straight = straight
        self.companions = Companions(folder, views)
        found = [(view, *self._find(view)) for view in views if self.has_map(view)]
        if not found:
            names = ", ".join(f"{{stem}}{suffix}" for suffix in (".png", *FEATURE_SUFFIXES, CHANNELS_FIRST, "_s.npy"))
            raise InputError(f"{self.folder}: holds no map of any of the {len(views)} views; looked for {names}")
        first, self.kind, _ = found[0]
        for _, kind, path in found:
            self._require_kind(kind, path)
        self.labels = _scene_labels([path for _, _, path in found]) if self.kind == "labels" else None
        self.space = LABEL_SPACE if self.labels else self._named_space() or f"files:{self._channels(first)}"

    def encode(self, view: View, image: Tensor | None = None) -> FeatureMap:
        """Read the map of a view; the image is not needed.

        Raises:
            MissingMap: The view has no file.
            InputError: A file cannot be read, or does not have the shape of the view.
        """
        kind, path = self._find(view)
        self._require_kind(kind, path)
        if kind == "labels":
            return FeatureMap(self.space, ids=self._label_channels(path, view), labels=self.labels)
        if kind == "levels":
            ids, vectors = self._levels(path, view)
            return FeatureMap(self.space, ids=ids, vectors=vectors)
        dense, valid = self._dense(path, view)
        return FeatureMap(self.space, dense=dense, valid=valid)

    def _candidates(self, view: View) -> list[tuple[Kind, Path]]:
        kinds: list[tuple[Kind, str]] = [("labels", ".png"), ("levels", "_s.npy")]
        kinds += [("dense", suffix) for suffix in (*FEATURE_SUFFIXES, CHANNELS_FIRST)]
        return [(kind, path) for kind, ending in kinds for path in self.companions.find(view, [ending])]

    def has_map(self, view: View) -> bool:
        """Whether the folder holds a file for the view; it is not opened."""
        return bool(self._candidates(view))

    def _find(self, view: View) -> tuple[Kind, Path]:
        """Kind of a view's map, and its (first) file."""
        found = self._candidates(view)
        if not found:
            raise MissingMap(f"{self.folder}: holds no map of view {view.stem}")
        if len(found) > 1:
            raise InputError(f"{found[0][1]}: view {view.stem} has another map, {found[1][1].name}; keep one of them")
        return found[0]

    def _require_kind(self, kind: Kind, path: Path) -> None:
        if kind != self.kind:
            raise InputError(f"{path}: holds {kind}, the maps before it {self.kind}; keep one kind in a folder")

    def _named_space(self) -> str | None:
        for path in (self.folder / name for name in SPACE_FILES):
            if path.is_file():
                content = read_json(path)
                space = content.get("space") if isinstance(content, dict) else None
                if isinstance(space, str) and space:
                    return space
                raise InputError(f'{path}: expected {{"space": "name of the embedding space"}}')
        return None

    def _channels(self, view: View) -> int:
        kind, path = self._find(view)
        return (self._levels(path, view)[1] if kind == "levels" else self._dense(path, view)[0]).shape[-1]

    def _label_channels(self, path: Path, view: View) -> Tensor:
        """Index into the labels at every pixel, -1 where unknown, int64 [h, w]."""
        assert self.labels is not None
        ids = self._carried(path, read_ids(path), view)
        _require_shape(path, ids.shape, view)
        known = np.array([0, *(int(label) for label in self.labels)])
        place = np.minimum(np.searchsorted(known, ids), len(known) - 1)
        strange = known[place] != ids
        if bool(strange.any()):
            raise InputError(f"{path}: id {ids[strange][0]} was not there when the folder was opened; start again")
        return torch.from_numpy(place - 1)

    def _dense(self, path: Path, view: View) -> tuple[Tensor, Tensor | None]:
        features, valid = load_features(path)
        layout = "chw" if path.name.endswith(CHANNELS_FIRST) else self.layout
        if self.straight or view.undistort is None:
            return channels_last(path, features, view.camera.size, layout), valid
        dense = channels_last(path, features, self._stored_size(view, features, layout), layout)
        smooth = self._carried(path, dense.to(torch.float32).numpy(), view, nearest=False)
        known = None if valid is None else torch.from_numpy(self._carried(path, valid.numpy(), view))
        return torch.from_numpy(np.ascontiguousarray(smooth)).to(dense.dtype), known

    def _stored_size(self, view: View, features: Tensor, layout: Layout | None) -> tuple[int, int]:
        """(height, width) of the photograph as stored, or lying as the features do."""
        height, width = view.camera.size
        a, b, c = features.shape
        shapes = {"chw": (b, c), "hwc": (a, b)}
        asked = shapes.values() if layout is None else [shapes[layout]]
        return (height, width) if any(same_shape(shape, (height, width)) for shape in asked) else (width, height)

    def _carried(self, path: Path, array: Any, view: View, nearest: bool = True) -> Any:
        """What belongs to the photograph as stored, as it belongs to the image of the view's camera."""
        if self.straight:
            return array
        try:
            return view.carry(array, nearest)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None

    def _levels(self, path: Path, view: View) -> tuple[Tensor, Tensor]:
        """Ids, int64 [L, h, w], and vectors, float32 [M, C], of a LangSplat pair."""
        ids = read_array(path)
        if ids.ndim != 3 or not ids.size or ids.dtype.kind not in "biuf" or not np.array_equal(ids, np.rint(ids)):
            raise InputError(f"{path}: expected integer ids [levels, h, w], got {ids.dtype} {list(ids.shape)}")
        for level in self.levels or ():
            if not 0 <= level < len(ids):
                raise InputError(f"{path}: has no level {level}; its levels are 0 to {len(ids) - 1}")
        if self.levels is not None:
            ids = ids[list(self.levels)]
        ids = np.moveaxis(self._carried(path, np.moveaxis(ids, 0, 2), view), 2, 0)
        _require_shape(path, ids.shape[1:], view)
        other = path.with_name(path.name.removesuffix("_s.npy") + "_f.npy")
        vectors = read_array(other)
        if vectors.ndim != 2 or not np.issubdtype(vectors.dtype, np.floating):
            raise InputError(f"{other}: expected floating point [M, C], got {vectors.dtype} {list(vectors.shape)}")
        if ids.min() < -1 or ids.max() >= len(vectors):
            raise InputError(
                f"{path}: ids go from {ids.min():g} to {ids.max():g}, {other.name} has {len(vectors)} rows"
            )
        return torch.from_numpy(np.ascontiguousarray(ids, np.int64)), torch.from_numpy(vectors.astype(np.float32))


def _scene_labels(paths: Sequence[Path]) -> tuple[str, ...]:
    """Ids in all the label images but 0, which is unknown, ascending."""
    ids: set[int] = set()
    for path in paths:
        ids.update(np.unique(read_ids(path)).tolist())
    if not ids - {0}:
        raise InputError(f"{paths[0].parent}: its {len(paths)} label images are 0 everywhere, which means unknown")
    return tuple(str(label) for label in sorted(ids - {0}))


def _require_shape(path: Path, shape: Sequence[int], view: View) -> None:
    height, width = view.camera.size
    if not same_shape((shape[0], shape[1]), (height, width)):
        raise InputError(f"{path}: is {shape[1]} x {shape[0]}, not the shape of view {view.stem} ({width} x {height})")


def open_files(
    folder: str,
    views: Sequence[View],
    layout: str | None = None,
    levels: str | None = None,
    straight: str | None = None,
) -> FileMaps:
    """The source behind `files:DIR`, with the options layout=hwc (or chw), levels=1,2,3 and straight=yes.

    Raises:
        InputError: An option has a wrong value, or as FileMaps.
    """
    if layout not in (None, "chw", "hwc"):
        raise InputError(f"files:{folder}: layout is chw or hwc, not '{layout}'")
    try:
        chosen = [int(level) for level in levels.split(",")] if levels else None
    except ValueError:
        raise InputError(f"files:{folder}: levels are numbers such as 1,2,3, not '{levels}'") from None
    if straight not in (None, "yes", "no"):
        raise InputError(f"files:{folder}: straight is yes or no, not '{straight}'")
    return FileMaps(folder, views, layout=layout, levels=chosen, straight=straight == "yes")  # type: ignore[arg-type]


def make_source(member: Member, request: Request) -> MapSource:
    """`open_files` for the views that are asked for."""
    return open_files(member.source.argument, request.views, **member.source.options)
