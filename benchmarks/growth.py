"""How run times grow with the number of Gaussians, 640 x 480, from ten thousand to a million."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import scenes
from limit_training import TrainingLimit
from timing import Run, exponent, fastest, plural, report, stage_times
from training import image_gradients, limit_step, step

from sgwarp.ops.splatting.forward import rasterize

COUNTS = (10_000, 30_000, 100_000, 300_000, 1_000_000)


def at(count: int, cores: int, rounds: int) -> dict[str, dict[str, float]]:
    """Wall times [ms] with `count` Gaussians: whole and by stage."""
    gaussians, camera, _ = scenes.room(count)
    gaussians = scenes.with_harmonics(gaussians)
    ours = step(gaussians, camera, None)
    rival = TrainingLimit(gaussians, camera, cores)
    runs = {
        "render": Run(lambda: rasterize(gaussians, camera), cores),
        "forward + backward": Run(ours, cores),
        "limit's render": Run(rival.forward, cores),
        "limit's forward + backward": Run(limit_step(rival, image_gradients(camera, 3)), cores),
    }
    return {"whole": fastest(runs, rounds), "stages": stage_times(ours, cores, rounds)}


def measure(cores: int, rounds: int, counts: tuple[int, ...] = COUNTS) -> dict[str, Any]:
    """All of it, printed and returned."""
    times = {count: at(count, cores, rounds) for count in counts}
    print(f"\nGrowth from {counts[0]} to {counts[-1]} Gaussians, {plural(cores)}, times [ms]")
    exponents: dict[str, float] = {}
    late: dict[str, float] = {}  # of the last decade: what is constant weighs less
    for kind in ("whole", "stages"):
        for name in times[counts[0]][kind]:
            if name == "whole":
                continue
            column = [times[count][kind][name] for count in counts]
            exponents[name], late[name] = exponent(counts, column), exponent(counts[-3:], column[-3:])
            values = " ".join(f"{value:.1f}" for value in column)
            report(f"{name}  {values}, exponent", exponents[name], f"last {late[name]:.2f}")
    return {
        "times": {str(count): value for count, value in times.items()},
        "exponents": exponents,
        f"exponents from {counts[-3]}": late,
    }


def draw(results: dict[str, Any], path: Path) -> None:
    """Log-log plot of what `measure` returned."""
    import matplotlib.pyplot as plt

    counts = sorted(map(int, results["times"]))
    figure, axes = plt.subplots(figsize=(7.2, 4.4), constrained_layout=True)
    lines = (("forward + backward", "#1f5fa8", "o"), ("render", "#d0662b", "s"))
    for name, color, marker in lines:
        for prefix, style, width in (("", "-", 2.0), ("limit's ", "--", 1.3)):
            values = [results["times"][str(count)]["whole"][prefix + name] for count in counts]
            slope = results["exponents"][prefix + name]
            label = f"{prefix}{name}, exponent {slope:.2f}"
            axes.loglog(counts, values, style, color=color, lw=width, marker=marker, ms=4.5, label=label)
    axes.set_xlabel("Gaussians")
    axes.set_ylabel("wall time [ms], two cores" if results["cores"] == 2 else "wall time [ms]")
    axes.set_title("A synthetic room at 640 × 480, colours of degree 3", fontsize=11)
    axes.grid(which="major", color="#dddddd", lw=0.8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=9)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=140)
    plt.close(figure)
