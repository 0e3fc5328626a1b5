"""Peak memory of five million Gaussians at 1920 x 1080: a rendering, a lift of an id map, a step of a fit. Linux.

    python benchmarks/large.py [--count 5000000] [--out benchmarks/large.json]

Each is measured in a process of its own: the largest resident size that the process ever had, scene, libraries and
kernels included. Colors have degree 3: five million Gaussians take 1.2 GB, with gradients and moments 4.7 GB. The step
is the fourth, when all degrees are fitted.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

import scenes
import torch

import sgwarp as sg
from sgwarp.reconstruction.fitting.loop import Loop
from sgwarp.reconstruction.fitting.photographs import Photograph
from sgwarp.reconstruction.fitting.settings import FitSettings
from sgwarp.runs.log import RunLog
from sgwarp.runs.memory import peak
from sgwarp.scene import Camera, FeatureMap, Gaussians, View

WIDTH, HEIGHT = 1920, 1080
IDS = 40


def large_room(count: int) -> tuple[Gaussians, Camera]:
    gaussians, camera, _ = scenes.room(count)
    return scenes.with_harmonics(gaussians), camera.resized(HEIGHT, WIDTH)


def render(count: int) -> float:
    gaussians, camera = large_room(count)
    start = time.perf_counter()
    sg.render(gaussians, camera)
    return time.perf_counter() - start


def lift(count: int) -> float:
    gaussians, camera = large_room(count)
    columns = torch.arange(WIDTH) * 8 // WIDTH
    rows = torch.arange(HEIGHT) * (IDS // 8) // HEIGHT
    ids = rows[:, None] * 8 + columns[None]
    found = FeatureMap("labels", ids=ids, labels=tuple(str(k) for k in range(IDS)))
    start = time.perf_counter()
    sg.lift(gaussians, [View("0", camera)], {"0": found})
    return time.perf_counter() - start


def step(count: int) -> float:
    gaussians, camera = large_room(count)
    image = torch.randint(0, 256, (HEIGHT, WIDTH, 3), dtype=torch.uint8)
    settings = FitSettings(steps=100, cap=count, degree_every=1)
    loop = Loop(settings, [Photograph("0", camera, image)], [], 1.0, torch.device("cpu"), RunLog())
    loop.begin(gaussians)
    del gaussians
    for _ in range(4):  # the first three raise the degree of the colors
        start = time.perf_counter()
        loop._take_step()
    return time.perf_counter() - start


WORKS = {"render": render, "lift": lift, "step": step}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=5_000_000)
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("large.json"))
    parser.add_argument("--only", choices=WORKS, help="measure this in this process and print it")
    options = parser.parse_args()
    if options.only:
        seconds = WORKS[options.only](options.count)
        print(json.dumps({"peak [bytes]": peak(), "seconds": seconds}))
        return
    results: dict[str, object] = {"count": options.count, "pixels": [WIDTH, HEIGHT]}
    for name in WORKS:
        command = [sys.executable, __file__, "--only", name, "--count", str(options.count)]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        row = json.loads(done.stdout.splitlines()[-1])
        results[name] = row
        print(f"{name}: peak {row['peak [bytes]'] / 1e9:.2f} GB, {row['seconds']:.1f} s", flush=True)
    options.out.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
