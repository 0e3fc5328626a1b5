"""Rasterizer, training and lifting against their limits: ratios taken in one run, printed and written to JSON.

    python -m benchmarks [--only forward,training,lifting,growth,memory,cold] [--out benchmarks/results.json]

(a) a plain scalar Warp kernel, one thread per pixel (scalar.py); (b) the same work by hand in C++ with OpenMP
(limit.cpp, limit_training.cpp), called "the limit"; (c) one host thread against all. Every figure is the smallest of
several runs, the runs of two rivals taking turns, so that a busy machine disturbs both. Absolute times are this
machine's; carry over the ratios only. Sections that are not run keep their figures in the file.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from collections.abc import Callable
from pathlib import Path

# OpenMP's threads otherwise go on spinning after the limit's turn, on the cores that its rival then needs.
os.environ["OMP_WAIT_POLICY"] = "passive"
sys.path.insert(0, str(Path(__file__).parent))

import cold
import forward
import growth
import lifting
import limit
import limit_training
import memory
import training

from sgwarp.ops import launcher

SECTIONS = ("forward", "training", "lifting", "growth", "memory", "cold")
CHECKED = {"forward", "training", "lifting", "growth"}  # use the limits


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default=",".join(SECTIONS), help="sections, with commas between them")
    parser.add_argument("--count", type=int, default=100_000, help="Gaussians of the headline figures")
    parser.add_argument("--rounds", type=int, default=12)
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("results.json"))
    parser.add_argument("--plot", type=Path, help="draw the growth into this file")
    options = parser.parse_args()
    chosen = options.only.split(",")
    unknown = set(chosen) - set(SECTIONS)
    if unknown:
        parser.error(f"--only: unknown section {', '.join(sorted(unknown))}; there are {', '.join(SECTIONS)}")
    cores = launcher.get_threads()
    results = json.loads(options.out.read_text()) if options.out.exists() else {}
    results |= {"machine": platform.processor() or platform.machine(), "cores": cores}
    if CHECKED & set(chosen):
        results["limit self-check"] = limit.self_check()
        results["training limit self-check"] = limit_training.self_check()
    count, rounds = options.count, options.rounds
    sections: dict[str, Callable[[], object]] = {
        "forward": lambda: forward.measure(sorted({20_000, count, 500_000}), count, cores, rounds),
        "training": lambda: training.measure(count, cores, rounds),
        "lifting": lambda: lifting.measure(count, cores, rounds),
        "growth": lambda: growth.measure(cores, max(2, rounds // 2)),
        "memory": memory.measure,
        "cold": cold.measure,
    }
    for name in SECTIONS:
        if name in chosen:
            results[name] = sections[name]()
            options.out.write_text(json.dumps(results, indent=1) + "\n")
    if options.plot is not None:
        growth.draw(results["growth"] | {"cores": cores}, options.plot)
    print(f"\nwritten to {options.out}")


if __name__ == "__main__":
    main()
