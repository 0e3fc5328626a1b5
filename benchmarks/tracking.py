"""Tracking a moving scene: quality over time, what leaving out the unchanged saves, memory over many frames.

    python -m benchmarks.tracking [quality] [encoder] [time] [memory]

writes its part of benchmarks/tracking.json. The scene is generated (`sgwarp.datasets.moving`); the truth of a pixel is
what its ray hits first.
"""

import argparse
import json
import resource
import statistics
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import torch

from sgwarp.apps.tracking.fusion import FusionSettings
from sgwarp.apps.tracking.tracker import Tracker, TrackSettings
from sgwarp.datasets.moving import LABELS, MovingScene, make_moving_scene, with_label_noise
from sgwarp.io.moving_views import FrameView
from sgwarp.io.sequences import Frame
from sgwarp.metrics.segmentation import ConfusionMatrix
from sgwarp.metrics.tracking import identity_switches, matches, point_tracking
from sgwarp.ops.launcher import get_threads, set_threads
from sgwarp.ops.splatting.forward import rasterize
from sgwarp.ops.splatting.incremental import IncrementalLift
from sgwarp.querying.scores import class_votes
from sgwarp.querying.segmentation import segment_votes
from sgwarp.scene import FeatureMap, Gaussians, View

RESULTS = Path(__file__).with_name("tracking.json")
NAMES = tuple(str(k + 1) for k in range(len(LABELS)))
SHARES = (0.0, 0.01, 0.1, 0.5, 1.0)
# ImageNet's words for what the scene holds; arms and legs have none.
WORDS = ("floor", "pillar", "table", "ball", "crate", "person", "cart", "lamp")


class Truth:
    """Label maps of a scene, made once, with noise that differs per frame and view."""

    def __init__(self, scene: MovingScene, noise: float = 0.0) -> None:
        self.noise, self.random = noise, torch.Generator().manual_seed(1)
        self.clean = {
            (frame, view.stem): scene.truth(frame, view.camera)
            for frame in range(scene.frames)
            for view in scene.cameras
        }
        self.needs_image = False

    def encode(self, frame: int, view: FrameView, image: object) -> FeatureMap:
        labels = self.clean[frame, view.view.stem]
        if self.noise:
            labels = with_label_noise(labels, self.noise, self.random)
        return FeatureMap("labels", ids=labels - 1, labels=NAMES)


def tracked(scene: MovingScene, source: object, settings: TrackSettings) -> Iterator:
    tracker = Tracker(source, settings)
    views = [FrameView(view) for view in scene.cameras]
    for index in range(scene.frames):
        yield tracker.step(Frame(index, scene.gaussians(index), None, scene.moving), views)


def quality(frames: int = 60) -> dict:
    """mIoU over time and identity switches, every frame alone and fused, clean and with 20 % wrong regions."""
    scene = make_moving_scene(0, frames, 12_000, moving_share=0.4)
    rows = {}
    for noise in (0.0, 0.2):
        for name, forgetting in (("per frame", 0.0), ("fused", 0.9)):
            source = Truth(scene, noise)
            over_time, lamp, found, centers = [], [], [], []
            for one in tracked(scene, source, TrackSettings(FusionSettings(forgetting))):
                counts = ConfusionMatrix.empty(len(LABELS))
                images, wanted = [], []
                for view in scene.cameras:
                    channel, _ = segment_votes(one.gaussians, view.camera, one.features, one.weight > 0)
                    truth = source.clean[one.index, view.stem]
                    counts.add(channel, truth - 1)
                    images.append(channel + 1)
                    wanted.append(truth)
                over_time.append(counts.miou)
                lamp.append([0.0 if value != value else value for value in counts.iou[-2:].tolist()])
                found.append(matches(torch.stack(images), torch.stack(wanted)))
                centers.append(centroids(one, scene))
            predicted, truth = (torch.stack(part) for part in zip(*centers, strict=True))
            points = point_tracking(100 * predicted, 100 * truth, torch.isfinite(truth).all(dim=2))
            switch = scene.switch
            rows[f"{name}, noise {noise:g}"] = {
                "miou": statistics.mean(over_time),
                "worst_frame": min(over_time),
                "settled_miou": statistics.mean(over_time[5:]),
                "miou_over_time": [round(value, 4) for value in over_time],
                "identity_switches": identity_switches(found),
                "matched": sum(map(len, found)) / frames,
                "lamp_on_iou": [round(row[1], 3) for row in lamp[switch - 1 : switch + 6]],
                "lamp_off_iou": [round(row[0], 3) for row in lamp[switch - 1 : switch + 6]],
                "centroid_error_cm": points.median_error,
                "centroid_delta": points.delta,
            }
            print(name, noise, {k: v for k, v in rows[f"{name}, noise {noise:g}"].items() if k != "miou_over_time"})
    return {"frames": frames, "cameras": len(scene.cameras), "gaussians": 12_000, "rows": rows}


