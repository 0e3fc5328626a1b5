"""Clocks for the benchmarks: rivals take turns, stages are timed where they run."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
import torch

from sgwarp.ops import launcher
from sgwarp.ops.splatting import autograd as differentiable
from sgwarp.ops.splatting import backward_lanes, tiles
from sgwarp.ops.splatting import forward as rasterize

Job = Callable[[], object]

# Where each stage of the pipeline is called from. The last is the sums per Gaussian and the adjoints of projection and
# colour in one.
STAGES: tuple[tuple[str, ModuleType, str], ...] = (
    ("project", tiles, "project"),
    ("order", tiles, "depth_order"),
    ("bin", tiles, "bin_splats"),
    ("composite", rasterize, "composite"),
    ("composite", differentiable, "composite_recorded"),
    ("composite backward", backward_lanes, "replay"),
    ("Gaussians backward", backward_lanes, "differentiate"),
)
# Stages of the limit that are one here.
TOGETHER = {"project": ("project", "shade"), "Gaussians backward": ("sums", "project backward", "shade backward")}


@dataclass(frozen=True)
class Run:
    """Something to time, with a number of threads for kernels, torch and whoever reads it."""

    job: Job
    threads: int


def set_threads(count: int) -> None:
    launcher.set_threads(count)
    torch.set_num_threads(count)


def fastest(runs: dict[str, Run], rounds: int) -> dict[str, float]:
    """Smallest wall time of each run [ms], the runs taking turns; a job that returns a float timed itself [s]."""
    best = dict.fromkeys(runs, float("inf"))
    for _ in range(rounds + 1):  # the first round compiles and warms up; its times are beaten
        for name, run in runs.items():
            if run.threads != launcher.get_threads():
                set_threads(run.threads)
                run.job()  # starts the threads
            start = time.perf_counter()
            own = run.job()
            seconds = own if isinstance(own, float) else time.perf_counter() - start
            best[name] = min(best[name], 1e3 * seconds)
    return best


class StageClock:
    """Wall time of each stage while it runs within the whole: exclusive of stages that it calls."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._inner = [0.0]

    def timed(self, stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def run(*args: Any, **kwargs: Any) -> Any:
            self._inner.append(0.0)
            start = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                whole = time.perf_counter() - start
                self.seconds[stage] = self.seconds.get(stage, 0.0) + whole - self._inner.pop()
                self._inner[-1] += whole

        return run

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Time the stages of everything that is called meanwhile."""
        kept = [(module, name, getattr(module, name)) for _, module, name in STAGES]
        for (stage, *_), (module, name, function) in zip(STAGES, kept, strict=True):
            setattr(module, name, self.timed(stage, function))
        try:
            yield
        finally:
            for module, name, function in kept:
                setattr(module, name, function)


def stage_times(job: Job, threads: int, rounds: int) -> dict[str, float]:
    """Smallest time of each stage of a job over some rounds [ms], of the `rest` between them, and of the `whole`."""
    set_threads(threads)
    job()
    best: dict[str, float] = {}
    for _ in range(rounds):
        clock = StageClock()
        with clock.watching():
            start = time.perf_counter()
            job()
            whole = time.perf_counter() - start
        times = clock.seconds | {"rest": whole - sum(clock.seconds.values()), "whole": whole}
        for name, seconds in times.items():
            best[name] = min(best.get(name, math.inf), 1e3 * seconds)
    return best


def shares(stages: dict[str, float]) -> dict[str, float]:
    """Share of each stage in their sum."""
    parts = {name: value for name, value in stages.items() if name != "whole"}
    total = sum(parts.values())
    return {name: value / total for name, value in parts.items()}


def exponent(sizes: Sequence[float], times: Sequence[float]) -> float:
    """Slope of log time over log size, least squares."""
    return float(np.polyfit(np.log(sizes), np.log(times), 1)[0])


def plural(threads: int) -> str:
    return f"{threads} thread" + "s" * (threads > 1)


def report(name: str, value: float, bound: str = "") -> None:
    print(f"  {name:62s} {value:8.2f}  {bound}")
