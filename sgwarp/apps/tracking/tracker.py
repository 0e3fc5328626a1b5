"""Semantics of a moving scene, frame by frame: lifting that never looks at a later frame (paper, Sec. IV-C.2)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from sgwarp.apps.tracking.fusion import Evidence, Fusion, FusionSettings
from sgwarp.apps.tracking.sources import EveryFrame, FrameSource
from sgwarp.encoders.base import MapSource, MissingMap
from sgwarp.errors import InputError
from sgwarp.io.moving_views import FrameView, MovingViews
from sgwarp.io.sequences import Frame, GaussianSequence
from sgwarp.ops.splatting.incremental import REBUILD_ABOVE, IncrementalLift, Work
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.rendering.renderer import render
from sgwarp.runs.log import RunLog
from sgwarp.scene import FeatureMap, Gaussians, Semantics, View


@dataclass(frozen=True)
class TrackSettings:
    """How a moving scene is tracked.

    Attributes:
        fusion: How earlier frames count.
        incremental: Lift only what changed since the frame before; the result is the same.
        foreground: Only Gaussians that the file calls foreground have a say; the others hide what is behind them.
        raster: Thresholds of the rasterizer.
        device: Where to compute.
    """

    fusion: FusionSettings = field(default_factory=FusionSettings)
    incremental: bool = True
    foreground: bool = False
    raster: RasterSettings = field(default_factory=RasterSettings)
    device: str = "cpu"


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """What is known at one frame, from it and those before.

    Attributes:
        index: Number of the frame.
        gaussians: The scene at that moment.
        ids: Identity of each row, int64 [N], or None: the row itself.
        views: The cameras that were lifted, and those without a map.
        space: Embedding space of the maps; "" as long as no view had one.
        labels: Names of the channels of label maps, else None.
        features, weight, effective_views: As of `Semantics`.
        work: What was lifted, and what was left out.
        unchanged: Nothing differs from the frame before: neither the scene nor what is known of it.
    """

    index: int
    gaussians: Gaussians
    ids: Tensor | None
    views: list[View]
    space: str
    labels: tuple[str, ...] | None
    features: Tensor
    weight: Tensor
    effective_views: Tensor
    work: Work
    unchanged: bool = False

    @cached_property
    def semantics(self) -> Semantics:
        """The same, bound to the scene of this frame by its fingerprint.

        Raises:
            InputError: No view of any frame so far had a map.
        """
        if not self.space:
            raise InputError(f"frame {self.index}: no view had a feature map so far")
        fields = (self.features, self.weight, self.effective_views)
        return Semantics(*fields, self.space, self.gaussians.fingerprint, self.labels)


class Tracker:
    """The state between two frames: what lifting keeps of the views, and the evidence of the frames so far."""

    def __init__(self, source: FrameSource, settings: TrackSettings | None = None, log: RunLog | None = None) -> None:
        self.source = source
        self.settings = settings or TrackSettings()
        self.log = log if log is not None else RunLog(device=self.settings.device)
        rebuild_above = REBUILD_ABOVE if self.settings.incremental else 0.0
        self._lift = IncrementalLift(self.settings.raster, rebuild_above)
        self.fusion: Fusion | None = None
        self.space = ""
        self.labels: tuple[str, ...] | None = None
        self._last: TrackedFrame | None = None

    def step(self, frame: Frame, views: list[FrameView]) -> TrackedFrame:
        """Take the next frame in.

        Raises:
            InputError: Maps of two kinds or with NaN; Gaussians that changed their number and have no ids.
        """
        gaussians = frame.gaussians.to(self.settings.device)
        with self.log.stage("lift"):
            self._lift.begin(gaussians)
        observe = getattr(self.source, "observe", None)
        if observe is not None:
            observe(frame.index, gaussians, views)
        if self.fusion is not None:
            for kept, gone in getattr(self.source, "joined", ()):
                self.fusion.join(kept, gone)
        for view in views:
            self._add(frame.index, view, gaussians)
        with self.log.stage("lift"):
            sums = self._lift.finish()
        work = replace(self._lift.work)
        still = self._last is not None and len(self._last.gaussians) == len(gaussians) and not work.direct
        still = still and not work.changed and not work.affected
        with self.log.stage("fuse"):
            if self.fusion is None:
                self.fusion = Fusion(self.settings.fusion, self.labels is not None)
            self.fusion.labels = self.labels is not None
            alone = self.settings.fusion.forgetting == 0.0
            if still and alone:
                assert self._last is not None
                tracked = replace(self._last, index=frame.index, work=work, unchanged=True)
            else:
                tracked = self._tracked(frame, gaussians, views, self.fusion.update(sums, frame.ids, frame.index), work)
        self._count(work)
        self._last = tracked
        return tracked

    def _add(self, index: int, view: FrameView, gaussians: Gaussians) -> None:
        if self.source.needs_image and view.missing:
            self.log.leave_out("views_without_photograph")
            return
        image = self._image(view, gaussians)
        try:
            with self.log.stage("encode"):
                feature_map = self.source.encode(index, view, image)
        except MissingMap:
            self.log.leave_out("views_without_map")
            return
        self._check(index, view.view.stem, feature_map)
        with self.log.stage("lift"):
            self._lift.add(view.view.stem, view.view.camera, feature_map)

    def _image(self, view: FrameView, gaussians: Gaussians) -> Tensor | None:
        if not self.source.needs_image:
            return None
        with self.log.stage("read"):
            if view.view.image_path is not None:
                return view.view.image()
            self.log.leave_out("photographs_rendered_instead")
            return render(gaussians, view.view.camera, settings=self.settings.raster).clamp(0.0, 1.0).cpu()

    def _check(self, index: int, stem: str, feature_map: FeatureMap) -> None:
        """Maps of one space, labels that only grow, no NaN."""
        where = f"frame {index}, view {stem}"
        if not self.space:
            self.space, self.labels = feature_map.space, feature_map.labels
        if feature_map.space != self.space or (feature_map.labels is None) != (self.labels is None):
            raise InputError(f"{where}: feature map is in space '{feature_map.space}', those before in '{self.space}'")
        if feature_map.labels is not None:
            self.labels = feature_map.labels
        values = feature_map.dense if feature_map.dense is not None else feature_map.vectors
        if values is None:
            return
        finite = torch.isfinite(values).all(dim=-1)
        if feature_map.valid is not None:
            finite = finite | ~feature_map.valid
        if not bool(finite.all()):
            raise InputError(f"{where}: feature map holds NaN or infinity; mark those pixels invalid")

    def _tracked(
        self, frame: Frame, gaussians: Gaussians, views: list[FrameView], known: Evidence, work: Work
    ) -> TrackedFrame:
        weight, squared = known.weight.clone(), known.weight_squared
        if self.settings.foreground:
            if frame.foreground is None:
                raise InputError(f"frame {frame.index}: the scene has no seg_colors that tell foreground; leave it out")
            weight = torch.where(frame.foreground.to(weight.device), weight, 0.0)
        return TrackedFrame(
            index=frame.index,
            gaussians=gaussians,
            ids=frame.ids,
            views=[view.view for view in views],
            space=self.space,
            labels=self.labels,
            features=known.features / torch.where(known.weight > 0, known.weight, 1.0)[:, None],
            weight=weight,
            effective_views=known.weight.square() / torch.where(squared > 0, squared, 1.0),
            work=work,
        )

    def _count(self, work: Work) -> None:
        self.log.leave_out("projections", work.all_projections - work.projections)
        self.log.leave_out("tiles_lifted_before", work.all_tiles - work.tiles)
        self.log.leave_out("sums_of_gaussians_kept", work.gaussians - work.affected)


def track(
    sequence: GaussianSequence,
    views: MovingViews | Callable[[int], list[View]],
    maps: FrameSource | MapSource | Callable[[int, View], FeatureMap] | Mapping[tuple[int, str], FeatureMap],
    *,
    settings: TrackSettings | None = None,
    frames: int | None = None,
    log: RunLog | None = None,
) -> Iterator[TrackedFrame]:
    """Semantics of every frame of a moving scene, in the order of time.

    Every frame is lifted by itself, from its own views, as in the paper; with a forgetting factor above 0 the evidence
    of the frames before counts too, on Gaussians that keep their identity. No frame depends on a later one, and one
    frame is in memory at a time.

    Args:
        sequence: The moving Gaussians, from `load_sequence`.
        views: Its cameras, from `load_moving_views`, or a function of the frame's number.
        maps: An encoder, a source of maps per frame, a function of frame and view, or maps by (frame, stem).
        settings: How to track.
        frames: How many frames, from the first; all that scene and views have if None.
        log: Receives stage times and what was left out.

    Yields:
        What is known at each frame.

    Raises:
        InputError: See `Tracker.step`; or there are no frames.
    """
    tracker = Tracker(_as_source(maps), settings, log)
    for index in range(count_frames(sequence, views, frames)):
        yield tracker.step(sequence.frame(index), views_at(views, index))


def count_frames(sequence: GaussianSequence, views: Any, frames: int | None = None) -> int:
    """Frames that both the scene and its cameras have.

    Raises:
        InputError: More are asked for than there are, or there are none.
    """
    have = [len(sequence)]
    if getattr(views, "frames", None) is not None:
        have.append(views.frames)
    most = min(have)
    if frames is not None and not 1 <= frames <= most:
        raise InputError(f"frames: {frames} are asked for, the scene and its views have {most}")
    return frames or most


def views_at(views: MovingViews | Callable[[int], list[View]], frame: int) -> list[FrameView]:
    """The cameras of a frame."""
    if callable(views):
        return [FrameView(view) for view in views(frame)]
    return views.at(frame)


@dataclass
class _Plain:
    """A function of frame and view as a source."""

    of: Callable[[int, View], FeatureMap]
    needs_image: bool = False

    def encode(self, frame: int, view: FrameView, image: Tensor | None) -> FeatureMap:
        return self.of(frame, view.view)


def _as_source(maps: Any) -> FrameSource:
    if isinstance(maps, Mapping):
        by_name = maps

        def find(frame: int, view: View) -> FeatureMap:
            if (frame, view.stem) not in by_name:
                raise MissingMap(f"frame {frame}, view {view.stem}: no map")
            return by_name[frame, view.stem]

        return _Plain(find)
    if isinstance(maps, MapSource) and hasattr(maps, "space"):
        return EveryFrame(maps)
    if hasattr(maps, "encode"):
        return maps
    if callable(maps):
        return _Plain(maps)
    raise InputError(f"maps: expected an encoder, a function or a dict of feature maps, got {type(maps).__name__}")
