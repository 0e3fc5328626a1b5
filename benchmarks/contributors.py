"""What the strongest contributors of every pixel cost, as ratios to rendering the same view, taken in one run.

python benchmarks/contributors.py [--count 100000] [--rounds 12]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import scenes

from sgwarp.ops import launcher
from sgwarp.ops.splatting.contributors import top_contributors
from sgwarp.ops.splatting.forward import rasterize

PLACES = (1, 4, 8, 16, 32)


def contributors(count: int, cores: int, rounds: int) -> dict[str, float]:
    """Smallest wall time [ms] of rendering a view and of ranking its contributors, all taking turns."""
    gaussians, camera, _ = scenes.room(count)
    launcher.set_threads(cores)
    jobs: dict[str, Callable[[], object]] = {"render": lambda: rasterize(gaussians, camera)}
    jobs |= {f"top {k}": lambda k=k: top_contributors(gaussians, camera, k) for k in PLACES}
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
    for k in PLACES:
        print(f"  top {k:2d} contributors / render {times[f'top {k}'] / times['render']:6.2f}")


if __name__ == "__main__":
    main()
