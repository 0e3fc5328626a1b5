"""Error against run time: one knob at a time, everything else at its default."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from sgwarp.evaluation.report.oracle import Patches, psnr
from sgwarp.lifting.lifter import lift
from sgwarp.metrics.segmentation import ConfusionMatrix
from sgwarp.ops.splatting.forward import rasterize
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.querying.scores import class_votes
from sgwarp.querying.segmentation import segment_votes
from sgwarp.runs.progress import Report
from sgwarp.scene import Camera, FeatureMap, Gaussians, View

DEFAULT = "default"
DEFAULTS = RasterSettings()
ALPHA_MIN = (1 / 1024, 1 / 128, 1 / 64, 1 / 32)
TRANSMITTANCE_MIN = (1e-5, 1e-3, 1e-2, 1e-1)
SHARES_OF_GAUSSIANS = (0.75, 0.5, 0.25, 0.1)
SHARES_OF_VIEWS = (0.75, 0.5, 0.25, 0.1)
DOWNSCALES = (2, 4, 8)


@dataclass
class Trial:
    """One setting of one knob, and what it costs.

    Attributes:
        knob: What was turned; "default" for nothing.
        setting: To what.
        seconds: Median run time: per view for renderings, of the whole way from labels to segmented views for lifting.
        spread: Median distance of the runs from that median [s].
        errors: Rendering: `max`, `mean` and `psnr` [dB] against the oracle, `psnr_photograph` [dB] where there are
            photographs. Lifting: `miou`, `pixel_accuracy` and `coverage`.
    """

    knob: str
    setting: str
    seconds: float
    spread: float
    errors: dict[str, float] = field(default_factory=dict)

    @property
    def name(self) -> str:
        return self.knob if self.knob == DEFAULT else f"{self.knob} {self.setting}"


def pareto_front(trials: Sequence[Trial], quality: str) -> list[Trial]:
    """The trials that no other beats in both run time and `quality` (larger is better), fastest first."""
    front: list[Trial] = []
    for trial in sorted(trials, key=lambda t: (t.seconds, -t.errors[quality])):
        if not front or trial.errors[quality] > front[-1].errors[quality]:
            front.append(trial)
    return front


Draw = Callable[[Camera], Tensor]


def rendering_variants(gaussians: Gaussians, seed: int) -> list[tuple[str, str, Draw]]:
    """(knob, setting, how to render) of everything that can be turned about rendering; the default comes first."""

    def with_settings(settings: RasterSettings, scene: Gaussians = gaussians) -> Draw:
        return lambda camera: rasterize(scene, camera, settings=settings).features

    variants = [(DEFAULT, "", with_settings(DEFAULTS))]
    variants += [
        ("alpha_min", f"1/{1 / value:.0f}", with_settings(replace(DEFAULTS, alpha_min=value))) for value in ALPHA_MIN
    ]
    variants += [
        ("transmittance_min", f"{value:g}", with_settings(replace(DEFAULTS, transmittance_min=value)))
        for value in TRANSMITTANCE_MIN
    ]
    variants += [
        ("SH degree", str(degree), with_settings(replace(DEFAULTS, sh_degree=degree)))
        for degree in reversed(range(gaussians.sh_degree))
    ]
    importance = gaussians.opacities * gaussians.scales.sort(dim=1).values[:, 1:].prod(dim=1)  # opacity times area
    dice = torch.rand(len(gaussians), generator=torch.Generator().manual_seed(seed)).to(gaussians.device)
    for knob, score in (("largest Gaussians", importance), ("random Gaussians", dice)):
        order = torch.nan_to_num(score).argsort(descending=True)
        for share in SHARES_OF_GAUSSIANS:
            kept = order[: max(1, round(share * len(gaussians)))].sort().values
            variants.append((knob, f"{share:.0%}", with_settings(DEFAULTS, gaussians.subset(kept))))
    return variants + [("resolution", f"1/{factor}", _enlarged(gaussians, factor)) for factor in DOWNSCALES]


def _enlarged(gaussians: Gaussians, factor: int) -> Draw:
    """Render fewer pixels and interpolate between them."""

    def draw(camera: Camera) -> Tensor:
        height, width = (max(1, round(side / factor)) for side in camera.size)
        small = rasterize(gaussians, camera.resized(height, width)).features.permute(2, 0, 1)[None]
        return torch.nn.functional.interpolate(small, camera.size, mode="bilinear")[0].permute(1, 2, 0)

    return draw


def sweep_rendering(
    gaussians: Gaussians, views: Sequence[View], truth: Sequence[Patches], repeats: int, seed: int, progress: Report
) -> list[Trial]:
    """Render the views with each setting of each knob.

    Args:
        gaussians: The scene.
        views: Where to look from.
        truth: What the oracle sees in each of them.
        repeats: Times that everything is rendered; the median is reported. All settings take turns, so that a machine
            that is busy for a while slows all of them down.
        seed: Of the random share of Gaussians.
        progress: Called before the first repetition and after each setting.
    """
    variants = rendering_variants(gaussians, seed)
    photographs = [view.image() if view.image_path is not None else None for view in views]
    trials = []
    for knob, setting, draw in variants:
        images = [draw(view.camera).cpu() for view in views]  # compiles what is new, too
        pairs = [patches.pairs(image) for patches, image in zip(truth, images, strict=True)]
        mine, exact = (torch.cat(parts) for parts in zip(*pairs, strict=True))
        difference = (mine - exact).abs()
        errors = {"max": float(difference.max()), "mean": float(difference.mean()), "psnr": psnr(mine, exact)}
        shown = [
            (i.clamp(0, 1).flatten(), p.flatten()) for i, p in zip(images, photographs, strict=True) if p is not None
        ]
        if shown:
            errors["psnr_photograph"] = psnr(*(torch.cat(parts) for parts in zip(*shown, strict=True)))
        trials.append(Trial(knob, setting, 0.0, 0.0, errors))
    rounds = [lambda draw=draw: [draw(view.camera) for view in views] for _, _, draw in variants]
    for trial, times in zip(trials, _times(rounds, repeats, gaussians.device, progress), strict=True):
        trial.seconds, trial.spread = (value / len(views) for value in _median(times))
    return trials


@dataclass(frozen=True)
class LiftVariant:
    """One way of getting labels into the scene and out again."""

    knob: str
    setting: str
    mode: str = "weighted"
    share_of_views: float = 1.0
    half: bool = False
    settings: RasterSettings = DEFAULTS


def lifting_variants() -> list[LiftVariant]:
    """Everything that can be turned about lifting; the default comes first."""
    variants = [LiftVariant(DEFAULT, ""), LiftVariant("lift mode", "center", mode="center")]
    variants += [LiftVariant("features", "fp16", half=True)]
    variants += [LiftVariant("views", f"{share:.0%}", share_of_views=share) for share in SHARES_OF_VIEWS]
    variants += [
        LiftVariant("alpha_min", f"1/{1 / value:.0f}", settings=replace(DEFAULTS, alpha_min=value))
        for value in ALPHA_MIN
    ]
    return variants + [
        LiftVariant("transmittance_min", f"{value:g}", settings=replace(DEFAULTS, transmittance_min=value))
        for value in TRANSMITTANCE_MIN
    ]


def sweep_lifting(
    gaussians: Gaussians,
    views: Sequence[View],
    held_out: Sequence[View],
    maps: dict[str, FeatureMap],
    repeats: int,
    progress: Report,
) -> list[Trial]:
    """Lift the label images of `views`, segment the views in `held_out`, and compare with theirs.

    `maps` holds one-hot labels of both, by stem.
    """
    trials, rounds = [], []
    for variant in lifting_variants():
        classes, coverage = _lift_and_segment(gaussians, views, held_out, maps, variant)
        labels = maps[held_out[0].stem].labels
        assert labels is not None
        confusion = ConfusionMatrix.empty(len(labels))
        for view, predicted in zip(held_out, classes, strict=True):
            ids = maps[view.stem].ids
            assert ids is not None
            confusion.add(predicted, ids[0])
        errors = {"miou": confusion.miou, "pixel_accuracy": confusion.pixel_accuracy, "coverage": coverage}
        trials.append(Trial(variant.knob, variant.setting, 0.0, 0.0, errors))
        rounds.append(lambda variant=variant: _lift_and_segment(gaussians, views, held_out, maps, variant))
    for trial, times in zip(trials, _times(rounds, repeats, gaussians.device, progress), strict=True):
        trial.seconds, trial.spread = _median(times)
    return trials


def _lift_and_segment(
    gaussians: Gaussians,
    views: Sequence[View],
    held_out: Sequence[View],
    maps: dict[str, FeatureMap],
    variant: LiftVariant,
) -> tuple[list[Tensor], float]:
    """Class at every pixel of each held-out view, and the share of the Gaussians that were seen."""
    semantics = lift(
        gaussians,
        views,
        maps,
        variant.mode,  # type: ignore[arg-type]
        share_of_views=variant.share_of_views,
        settings=variant.settings,
    )
    if variant.half:
        semantics = replace(semantics, features=semantics.features.half())
    votes = class_votes(semantics, list(semantics.labels or ()))
    found = [
        segment_votes(gaussians, view.camera, votes, semantics.seen, settings=variant.settings)[0].cpu()
        for view in held_out
    ]
    return found, semantics.coverage


def _times(
    rounds: Sequence[Callable[[], object]], repeats: int, device: torch.device, progress: Report
) -> list[list[float]]:
    """Wall-clock seconds of each repetition of each; they take turns."""
    times: list[list[float]] = [[] for _ in rounds]
    total = repeats * len(rounds)
    progress(0, total, "")
    for repetition in range(repeats):
        for number, run in enumerate(rounds):
            start = time.perf_counter()
            run()
            if device.type == "cuda":
                torch.cuda.synchronize(device)
            times[number].append(time.perf_counter() - start)
            progress(repetition * len(rounds) + number + 1, total, "")
    return times


def _median(times: Sequence[float]) -> tuple[float, float]:
    """Median, and the median distance from it."""
    middle = statistics.median(times)
    return middle, statistics.median(abs(value - middle) for value in times)
