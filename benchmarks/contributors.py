"""What the strongest contributors of every pixel cost, as ratios to rendering the same view and to the same lists by
hand in C++ (`limit.cpp`, from given tile lists), taken in one run.

python benchmarks/contributors.py [--count 100000] [--rounds 12]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import limit
import numpy as np
import scenes

from sgwarp.ops import launcher
from sgwarp.ops.splatting.contributors import top_contributors
from sgwarp.ops.splatting.forward import rasterize

PLACES = (1, 4, 8, 16, 32)


def contributors(count: int, cores: int, rounds: int) -> dict[str, float]:
    """Smallest wall time [ms] of rendering a view and of ranking its contributors, also by hand; all take turns."""
    gaussians, camera, _ = scenes.room(count)
    launcher.set_threads(cores)
    p = scenes.projected(gaussians, camera)
    lists = (p.mean2d, p.conic, p.opacity, p.offsets, p.ids, p.width, p.height)
    shapes = {k: (p.height, p.width, k) for k in PLACES}
    room = {k: (np.zeros(shape, np.int32), np.zeros(shape, np.float32)) for k, shape in shapes.items()}
    jobs: dict[str, Callable[[], object]] = {"render": lambda: rasterize(gaussians, camera)}
    jobs |= {f"top {k}": lambda k=k: top_contributors(gaussians, camera, k) for k in PLACES}
    jobs |= {f"limit {k}": lambda k=k: limit.rank(*lists, k, cores, room[k]) for k in PLACES}
    times = dict.fromkeys(jobs, float("inf"))
    for _ in range(rounds + 1):  # the first round compiles; its times are beaten
        for name, job in jobs.items():
            start = time.perf_counter()
            job()
            times[name] = min(times[name], 1e3 * (time.perf_counter() - start))
    return times


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--rounds", type=int, default=12)
    options = parser.parse_args()
    cores = launcher.get_threads()
    times = contributors(options.count, cores, options.rounds)
    print(f"{options.count} Gaussians, 640x480, {cores} thread{'s' * (cores > 1)}, render {times['render']:.1f} ms")
    print("  top k contributors [ms], / render, / limit (without projection and binning)")
    for k in PLACES:
        own = times[f"top {k}"]
        print(f"  {k:2d} {own:8.1f} {own / times['render']:6.2f} {own / times[f'limit {k}']:6.2f}")


if __name__ == "__main__":
    main()