def centroids(one: object, scene: MovingScene) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean centre of the Gaussians of each label, found and true, [labels, 3]; NaN where there is none."""
    best, channel = one.features.max(dim=1)
    channel = torch.where((best > 0) & (one.weight > 0), channel, -1)
    nothing = torch.full((3,), torch.nan)

    def mean(rows: torch.Tensor) -> torch.Tensor:
        return one.gaussians.means[rows].median(dim=0).values if bool(rows.any()) else nothing

    classes = scene.classes(one.index)
    found = torch.stack([mean(channel == k) for k in range(len(LABELS))])
    return found, torch.stack([mean(classes == k) for k in range(len(LABELS))])


def encoder(frames: int = 60) -> dict:
    """The same with the default encoder, which knows ImageNet's words; body parts count as the person."""
    from sgwarp.encoders.calibration import Scoring
    from sgwarp.encoders.registry import make_encoder

    scene = make_moving_scene(0, frames, 12_000, moving_share=0.4, width=320, height=240)
    table = torch.tensor([0, 1, 2, 3, 4, *[5] * 6, 6, 7, 7])
    network = make_encoder("conse", scene.cameras)
    scoring: Scoring = "evidence"
    rows = {}
    sources = {name: Encoded(network) for name in ("per frame", "fused")}
    for name, forgetting in (("per frame", 0.0), ("fused", 0.9)):
        counts, over_time = ConfusionMatrix.empty(len(WORDS)), []
        for one in tracked(scene, sources[name], TrackSettings(FusionSettings(forgetting))):
            votes = class_votes(one.semantics, WORDS, network, None, scoring)
            now = ConfusionMatrix.empty(len(WORDS))
            for view in scene.cameras[::2]:
                truth = scene.truth(one.index, view.camera)
                channel, _ = segment_votes(one.gaussians, view.camera, votes, one.weight > 0)
                wanted = torch.where(truth > 0, table[truth - 1], -1)
                counts.add(channel, wanted)
                now.add(channel, wanted)
            over_time.append(now.miou)
        sources["fused"].kept = sources["per frame"].kept
        rows[name] = {
            "miou": counts.miou,
            "iou": dict(zip(WORDS, counts.iou.tolist(), strict=True)),
            "worst_frame": min(over_time),
            "change_per_frame": statistics.mean(abs(a - b) for a, b in zip(over_time[1:], over_time, strict=False)),
        }
        print(name, rows[name])
    return {"frames": frames, "words": WORDS, "scoring": scoring, "rows": rows}


class Encoded:
    """An encoder that looks at each picture once."""

    def __init__(self, network: object) -> None:
        self.network, self.kept, self.needs_image = network, {}, True

    def encode(self, frame: int, view: FrameView, image: torch.Tensor) -> FeatureMap:
        key = frame, view.view.stem
        if key not in self.kept:
            self.kept[key] = self.network.encode(view.view, image)
        return self.kept[key]


def label_map(gaussians: Gaussians, classes: torch.Tensor, view: View) -> FeatureMap:
    """Labels as rendered; for timing, where the truth does not matter."""
    one_hot = torch.nn.functional.one_hot(classes, len(LABELS)).float()
    return FeatureMap("labels", ids=rasterize(gaussians, view.camera, one_hot).features.argmax(dim=2), labels=NAMES)


