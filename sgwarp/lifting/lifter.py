"""2D semantics of posed views into the Gaussians of a scene: the paper's projection, and other ways to weigh views."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial

import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.lifting.holes import fill_holes
from sgwarp.lifting.map_reader import MapReader, as_source, has_map
from sgwarp.lifting.map_reader import Maps as Maps
from sgwarp.lifting.reliability import view_reliabilities
from sgwarp.lifting.residuals import residual
from sgwarp.lifting.ridge import Problem, choose_ridge
from sgwarp.lifting.robust import geometric_median
from sgwarp.lifting.settings import LiftMode as LiftMode
from sgwarp.lifting.settings import LiftSettings, check_mode
from sgwarp.ops.launcher import get_threads, set_threads
from sgwarp.ops.splatting.lifting import LiftSums, lift_view
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.runs.isolation import isolated
from sgwarp.runs.log import RunLog
from sgwarp.runs.progress import Report
from sgwarp.scene import FeatureMap, Gaussians, Semantics, View


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
    lift_settings: LiftSettings | None = None,
    settings: RasterSettings | None = None,
    deterministic: bool | None = None,
    device: str | torch.device | None = None,
    threads: int | None = None,
    progress: Report | None = None,
    log: RunLog | None = None,
) -> Semantics:
    """Give every Gaussian a mean of the 2D features that it contributes to.

    With a = alpha times transmittance of a Gaussian at a pixel, its feature is:

    - "weighted": the mean over all pixels of all views, weighted with a; the transpose of the renderer.
    - "squared": the same, weighted with a^2.
    - "strongest": the same over the pixels to which no other Gaussian contributes more.
    - "center": the projection of the paper, the feature at the pixel of its center, if the rendered depth there agrees
      with its own within `tau`, averaged over the views.
    - "robust": the geometric median of the views' weighted means; walks over the views several times.
    - "solve": what renders to the maps as well as it can without leaving the weighted mean (ridge regression); walks
      over the views many times.

    The views pass one by one; one feature map is in memory at a time, or in the last two modes up to half a gigabyte of
    them. The view in the middle goes last, and before it is lifted the features of all others are rendered into it: how
    far they miss its map is the run's `residual`. For "robust" that is the residual of the weighted mean it starts
    from; for "solve" that over the views held out to choose the ridge, where it is chosen.

    Args:
        gaussians: The scene.
        views: Posed views. A view without photograph is rendered from the scene if the source needs an image.
        maps: An encoder, a function of a view, or feature maps by view stem. A view whose map is missing is skipped; a
            source that can tell beforehand offers `has_map(view) -> bool`.
        mode: See above.
        tau, border: As of LiftSettings, which take their place if given.
        share_of_views: Use this share of the views, evenly spread, in (0, 1].
        lift_settings: Of the modes, reliability of views, and filling of holes.
        settings: Thresholds of the rasterizer.
        deterministic: On CUDA, add up in a fixed order; the CPU always does.
        device: Where to compute; the scene's device if None.
        threads: Host threads on the CPU; unchanged if None.
        progress: Called as `progress(done, total, stem)` before the first view and after each.
        log: Receives stage times, what was left out, and the error figures `coverage` (share of the Gaussians that
            some view saw) and `residual` (mean over the pixels of the held-back view of 1 - cosine, or of 1 - agreement
            for labels; only with two views or more); of "solve" also the `ridge`.

    Returns:
        Semantics on the device of the computation, in the space of the maps; zero where nothing was seen.

    Raises:
        InputError: The scene or the views are empty, an argument is out of range, every map is missing, a map holds
            NaN or lives in another space than those before it, or no view sees any Gaussian.
    """
    chosen_settings = lift_settings or LiftSettings(tau=tau, border=border)
    _check_arguments(gaussians, views, mode, share_of_views)
    gaussians = gaussians.to(device or gaussians.device)
    log = log if log is not None else RunLog(device=str(gaussians.device))
    source = as_source(maps)
    chosen = _evenly_spread(views, share_of_views)
    mapped = _middle_last([view for view in chosen if has_map(source, view)])
    log.leave_out("views_by_share", len(views) - len(chosen))
    log.leave_out("views_without_map", len(chosen) - len(mapped))
    log.leave_out("non_finite_gaussians", gaussians.non_finite)
    again = mode in ("robust", "solve") or chosen_settings.reliability
    reader = MapReader(gaussians, source, settings or RasterSettings(), log, keep=again)
    with _thread_count(threads):
        lifting = _Lifting(reader, mode, chosen_settings, deterministic, progress, mapped)
        semantics = lifting.run(len(chosen))
    log.error["coverage"] = semantics.coverage
    finished = semantics
    log.watch(lambda: finished)
    if chosen_settings.fill:
        with log.stage("fill"):
            semantics = fill_holes(gaussians, semantics, chosen_settings.fill)
        log.leave_out(
            "unseen_gaussians_filled", int(semantics.seen.sum()) - round(log.error["coverage"] * len(semantics))
        )
    return semantics


@dataclass
class _Lifting:
    """One run over the views, or several where the mode needs them."""

    reader: MapReader
    mode: LiftMode
    settings: LiftSettings
    deterministic: bool | None
    progress: Report | None
    views: list[View]
    worth: dict[str, float] = field(default_factory=dict)
    steps: int = 0

    def run(self, views: int) -> Semantics:
        """Lift all views; `views` counts those without a map too, for a message."""
        self._tell("")
        sums = self._sums(views)
        if self.settings.reliability:
            self.worth = view_reliabilities(self.reader, self.views, sums.features, sums.weight)
            self.reader.log.error["least_reliability"] = min(self.worth.values())
            del sums
            sums = self._sums(views)
        semantics = self._mean(sums)
        del sums
        if self.mode == "robust":
            features = geometric_median(
                *(self.reader, self.views, semantics.features, self.worth, self.settings),
                deterministic=self.deterministic,
                done=self._done,
            )
            semantics = replace(semantics, features=features)
        elif self.mode == "solve":
            semantics = replace(semantics, features=self._solve(semantics))
        return semantics

    def _sums(self, views: int) -> LiftSums:
        """The sums over all views."""
        sums: LiftSums | None = None
        for number, view in enumerate(self.views, start=1):
            sums = self._add_view(view, sums, number == len(self.views) and not self.worth)
            self._done(view.stem)
            if sums is not None:
                self.reader.log.watch(partial(self._so_far, sums))
        if sums is None:
            raise InputError(f"no feature map for any of the {views} views; file names must match the view stems")
        return sums

    def _add_view(self, view: View, sums: LiftSums | None, measure_residual: bool) -> LiftSums | None:
        """Encode and lift one view; its map is dropped on return, before the next one is made."""
        reader = self.reader
        found = reader.read(view)
        if found is None:
            return sums
        if sums is None:
            sums = LiftSums.zeros(len(reader.gaussians), found.channels, reader.gaussians.device)
        elif measure_residual:
            with reader.log.stage("residual"):
                reader.log.error["residual"] = residual(
                    reader.gaussians, view.camera, found, sums.features, sums.weight, reader.settings
                )
        with reader.log.stage("lift"):
            self._add(view, found, sums)
        return sums

    def _add(self, view: View, found: FeatureMap, sums: LiftSums) -> None:
        worth = self.worth.get(view.stem, 1.0)
        one = sums if worth == 1.0 else LiftSums.zeros(len(sums.weight), sums.channels, sums.weight.device)
        lift_view(
            *(self.reader.gaussians, view.camera, found, one),
            mode="weighted" if self.mode in ("robust", "solve") else self.mode,
            tau=self.settings.tau,
            border=self.settings.border,
            settings=self.reader.settings,
            deterministic=self.deterministic,
        )
        if one is not sums:
            sums.slices.add_(one.slices, alpha=worth)
            sums.weight.add_(one.weight, alpha=worth)
            sums.weight_squared.add_(one.weight_squared, alpha=worth * worth)

    def _so_far(self, sums: LiftSums) -> Semantics:
        """The weighted mean of the views so far; leaves the sums as they are."""
        return self._mean(replace(sums, slices=sums.slices.clone(), weight=sums.weight.clone()))

    def _mean(self, sums: LiftSums) -> Semantics:
        """The weighted mean; overwrites the sums."""
        weight, squared = sums.weight, sums.weight_squared
        space, _, labels = self.reader.kind
        # In place, because a copy costs gigabytes at C = 512; padded sums, which are small, become contiguous.
        features = sums.features.div_(torch.where(weight > 0, weight, 1.0)[:, None]).contiguous()
        semantics = Semantics(
            features=features,
            weight=weight,
            effective_views=weight.square() / torch.where(squared > 0, squared, 1.0),
            space=space,
            fingerprint=self.reader.gaussians.fingerprint,
            labels=labels,
        )
        if not bool(semantics.seen.any()):
            raise InputError("no view sees any Gaussian; scene and cameras are not in the same world frame")
        return semantics

    def _solve(self, semantics: Semantics) -> Tensor:
        problem = Problem(self.reader, self.views, self.worth, self.deterministic, self._done)
        ridge, log = self.settings.ridge, self.reader.log
        if not ridge:
            ridge, missed = choose_ridge(problem, self.settings.iterations)
            log.error["residual"] = missed
        log.error["ridge"] = ridge
        return problem.solve(semantics.features, ridge, self.settings.iterations)

    def _done(self, stem: str) -> None:
        self.steps += 1
        self._tell(stem)

    def _tell(self, stem: str) -> None:
        """Progress counts views of all passes; how many those of "solve" are nobody knows before the end."""
        if self.progress is None:
            return
        passes = 1 + self.settings.reliability + (self.settings.passes if self.mode == "robust" else 0)
        total = max(passes * len(self.views), self.steps)
        self.progress(self.steps, total, stem)


def _check_arguments(gaussians: Gaussians, views: Sequence[View], mode: str, share_of_views: float) -> None:
    if not len(gaussians):
        raise InputError("the scene holds no Gaussians; there is nothing to lift into")
    if not views:
        raise InputError("there are no views to lift from")
    check_mode(mode)
    if not 0 < share_of_views <= 1:
        raise InputError(f"share_of_views: expected a share in (0, 1], got {share_of_views}")


def _evenly_spread(views: Sequence[View], share: float) -> list[View]:
    count = max(1, round(share * len(views)))
    return [views[i * len(views) // count] for i in range(count)]


def _middle_last(views: list[View]) -> list[View]:
    middle = len(views) // 2
    return views[:middle] + views[middle + 1 :] + views[middle : middle + 1]


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
