"""Peak memory of one forward + backward pass, per Gaussian and per pixel. Linux: the peak is read from /proc.

Every point is measured in a process of its own, after a pass over a tiny scene has loaded kernels and libraries; what
counts is how far the resident size then climbs above what it was with the scene in place. Gradients are included, the
scene itself and the image's gradient are not.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

import numpy as np

PIXELS = (640, 480)
COUNT = 100_000
COUNTS = (25_000, 50_000, 100_000, 200_000, 400_000)
SCALES = (0.5, 0.75, 1.0, 1.5, 2.0)  # of the image's sides


def resident(field: str) -> int:
    """Resident size (VmRSS) or its peak (VmHWM) [bytes]."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * int(next(line for line in lines if line.startswith(field)).split()[1])


def probe(count: int, width: int, height: int) -> dict[str, int]:
    """In this process: bytes that forward + backward climbs to, and the number of intersections."""
    import scenes
    from training import step

    from sgwarp.ops.memory import release_scratch
    from sgwarp.ops.splatting import tiles
    from sgwarp.ops.splatting.settings import RasterSettings

    tiny, camera, _ = scenes.room(100)
    step(scenes.with_harmonics(tiny), camera.resized(32, 32), None)()
    gaussians, camera, _ = scenes.room(count)
    gaussians = scenes.with_harmonics(gaussians)
    camera = camera.resized(height, width)
    run = step(gaussians, camera, None)
    release_scratch()
    Path("/proc/self/clear_refs").write_text("5")  # the peak starts again from here
    before = resident("VmRSS")
    run()
    peak = resident("VmHWM") - before
    settings = RasterSettings()
    projected = tiles.project(gaussians, camera, settings)
    lists = tiles.bin_splats(projected, tiles.depth_order(projected), None, camera)
    return {"count": count, "pixels": width * height, "intersections": lists.intersections, "bytes": peak}


def points() -> list[dict[str, int]]:
    """Both sweeps, a process each."""
    sizes = [(count, *PIXELS) for count in COUNTS]
    sizes += [(COUNT, int(scale * PIXELS[0]), int(scale * PIXELS[1])) for scale in SCALES if scale != 1.0]
    results = []
    for size in sizes:
        command = [sys.executable, str(Path(__file__)), *map(str, size)]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        results.append(json.loads(done.stdout.splitlines()[-1]))
    return results


def measure() -> dict[str, object]:
    """Sweeps and the plane fitted to them, printed and returned."""
    from timing import report

    found = points()
    columns = np.array([[1, p["count"], p["pixels"]] for p in found], dtype=np.float64)
    peaks = np.array([p["bytes"] for p in found], dtype=np.float64)
    (constant, per_gaussian, per_pixel), *_ = np.linalg.lstsq(columns, peaks, rcond=None)
    off = np.abs(columns @ (constant, per_gaussian, per_pixel) / peaks - 1).max()
    print("\nPeak memory of forward + backward, colours of degree 3, beside the scene and the image's gradient")
    for p in found:
        size = f"{p['count']} Gaussians, {p['pixels']} pixels, {p['intersections']} intersections [MB]"
        report(size, p["bytes"] / 1e6)
    report("bytes per Gaussian", per_gaussian)
    report("bytes per pixel", per_pixel)
    report("constant [MB]", constant / 1e6)
    report("largest relative distance of a point to the fitted plane", off)
    return {
        "points": found,
        "bytes per Gaussian": per_gaussian,
        "bytes per pixel": per_pixel,
        "constant": constant,
        "largest relative residual": float(off),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Measure one point and print it as JSON.")
    for name in ("count", "width", "height"):
        parser.add_argument(name, type=int)
    options = parser.parse_args()
    print(json.dumps(probe(options.count, options.width, options.height)))