def seconds_per_frame(count: int = 100_000, repeats: int = 3) -> dict:
    """CPU seconds of lifting a frame from 8 views on one thread, where a compact part of the scene moves.

    CPU time of one thread, because it depends least on what else the machine does.
    """
    set_threads(1)
    torch.set_num_threads(1)
    scene = make_moving_scene(0, 60, count, width=640, height=360)
    start, classes = scene.gaussians(20), scene.classes(20)
    corner = torch.tensor([-2.2, 0.0, -2.2])
    nearest = (start.means - corner).norm(dim=1).argsort()
    scattered = torch.randperm(count, generator=torch.Generator().manual_seed(2))
    rows = {}
    cases = [(f"{share:.0%}", nearest[: int(share * count)]) for share in SHARES]
    for name, moving in [*cases, ("1% scattered", scattered[: count // 100])]:
        rows[name] = measured(start, classes, scene.cameras, moving, repeats)
        print(name, rows[name])
    return {"gaussians": count, "views": len(scene.cameras), "size": [640, 360], "threads": get_threads(), "rows": rows}


def measured(start: Gaussians, classes: torch.Tensor, views: list[View], moving: torch.Tensor, repeats: int) -> dict:
    lifts = {"incremental": IncrementalLift(), "full": IncrementalLift(rebuild_above=0.0)}
    times: dict[str, list[float]] = {name: [] for name in lifts}
    gaussians = start
    for step in range(repeats + 2):
        means = gaussians.means.clone()
        means[moving] += torch.tensor([0.02, 0.0, 0.01]) * (1 if step % 2 else -1)
        gaussians = replace(gaussians, means=means)
        maps = [label_map(gaussians, classes, view) for view in views]
        sums = {}
        for name, lift in lifts.items():
            begun = time.process_time()
            lift.begin(gaussians)
            for view, feature_map in zip(views, maps, strict=True):
                lift.add(view.stem, view.camera, feature_map)
            sums[name] = lift.finish()
            if step >= 2:  # the first frames compile, and fill what is kept
                times[name].append(time.process_time() - begun)
        assert torch.equal(sums["full"].slices, sums["incremental"].slices)
        assert torch.equal(sums["full"].weight, sums["incremental"].weight)
    best = {name: statistics.median(values) for name, values in times.items()}
    work = lifts["incremental"].work
    return {
        **best,
        "full_over_incremental": best["full"] / best["incremental"],
        "tiles_left_out": work.left_out,
        "kept_megabytes": lifts["incremental"].kept_bytes / 1e6,
    }


def memory(frames: int = 500) -> dict:
    """Largest resident set after so many frames, fused; 5,000 Gaussians, 8 views of 80 x 60."""
    scene = make_moving_scene(0, frames, 5_000, width=80, height=60, moving_share=0.4)
    tracker = Tracker(_OnTheFly(scene), TrackSettings())
    views = [FrameView(view) for view in scene.cameras]
    peaks = {}
    for index in range(frames):
        tracker.step(Frame(index, scene.gaussians(index), None, scene.moving), views)
        if index + 1 in (20, 50, 100, 200, 300, 400, 500):
            peaks[index + 1] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            print(index + 1, f"{peaks[index + 1]:.1f} MB", flush=True)
    return {"frames": frames, "peak_megabytes": peaks}


class _OnTheFly:
    def __init__(self, scene: MovingScene) -> None:
        self.scene, self.needs_image = scene, False

    def encode(self, frame: int, view: FrameView, image: object) -> FeatureMap:
        labels = self.scene.truth(frame, view.view.camera)
        return FeatureMap("labels", ids=labels - 1, labels=NAMES)


PARTS = {"quality": quality, "encoder": encoder, "time": seconds_per_frame, "memory": memory}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="*", default=list(PARTS), help=", ".join(PARTS))
    chosen = parser.parse_args().parts
    results = json.loads(RESULTS.read_text()) if RESULTS.is_file() else {}
    for name in chosen:
        results[name] = PARTS[name]()
    RESULTS.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
