"""Rendering against the limit: compositing, its growth with threads, and the share of every stage."""

from __future__ import annotations

import limit
import scalar
import scenes
import torch
from limit_training import TrainingLimit
from timing import Run, fastest, plural, report, shares, stage_times

from sgwarp.ops.splatting import tiles
from sgwarp.ops.splatting.forward import composite, packed_colors, rasterize
from sgwarp.ops.splatting.plan import plan_render
from sgwarp.ops.splatting.settings import RasterSettings

SETTINGS = RasterSettings()
MOST_OF_A_STAGE = 0.25  # bound on every stage but compositing


def compositing(count: int, cores: int, rounds: int) -> dict[str, float]:
    """Three colours: the package, the limit, and the plain scalar kernel [ms]."""
    gaussians, camera, _ = scenes.room(count)
    packed = scenes.projected(gaussians, camera)
    arrays = (packed.mean2d, packed.conic, packed.opacity, packed.color, packed.offsets, packed.ids, *camera.size[::-1])
    projected = tiles.project(gaussians, camera, SETTINGS)
    order = tiles.depth_order(projected)
    colors = tiles.shade(gaussians, camera, order, gaussians.sh_degree)
    lists = tiles.bin_splats(projected, order, colors, camera, keep=True)
    runs: dict[str, Run] = {}
    for threads in sorted({1, cores}):
        mark = plural(threads)
        runs[f"limit, {mark}"] = Run(lambda t=threads: limit.composite(*arrays, threads=t)[2], threads)
        runs[f"composite, {mark}"] = Run(lambda: composite(lists, camera, SETTINGS, None, False), threads)
        runs[f"render, {mark}"] = Run(lambda: rasterize(gaussians, camera), threads)
    times = fastest(runs, rounds)
    times["scalar, 1 thread"] = fastest({"scalar": Run(lambda: scalar.composite(*arrays), 1)}, 1)["scalar"]
    times["intersections"] = lists.intersections
    return times


def compositing_seconds(rival: TrainingLimit) -> float:
    rival.forward()
    return rival.seconds()["composite"]


def channels(count: int, width: int, cores: int, rounds: int) -> dict[str, float]:
    """Compositing of feature vectors with `width` channels: the package and the limit [ms]."""
    gaussians, camera, _ = scenes.room(count)
    features = torch.randn(count, width, generator=torch.Generator().manual_seed(0))
    projected = tiles.project(gaussians, camera, SETTINGS)
    order = tiles.depth_order(projected)
    colors = packed_colors(gaussians, camera, features, order, plan_render(gaussians, "features", channels=width))
    lists = tiles.bin_splats(projected, order, colors, camera, keep=True)
    runs: dict[str, Run] = {}
    for threads in sorted({1, cores}):
        rival = TrainingLimit(gaussians, camera, threads, features)
        mark = plural(threads)
        runs[f"limit, {mark}"] = Run(lambda r=rival: compositing_seconds(r), threads)
        runs[f"composite, {mark}"] = Run(lambda: composite(lists, camera, SETTINGS, features, False), threads)
    return fastest(runs, rounds)


def measure(counts: list[int], headline: int, cores: int, rounds: int) -> dict[str, object]:
    """All of it, printed and returned; stages and features for `headline` Gaussians only."""
    results: dict[str, object] = {}
    every = plural(cores)
    for count in counts:
        times = results[f"colours {count}"] = compositing(count, cores, rounds)
        print(f"\nForward, {count} Gaussians, {times['intersections']:.0f} intersections")
        for mark in sorted({"1 thread", every}):
            bound = "<= 1.3" if count == headline else ""
            report(f"composite [ms], {mark}", times[f"composite, {mark}"])
            report(f"composite / limit, {mark}", times[f"composite, {mark}"] / times[f"limit, {mark}"], bound)
        report("scalar, 1 thread / composite, 1 thread", times["scalar, 1 thread"] / times["composite, 1 thread"])
        report(f"render [ms], {every}", times[f"render, {every}"])
        if cores > 1:
            for name in ("composite", "render"):
                gain = times[f"{name}, 1 thread"] / times[f"{name}, {every}"]
                report(f"{name}, 1 thread / {every}", gain, ">= 1.7" if count == headline else "")
    for width in (16, 64):
        times = results[f"channels {width}"] = channels(headline, width, cores, max(2, rounds // 2))
        print(f"\nForward, {headline} Gaussians, {width} channels")
        for mark in sorted({"1 thread", every}):
            report(f"composite [ms], {mark}", times[f"composite, {mark}"])
            report(f"composite / limit, {mark}", times[f"composite, {mark}"] / times[f"limit, {mark}"], "<= 1.3")
        if cores > 1:
            report(
                f"composite, 1 thread / {every}", times["composite, 1 thread"] / times[f"composite, {every}"], ">= 1.7"
            )
    gaussians, camera, _ = scenes.room(headline)
    gaussians = scenes.with_harmonics(gaussians)
    stages = results[f"stages {headline}"] = stage_times(lambda: rasterize(gaussians, camera), cores, rounds)
    print(f"\nStages of a render, {headline} Gaussians, colours of degree 3, {every}")
    for name, share in shares(stages).items():
        report(f"{name} [ms]", stages[name])
        report(f"{name}, share", share, f"<= {MOST_OF_A_STAGE}" if name != "composite" else "")
    return results
