"""Forward + backward of the whole pipeline against the same by hand."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scenes
import torch
from limit_training import TrainingLimit
from timing import TOGETHER, Run, fastest, plural, report, shares, stage_times
from torch import Tensor

from sgwarp.ops.splatting.autograd import rasterize
from sgwarp.scene import Camera, Gaussians

GEOMETRY = ("means", "quats", "scales", "opacities")
MOST_OF_A_STAGE = 0.25  # bound on every stage but compositing, forward and backward


def image_gradients(camera: Camera, channels: int) -> tuple[Tensor, Tensor]:
    """A random gradient of the loss with respect to the image [H, W, C] and to alpha [H, W]."""
    generator = torch.Generator().manual_seed(0)
    v_image = torch.randn(*camera.size, channels, generator=generator)
    return v_image, torch.randn(*camera.size, generator=generator)


def step(gaussians: Gaussians, camera: Camera, features: Tensor | None) -> Callable[[], None]:
    """One render and its gradients: to the geometry and to the colours' coefficients or the features."""
    leaves = [getattr(gaussians, name).clone().requires_grad_() for name in GEOMETRY]
    values = (gaussians.sh if features is None else features).clone().requires_grad_()
    gradients = image_gradients(camera, 3 if features is None else features.shape[1])
    chosen = {"sh": values} if features is None else {"features": values}

    def run() -> None:
        seen = rasterize(*leaves, camera.world_to_camera, camera.K, camera.width, camera.height, **chosen)
        torch.autograd.backward([seen.features, seen.alpha], gradients)
        for leaf in (*leaves, values):
            leaf.grad = None

    return run


def limit_step(rival: TrainingLimit, gradients: tuple[Tensor, Tensor]) -> Callable[[], None]:
    v_image, v_alpha = (gradient.numpy() for gradient in gradients)

    def run() -> None:
        rival.forward()
        rival.backward(v_image, v_alpha)

    return run


def against_limit(count: int, channels: int, cores: int, rounds: int) -> dict[str, float]:
    """Wall times of both [ms]: three channels are colours of degree 3, more are features."""
    gaussians, camera, _ = scenes.room(count)
    features = None
    if channels > 3:
        features = torch.randn(count, channels, generator=torch.Generator().manual_seed(0))
    else:
        gaussians = scenes.with_harmonics(gaussians)
    ours = step(gaussians, camera, features)
    gradients = image_gradients(camera, channels)
    runs: dict[str, Run] = {}
    rivals: dict[str, TrainingLimit] = {}
    for threads in sorted({1, cores}):
        mark = plural(threads)
        rivals[mark] = TrainingLimit(gaussians, camera, threads, features)
        runs[f"limit, {mark}"] = Run(limit_step(rivals[mark], gradients), threads)
        runs[f"forward + backward, {mark}"] = Run(ours, threads)
    times = fastest(runs, rounds)
    for mark, rival in rivals.items():
        times |= {f"limit's {name}, {mark}": 1e3 * seconds for name, seconds in rival.seconds().items()}
    return times


def measure(headline: int, cores: int, rounds: int) -> dict[str, object]:
    """All of it, printed and returned."""
    results: dict[str, object] = {}
    every = plural(cores)
    for channels in (3, 16, 64):
        times = against_limit(headline, channels, cores, rounds if channels == 3 else max(2, rounds // 3))
        results[f"channels {channels}"] = times
        print(f"\nForward + backward, {headline} Gaussians, {channels} channels")
        for mark in sorted({"1 thread", every}):
            whole = times[f"forward + backward, {mark}"]
            report(f"forward + backward [ms], {mark}", whole)
            report(f"forward + backward / limit, {mark}", whole / times[f"limit, {mark}"], "<= 2")
        if cores > 1:
            gain = times["forward + backward, 1 thread"] / times[f"forward + backward, {every}"]
            report(f"forward + backward, 1 thread / {every}", gain, ">= 1.7")
    gaussians, camera, _ = scenes.room(headline)
    job = step(scenes.with_harmonics(gaussians), camera, None)
    stages = results["stages"] = stage_times(job, cores, rounds)
    print(f"\nStages of forward + backward, {headline} Gaussians, colours of degree 3, {every}")
    by_hand = results["channels 3"]
    assert isinstance(by_hand, dict)
    for name, share in shares(stages).items():
        report(f"{name} [ms]", stages[name])
        report(f"{name}, share", share, f"<= {MOST_OF_A_STAGE}" if not name.startswith("composite") else "")
        rival = sum(by_hand.get(f"limit's {part}, {every}", np.nan) for part in TOGETHER.get(name, (name,)))
        if rival > 0:
            report(f"{name} / limit", stages[name] / rival)
    return results
