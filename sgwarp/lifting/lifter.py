"""The paper's projection: 2D semantics of posed views into the Gaussians of a scene, one view at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from sgwarp.encoders.base import MapSource, MissingMap
from sgwarp.errors import InputError
from sgwarp.lifting.residuals import residual
from sgwarp.ops.launcher import get_threads, set_threads
from sgwarp.ops.splatting.lifting import LiftSums, lift_view
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.rendering.renderer import render
from sgwarp.runs.isolation import isolated
from sgwarp.runs.log import RunLog
from sgwarp.runs.progress import Report
from sgwarp.scene import FeatureMap, Gaussians, Semantics, View

LiftMode = Literal["weighted", "center"]
Maps = MapSource | Callable[[View], FeatureMap] | Mapping[str, FeatureMap]


@isolated
def lift(
    gaussians: Gaussians,
    views: Sequence[View],
    maps: Maps,
    mode: LiftMode = "weighted",
    *,
    tau: float = 0.05,
    border: int = 10,
    share_of_views: float = 1.0,
    settings: RasterSettings | None = None,
    deterministic: bool | None = None,
    device: str | torch.device | None = None,
    threads: int | None = None,
    progress: Report | None = None,
    log: RunLog | None = None,
) -> Semantics:
    """Give every Gaussian the mean of the 2D features that it contributes to.

    "weighted" is the transpose of the renderer: the feature of a Gaussian is the mean over all pixels of all views,
    weighted with its alpha times transmittance there. "center" is the projection of the paper: the feature at the pixel
    of its centre, if the rendered depth there agrees with its own within `tau`, averaged over the views.

    The views pass one by one; only one feature map is in memory at a time. The view in the middle goes last, and before
    it is lifted the features of all others are rendered into it: how far they miss its map is the run's `residual`.

    Args:
        gaussians: The scene.
        views: Posed views. A view without photograph is rendered from the scene if the source needs an image.
        maps: An encoder, a function of a view, or feature maps by view stem. A view whose map is missing is skipped; a
            source that can tell beforehand offers `has_map(view) -> bool`.
        mode: "weighted" or "center".
        tau: Relative depth tolerance of mode "center".
        border: Pixels along the image edge that mode "center" ignores.
        share_of_views: Use this share of the views, evenly spread, in (0, 1].
        settings: Thresholds of the rasterizer.
        deterministic: On CUDA, add up in a fixed order; the CPU always does.
        device: Where to compute; the scene's device if None.
        threads: Host threads on the CPU; unchanged if None.
        progress: Called as `progress(done, total, stem)` before the first view and after each.
        log: Receives stage times, what was left out, and the error figures `coverage` (share of the Gaussians that
            some view saw) and `residual` (mean over the pixels of the held-back view of 1 - cosine, or of 1 - agreement
            for labels; only with two views or more).

    Returns:
        Semantics on the device of the computation, in the space of the maps; zero where nothing was seen.

    Raises:
        InputError: The scene or the views are empty, an argument is out of range, every map is missing, a map holds
            NaN or lives in another space than those before it, or no view sees any Gaussian.
    """
    _check_arguments(gaussians, views, mode, tau, border, share_of_views)
    gaussians = gaussians.to(device or gaussians.device)
    log = log if log is not None else RunLog(device=str(gaussians.device))
    report = progress or (lambda done, total, stem: None)
    source = _as_source(maps)
    chosen = _evenly_spread(views, share_of_views)
    mapped = _middle_last([view for view in chosen if _has_map(source, view)])
    log.leave_out("views_by_share", len(views) - len(chosen))
    log.leave_out("views_without_map", len(chosen) - len(mapped))
    log.leave_out("non_finite_gaussians", gaussians.non_finite)

    options = {"mode": mode, "tau": tau, "border": border, "deterministic": deterministic}
    lifting = _Lifting(gaussians, source, settings or RasterSettings(), options, log)
    report(0, len(mapped), "")
    with _thread_count(threads):
        for done, view in enumerate(mapped, start=1):
            lifting.add(view, measure_residual=done == len(mapped))
            report(done, len(mapped), view.stem)
    semantics = lifting.mean(len(chosen))
    log.error["coverage"] = semantics.coverage
    return semantics


@dataclass
class _Lifting:
    """The sums over the views so far, and what the maps have in common."""

    gaussians: Gaussians
    source: MapSource
    settings: RasterSettings
    options: dict[str, Any]
    log: RunLog
    sums: LiftSums | None = None
    stem: str = ""  # view of the first map, for messages
    kind: tuple[str, int, tuple[str, ...] | None] = ("", 0, None)  # space, channels and labels of the first map

    def add(self, view: View, measure_residual: bool) -> None:
        """Encode and lift one view; its map is dropped on return, before the next one is made."""
        feature_map = self._encode(view)
        if feature_map is None:
            return
        self._check(view, feature_map)
        if self.sums is None:
            self.sums = LiftSums.zeros(len(self.gaussians), feature_map.channels, self.gaussians.device)
        elif measure_residual:
            with self.log.stage("residual"):
                self.log.error["residual"] = residual(
                    self.gaussians, view.camera, feature_map, self.sums.features, self.sums.weight, self.settings
                )
        with self.log.stage("lift"):
            lift_view(self.gaussians, view.camera, feature_map, self.sums, settings=self.settings, **self.options)

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
        if self.sums is None:
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

    def mean(self, views: int) -> Semantics:
        """The weighted mean; frees the sums."""
        if self.sums is None:
            raise InputError(f"no feature map for any of the {views} views; file names must match the view stems")
        weight, squared = self.sums.weight, self.sums.weight_squared
        space, _, labels = self.kind
        # In place, because a copy costs gigabytes at C = 512; padded sums, which are small, become contiguous.
        features = self.sums.features.div_(torch.where(weight > 0, weight, 1.0)[:, None]).contiguous()
        semantics = Semantics(
            features=features,
            weight=weight,
            effective_views=weight.square() / torch.where(squared > 0, squared, 1.0),
            space=space,
            fingerprint=self.gaussians.fingerprint,
            labels=labels,
        )
        if not bool(semantics.seen.any()):
            raise InputError("no view sees any Gaussian; scene and cameras are not in the same world frame")
        return semantics


@dataclass
class _PlainMaps:
    """A function of a view, or feature maps by stem, as a MapSource."""

    of_view: Callable[[View], FeatureMap]
    has_map: Callable[[View], bool] = lambda view: True
    space: str = ""
    needs_image: bool = False

    def encode(self, view: View, image: Tensor | None) -> FeatureMap:
        return self.of_view(view)


def _as_source(maps: Maps) -> MapSource:
    if isinstance(maps, MapSource):
        return maps
    if isinstance(maps, Mapping):
        by_stem = maps
        return _PlainMaps(lambda view: by_stem[view.stem], lambda view: view.stem in by_stem)
    if callable(maps):
        return _PlainMaps(maps)
    raise InputError(f"maps: expected an encoder, a function or a dict of feature maps, got {type(maps).__name__}")


def _check_arguments(
    gaussians: Gaussians, views: Sequence[View], mode: str, tau: float, border: int, share_of_views: float
) -> None:
    if not len(gaussians):
        raise InputError("the scene holds no Gaussians; there is nothing to lift into")
    if not views:
        raise InputError("there are no views to lift from")
    if mode not in get_args(LiftMode):
        raise InputError(f"mode: '{mode}' is not one of {', '.join(get_args(LiftMode))}")
    if not tau > 0 or border < 0:
        raise InputError(f"tau must be positive and border not negative, got {tau} and {border}")
    if not 0 < share_of_views <= 1:
        raise InputError(f"share_of_views: expected a share in (0, 1], got {share_of_views}")


def _evenly_spread(views: Sequence[View], share: float) -> list[View]:
    count = max(1, round(share * len(views)))
    return [views[i * len(views) // count] for i in range(count)]


def _middle_last(views: list[View]) -> list[View]:
    middle = len(views) // 2
    return views[:middle] + views[middle + 1 :] + views[middle : middle + 1]


def _has_map(source: MapSource, view: View) -> bool:
    """Whether the source has a map of the view; one that cannot tell raises MissingMap when it is asked for it."""
    has_map = getattr(source, "has_map", None)
    return has_map is None or bool(has_map(view))


@contextmanager
def _thread_count(threads: int | None) -> Iterator[None]:
    """Use `threads` host threads within the block."""
    if threads is None:
        yield
        return
    before = get_threads()
    set_threads(threads)
    try:
        yield
    finally:
        set_threads(before)
