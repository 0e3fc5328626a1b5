"""Rasterizer and lifting against their limits: ratios taken in one run, printed and written to JSON.

    python -m benchmarks [--counts 20000 100000 500000] [--out benchmarks/results.json]

(a) a plain scalar Warp kernel, one thread per pixel (scalar.py); (b) the same work by hand in C++ with OpenMP
(limit.cpp), called "the limit"; (c) one host thread against all. Every figure is the smallest of several runs, the
runs of two rivals taking turns, so that a busy machine disturbs both; all of them write to fresh memory. Absolute times
are this machine's; carry over the ratios only.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path

# OpenMP's threads otherwise go on spinning after the limit's turn, on the cores that its rival then needs.
os.environ["OMP_WAIT_POLICY"] = "passive"

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parent))

import limit
import scalar
import scenes

from sgwarp.ops import launch, tiles
from sgwarp.ops.lift import LiftSums, lift_view
from sgwarp.ops.rasterize import composite, rasterize
from sgwarp.ops.settings import RasterSettings
from sgwarp.scene import FeatureMap

SETTINGS = RasterSettings()
Job = Callable[[], object]


def fastest(jobs: dict[str, Job], rounds: int) -> dict[str, float]:
    """Smallest wall time of each job [ms], the jobs taking turns."""
    best = dict.fromkeys(jobs, float("inf"))
    for _ in range(rounds + 1):  # the first round compiles and warms up; its times are beaten
        for name, job in jobs.items():
            start = time.perf_counter()
            job()
            best[name] = min(best[name], 1e3 * (time.perf_counter() - start))
    return best


def with_threads(count: int, job: Job) -> Job:
    def run() -> None:
        launch.set_threads(count)
        job()

    return run


def label_image(height: int, width: int) -> np.ndarray:
    """About twenty segments with round borders, as a panoptic map has them."""
    y, x = np.mgrid[:height, :width] / height
    cells = np.floor(3 * (x + 0.1 * np.sin(7 * y))) + 100 * np.floor(3 * (y + 0.1 * np.cos(5 * x)))
    return np.unique(cells, return_inverse=True)[1].reshape(height, width).astype(np.int32)


def forward(count: int, cores: int, rounds: int) -> dict[str, float]:
    """Stages of one view and compositing against the scalar kernel and the limit."""
    gaussians, camera, _ = scenes.room(count)
    height, width = camera.size
    packed = scenes.projected(gaussians, camera)
    arrays = (packed.mean2d, packed.conic, packed.opacity, packed.color, packed.offsets, packed.ids, width, height)
    launch.set_threads(cores)
    projected = tiles.project(gaussians, camera, SETTINGS)
    order = tiles.depth_order(projected)
    colors = tiles.shade(gaussians, camera, order, SETTINGS)
    lists = tiles.bin_splats(projected, order, colors, camera, SETTINGS)
    jobs: dict[str, Job] = {}
    for threads in sorted({1, cores}):
        mark = f"{threads} thread" + "s" * (threads > 1)
        jobs[f"limit, {mark}"] = lambda t=threads: limit.composite(*arrays, threads=t)
        jobs[f"composite, {mark}"] = with_threads(threads, lambda: composite(lists, camera, SETTINGS, None, False))
        stages: dict[str, Job] = {
            "project": lambda: tiles.project(gaussians, camera, SETTINGS),
            "order": lambda: tiles.depth_order(projected),
            "shade": lambda: tiles.shade(gaussians, camera, order, SETTINGS),
            "bin": lambda: tiles.bin_splats(projected, order, colors, camera, SETTINGS),
            "render": lambda: rasterize(gaussians, camera),
        }
        jobs |= {f"{name}, {mark}": with_threads(threads, job) for name, job in stages.items()}
    times = fastest(jobs, rounds)
    times["scalar, 1 thread"] = fastest({"scalar": lambda: scalar.composite(*arrays)}, 2)["scalar"]
    times["intersections"] = lists.intersections
    return times


def lifting(count: int, cores: int, rounds: int) -> dict[str, float]:
    """Lifting one view: ids against its render, dense channels against the limit's inner loops."""
    gaussians, camera, _ = scenes.room(count)
    height, width = camera.size
    packed = scenes.projected(gaussians, camera)
    geometry = (packed.mean2d, packed.conic, packed.opacity, packed.offsets, packed.ids)
    ids = label_image(height, width)
    labels = tuple(map(str, range(int(ids.max()) + 1)))
    id_map = FeatureMap(space="labels", ids=torch.from_numpy(ids), labels=labels)
    id_sums = LiftSums.zeros(count, len(labels))
    vectors = FeatureMap(space="v", ids=torch.from_numpy(ids), vectors=torch.randn(len(labels), 512))
    vector_sums = LiftSums.zeros(count, 512)
    launch.set_threads(cores)
    jobs: dict[str, Job] = {
        "render": lambda: rasterize(gaussians, camera),
        "ids, one-hot": lambda: lift_view(gaussians, camera, id_map, id_sums),
        "ids, 512-d vectors": lambda: lift_view(gaussians, camera, vectors, vector_sums),
        "ids, limit": lambda: limit.lift_ids(*geometry, ids, len(labels), threads=cores),
    }
    times = fastest(jobs, rounds)
    for channels in (16, 64, 512):
        dense = torch.randn(height, width, channels)
        image = dense.numpy()
        sums = LiftSums.zeros(count, channels)
        feature_map = FeatureMap(space="d", dense=dense)
        jobs = {
            f"dense {channels}": lambda m=feature_map, s=sums: lift_view(gaussians, camera, m, s),
            f"dense {channels}, limit": lambda i=image: limit.lift_dense(*geometry, i, threads=cores),
        }
        times |= fastest(jobs, max(2, rounds // 3))
    return times


def report(name: str, value: float, bound: str = "") -> None:
    print(f"  {name:58s} {value:8.2f}  {bound}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--counts", type=int, nargs="+", default=[20_000, 100_000, 500_000])
    parser.add_argument("--rounds", type=int, default=12)
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("results.json"))
    options = parser.parse_args()
    errors = limit.self_check()
    cores = launch.get_threads()
    every = f"{cores} thread" + "s" * (cores > 1)
    results: dict[str, object] = {"machine": platform.processor() or platform.machine(), "cores": cores}
    results["limit self-check"] = errors
    for count in options.counts:
        times = forward(count, cores, options.rounds)
        results[f"forward {count}"] = times
        print(f"\n{count} Gaussians, 640x480, {times['intersections']:.0f} intersections")
        for stage in ("project", "order", "shade", "bin", "composite", "render"):
            report(f"{stage} [ms], {every}", times[f"{stage}, {every}"])
        report("composite / limit, 1 thread", times["composite, 1 thread"] / times["limit, 1 thread"], "<= 1.8")
        report(f"composite / limit, {every}", times[f"composite, {every}"] / times[f"limit, {every}"], "<= 1.8")
        report("scalar / composite, 1 thread", times["scalar, 1 thread"] / times["composite, 1 thread"])
        report(f"scalar / composite, {every}", times["scalar, 1 thread"] / times[f"composite, {every}"], ">= 15")
        if cores > 1:
            report(f"composite, 1 thread / {every}", times["composite, 1 thread"] / times[f"composite, {every}"])
            report(f"render, 1 thread / {every}", times["render, 1 thread"] / times[f"render, {every}"])
    times = lifting(100_000, cores, options.rounds)
    results["lifting 100000"] = times
    print(f"\nLifting one view, 100000 Gaussians, 640x480, {every}")
    report("ids, one-hot / render", times["ids, one-hot"] / times["render"], "<= 1.5")
    report("ids, 512-d vectors / render", times["ids, 512-d vectors"] / times["render"])
    report("ids, one-hot / limit (without projection and binning)", times["ids, one-hot"] / times["ids, limit"])
    for channels in (16, 64, 512):
        ours, bound = times[f"dense {channels}"], times[f"dense {channels}, limit"]
        report(f"dense {channels} [ms]", ours)
        report(f"dense {channels} / limit (without projection and binning)", ours / bound)
    options.out.write_text(json.dumps(results, indent=1) + "\n")
    print(f"\nwritten to {options.out}")


if __name__ == "__main__":
    main()
