"""First call on a machine whose kernel cache is empty: every kernel that it needs is compiled."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

KINDS = ("render", "forward + backward")


def first_call(kind: str) -> float:
    """In this process: seconds of one call."""
    import scenes
    from training import step

    from sgwarp.ops.splatting.forward import rasterize

    gaussians, camera, _ = scenes.room(10_000)
    gaussians = scenes.with_harmonics(gaussians)
    job = step(gaussians, camera, None) if kind == KINDS[1] else lambda: rasterize(gaussians, camera)
    start = time.perf_counter()
    job()
    return time.perf_counter() - start


def measure() -> dict[str, float]:
    """Both kinds of call, a process and a fresh cache each; printed and returned [s]."""
    from timing import report

    results: dict[str, float] = {}
    print("\nFirst call, empty kernel cache")
    for kind in KINDS:
        with tempfile.TemporaryDirectory() as cache:
            environment = os.environ | {"WARP_CACHE_PATH": cache}
            command = [sys.executable, str(Path(__file__)), kind]
            done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
        results[kind] = float(done.stdout.splitlines()[-1])
        report(f"{kind} [s]", results[kind], "<= 30")
    return results


if __name__ == "__main__":
    print(first_call(sys.argv[1]))
