"""The first ten minutes on a GPU: is everything right, and how long does it take.

    python -m benchmarks.gpu [--device cuda] [--out gpu_out] [--only right,timings,...] [--seconds 540] [--tiny]

Each part writes gpu.json as it ends, so that a run that is cut short keeps what it found; --page docs/gpu.md puts it
into that page. `--device cpu --tiny` tries the parts themselves on a machine without a GPU; its times mean nothing.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
import traceback
from pathlib import Path

import torch

from benchmarks.gpu import checks, page, rivals, timings
from benchmarks.gpu.bench import Bench
from sgwarp.ops.devices import find_device

PARTS = {
    "ceilings": timings.ceilings,
    "extremes": checks.extremes,
    "operations": checks.operations,
    "layers": checks.layers,
    "streams": checks.streams,
    "determinism": checks.determinism,
    "demo": checks.demo,
    "rendering": timings.rendering,
    "features": timings.features,
    "lifting": timings.lifting,
    "fit": timings.fit,
    "network": timings.network,
    "gsplat": rivals.gsplat,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--out", type=Path, default=Path("gpu_out"))
    parser.add_argument("--only", default=",".join(PARTS), help="parts, with commas between them")
    parser.add_argument("--seconds", type=float, default=540.0, help="no part begins later")
    parser.add_argument("--tiny", action="store_true", help="scenes of a thousand Gaussians")
    parser.add_argument("--page", type=Path, help="put the results into this page, docs/gpu.md")
    options = parser.parse_args()
    chosen = options.only.split(",")
    if unknown := set(chosen) - set(PARTS):
        parser.error(f"--only: unknown part {', '.join(sorted(unknown))}; there are {', '.join(PARTS)}")
    device = find_device(options.device)
    options.out.mkdir(parents=True, exist_ok=True)
    bench = Bench(device, options.tiny, options.out)
    results = {"machine": machine(device), "tiny": options.tiny, "parts": {}}
    began = time.perf_counter()
    for name in chosen:
        if time.perf_counter() - began > options.seconds:
            results["parts"][name] = {"left_out": "no time was left"}
        else:
            print(f"== {name} ({time.perf_counter() - began:.0f} s)", flush=True)
            results["parts"][name] = run_part(name, bench)
        (options.out / "gpu.json").write_text(json.dumps(results, indent=1) + "\n")
    if options.page is not None:
        options.page.write_text(page.written(results, options.page.read_text(encoding="utf-8")), encoding="utf-8")


def run_part(name: str, bench: Bench) -> dict[str, object]:
    """What the part found; an error is a finding too, and the next part goes on."""
    start = time.perf_counter()
    try:
        found = PARTS[name](bench)
    except Exception as error:  # whatever it is, the other parts are worth their time
        traceback.print_exc()
        found = {"error": f"{type(error).__name__}: {str(error)[:500]}"}
    if bench.on_cuda:
        torch.cuda.empty_cache()
    return {"found": found, "seconds": round(time.perf_counter() - start, 1)}


def machine(device: torch.device) -> dict[str, object]:
    facts: dict[str, object] = {"torch": torch.__version__, "python": platform.python_version(), "device": str(device)}
    if device.type == "cuda":
        properties = torch.cuda.get_device_properties(device)
        facts |= {"name": properties.name, "memory_gib": round(properties.total_memory / 2**30, 1)}
    return facts


if __name__ == "__main__":
    main()
