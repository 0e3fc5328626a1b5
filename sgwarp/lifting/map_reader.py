"""The maps of the views, one after the other and as often as a mode needs them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from sgwarp.encoders.base import MapSource, MissingMap
from sgwarp.errors import InputError
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.rendering.renderer import render
from sgwarp.runs.log import RunLog
from sgwarp.scene import FeatureMap, Gaussians, View

Maps = MapSource | Callable[[View], FeatureMap] | Mapping[str, FeatureMap]
KEPT_BYTES = 2**29  # maps that are held for the next pass; the others are made again
Kind = tuple[str, int, tuple[str, ...] | None]


@dataclass
class MapReader:
    """Reads, checks and, for modes that walk over the views several times, keeps maps.

    Attributes:
        gaussians: The scene, for views without a photograph.
        source: Where maps come from.
        settings: Thresholds of the rasterizer.
        log: Receives times and what was left out.
        keep: Hold maps in memory, up to KEPT_BYTES.
        stem: View of the first map, for messages.
        kind: Space, channels and labels of the first map.
    """

    gaussians: Gaussians
    source: MapSource
    settings: RasterSettings
    log: RunLog
    keep: bool = False
    stem: str = ""
    kind: Kind = ("", 0, None)
    _kept: dict[str, FeatureMap | None] = field(default_factory=dict)
    _bytes: int = 0

    def read(self, view: View) -> FeatureMap | None:
        """The map of a view; None if it has none.

        Raises:
            InputError: The map is of another kind than the first, or holds NaN.
        """
        if view.stem in self._kept:
            return self._kept[view.stem]
        found = self._encode(view)
        if found is not None:
            self._check(view, found)
        size = 0 if found is None else _size(found)
        if self.keep and self._bytes + size <= KEPT_BYTES:
            self._kept[view.stem], self._bytes = found, self._bytes + size
        return found

    def _encode(self, view: View) -> FeatureMap | None:
        image = None
        if self.source.needs_image and view.image_path is not None:
            with self.log.stage("read"):
                image = view.image()
        elif self.source.needs_image:
            with self.log.stage("render"):
                image = render(self.gaussians, view.camera, settings=self.settings).clamp(0.0, 1.0).cpu()
            self.log.leave_out("photographs_rendered_instead")
        try:
            with self.log.stage("encode"):
                return self.source.encode(view, image)
        except MissingMap:
            self.log.leave_out("views_without_map")
            return None

    def _check(self, view: View, feature_map: FeatureMap) -> None:
        kind = feature_map.space, feature_map.channels, feature_map.labels
        if not self.stem:
            self.stem, self.kind = view.stem, kind
        for name, mine, first in zip(("space", "channels", "labels"), kind, self.kind, strict=True):
            if mine != first:
                raise InputError(
                    f"view {view.stem}: feature map has {name} {mine!r}, view {self.stem} has {first!r}; "
                    "lift maps of one kind at a time"
                )
        if feature_map.dense is not None:
            finite = torch.isfinite(feature_map.dense).all(dim=2)
            bad = int((~finite if feature_map.valid is None else ~finite & feature_map.valid).sum())
        else:
            bad = 0 if feature_map.vectors is None else int((~torch.isfinite(feature_map.vectors)).any(dim=1).sum())
        if bad:
            raise InputError(f"view {view.stem}: feature map holds NaN or infinity at {bad} places; mark them invalid")


def _size(found: FeatureMap) -> int:
    """Bytes of a map."""
    return sum(t.nbytes for t in (found.dense, found.valid, found.ids, found.vectors) if t is not None)


@dataclass
class _PlainMaps:
    """A function of a view, or feature maps by stem, as a MapSource."""

    of_view: Callable[[View], FeatureMap]
    has_map: Callable[[View], bool] = lambda view: True
    space: str = ""
    needs_image: bool = False

    def encode(self, view: View, image: Tensor | None) -> FeatureMap:
        return self.of_view(view)


def as_source(maps: Maps) -> MapSource:
    """Maps of any of the three forms as a source.

    Raises:
        InputError: They have none of them.
    """
    if isinstance(maps, MapSource):
        return maps
    if isinstance(maps, Mapping):
        by_stem = maps
        return _PlainMaps(lambda view: by_stem[view.stem], lambda view: view.stem in by_stem)
    if callable(maps):
        return _PlainMaps(maps)
    raise InputError(f"maps: expected an encoder, a function or a dict of feature maps, got {type(maps).__name__}")


def has_map(source: MapSource, view: View) -> bool:
    """Whether the source has a map of the view; one that cannot tell raises MissingMap when it is asked for it."""
    tell = getattr(source, "has_map", None)
    return tell is None or bool(tell(view))
