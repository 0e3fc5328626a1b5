"""Feature maps of every frame and view: label images in folders per frame, or any encoder."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

import torch
from torch import Tensor

from sgwarp.encoders.base import MapSource, MissingMap
from sgwarp.encoders.maps.files import LABEL_SPACE, FileMaps
from sgwarp.errors import InputError
from sgwarp.files.images import read_ids
from sgwarp.io.moving_views import FrameView
from sgwarp.scene import FeatureMap, View


class FrameSource(Protocol):
    """Feature maps of a moving scene, one at a time and in the order of time."""

    @property
    def needs_image(self) -> bool: ...

    def encode(self, frame: int, view: FrameView, image: Tensor | None) -> FeatureMap:
        """The map of a view at a frame; raises MissingMap where there is none."""
        ...


class NamedSource(FrameSource, Protocol):
    """A source that knows the space of its features, "labels" for ids."""

    @property
    def of_space(self) -> str: ...


class EveryFrame:
    """An encoder that looks at each photograph by itself."""

    def __init__(self, source: MapSource) -> None:
        self.source = source
        self.needs_image = source.needs_image
        self.of_space = source.space

    def encode(self, frame: int, view: FrameView, image: Tensor | None) -> FeatureMap:
        return self.source.encode(view.view, image)


class Growing:
    """Channels of labels in the order in which their ids appear: a later frame adds some, and moves none."""

    def __init__(self, labels: tuple[str, ...] = ()) -> None:
        self.labels = list(labels)
        self._known = {int(name): place for place, name in enumerate(labels)}

    def map_of(self, ids: Tensor) -> FeatureMap:
        """Ids, 0 = nothing, as a one-hot map, integers [h, w]."""
        names, places = ids.to(torch.int64).unique(return_inverse=True)
        for name in names.tolist():
            if name and name not in self._known:
                self._known[name] = len(self.labels)
                self.labels.append(str(name))
        table = torch.tensor([self._known.get(name, -1) for name in names.tolist()])
        return FeatureMap(LABEL_SPACE, ids=table[places], labels=tuple(self.labels) or ("1",))


class LabelFrames:
    """Label or id images. Of frame t and view s, the first of these that exists below the folder:

    `{t:05d}/{s}.png`, `{t}/{s}.png`, the name of the photograph with the suffix .png, `{s}/{t:05d}.png`,
    `{s}/{t:06d}.png`. A pixel of 0 is unknown.
    """

    needs_image = False
    of_space = LABEL_SPACE

    def __init__(self, folder: Path, labels: tuple[str, ...] = ()) -> None:
        self.folder = folder
        self.growing = Growing(labels)
        if not folder.is_dir():
            raise InputError(f"{folder}: no such folder; give the one that holds a folder of label images per frame")

    def encode(self, frame: int, view: FrameView, image: Tensor | None) -> FeatureMap:
        path = self.find(frame, view)
        if path is None:
            raise MissingMap(f"{self.folder}: holds no label image of frame {frame}, view {view.view.stem}")
        ids = read_ids(path)
        height, width = view.view.camera.size
        if ids.shape[0] * width != ids.shape[1] * height:
            got = f"{ids.shape[1]} x {ids.shape[0]}"
            raise InputError(f"{path}: is {got}, which has not the shape of its view, {width} x {height}")
        return self.growing.map_of(torch.from_numpy(ids))

    def find(self, frame: int, view: FrameView) -> Path | None:
        """The label image, None if there is none."""
        stem = view.view.stem
        names = [f"{frame:05d}/{stem}.png", f"{frame}/{stem}.png"]
        names += [str(Path(view.file).with_suffix(".png"))] if view.file else []
        names += [f"{stem}/{frame:05d}.png", f"{stem}/{frame:06d}.png"]
        return next(filter(os.path.isfile, (self.folder / name for name in names)), None)


class FileFrames:
    """Dense features or LangSplat levels in one folder per frame, `{t:05d}` or `{t}`."""

    needs_image = False

    def __init__(self, folder: Path, first: Sequence[FrameView]) -> None:
        self.folder = folder
        self._open = 0, FileMaps(self._place(0), [view.view for view in first])
        self.of_space = self._open[1].space

    def encode(self, frame: int, view: FrameView, image: Tensor | None) -> FeatureMap:
        if self._open[0] != frame:
            self._open = frame, FileMaps(self._place(frame), [view.view])
        return self._open[1].encode(view.view)

    def _place(self, frame: int) -> Path:
        for name in (f"{frame:05d}", str(frame)):
            if (self.folder / name).is_dir():
                return self.folder / name
        raise MissingMap(f"{self.folder}: holds no folder of frame {frame}")


def open_source(
    name: str, first: list[FrameView], make: Callable[[str, list[View]], MapSource], labels: tuple[str, ...] = ()
) -> NamedSource:
    """The source of maps that an encoder's name stands for.

    Args:
        name: As for `make_encoder`; `files:DIR` are files per frame.
        first: Views of the first frame.
        make: Opens any other encoder by its name and the views.
        labels: Ids that an interrupted run has met.

    Raises:
        InputError: The folder holds nothing of the first frame.
    """
    prefix, _, folder = name.partition(":")
    if prefix != "files" or "+" in folder or "?" in folder:
        return EveryFrame(make(name, [view.view for view in first]))
    labeled = LabelFrames(Path(folder), labels)
    if any(labeled.find(0, view) for view in first):
        return labeled
    if any((Path(folder) / place).is_dir() for place in ("00000", "0")):
        return FileFrames(Path(folder), first)
    looked = f"{folder}/00000/{first[0].view.stem}.png" if first else folder
    raise InputError(f"{folder}: holds no maps of frame 0; looked for {looked} and the like")
