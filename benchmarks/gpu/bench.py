"""What the parts share: scenes, and a clock that tells the device's time from the host's."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

import sgwarp as sg
from benchmarks import scenes
from sgwarp.scene import Camera, Gaussians

COUNTS = {"100k": 100_000, "1M": 1_000_000}
SIZES = {"480p": (640, 480), "1080p": (1920, 1080)}
PAIRS = (("100k", "480p"), ("1M", "1080p"))


@dataclass
class Bench:
    """Scenes on the device, made once, and timing there."""

    device: torch.device
    tiny: bool
    folder: Path
    _scenes: dict[str, Gaussians] = field(default_factory=dict)

    @property
    def on_cuda(self) -> bool:
        return self.device.type == "cuda"

    def scene(self, count: str) -> Gaussians:
        """The synthetic room with colours of degree 3."""
        if count not in self._scenes:
            number = COUNTS[count] // 1000 if self.tiny else COUNTS[count]
            self._scenes[count] = scenes.with_harmonics(scenes.room(number)[0]).to(self.device)
        return self._scenes[count]

    def camera(self, size: str) -> Camera:
        width, height = (s // 10 for s in SIZES[size]) if self.tiny else SIZES[size]
        return scenes.room_camera().resized(height, width)

    def leaves(self, gaussians: Gaussians, values: torch.Tensor | None = None) -> list[torch.Tensor]:
        fields = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities)
        return [t.detach().clone().requires_grad_() for t in (*fields, gaussians.sh if values is None else values)]

    def time(self, name: str, job: Callable[[], Any], repeats: int = 20) -> dict[str, float]:
        """Median milliseconds: on the device by events, of the host until it returns, and as a wall clock sees it."""
        for _ in range(3):
            job()
        self.settle()
        rows: dict[str, list[float]] = {"device": [], "host": [], "wall": []}
        if self.on_cuda:
            torch.cuda.reset_peak_memory_stats(self.device)
        for _ in range(2 if self.tiny else repeats):
            self._once(job, rows)
        found = {kind: round(statistics.median(values), 4) for kind, values in rows.items() if values}
        if self.on_cuda:
            found["peak_mib"] = round(torch.cuda.max_memory_allocated(self.device) / 2**20, 1)
            found |= self.kernels(job)
        print(f"  {name:50s} {found}", flush=True)
        return found

    def _once(self, job: Callable[[], Any], rows: dict[str, list[float]]) -> None:
        events = [torch.cuda.Event(enable_timing=True) for _ in range(2)] if self.on_cuda else []
        start = time.perf_counter()
        if events:
            events[0].record()
        job()
        if events:
            events[1].record()
        rows["host"].append(1e3 * (time.perf_counter() - start))
        self.settle()
        rows["wall"].append(1e3 * (time.perf_counter() - start))
        if events:
            rows["device"].append(events[0].elapsed_time(events[1]))

    def kernels(self, job: Callable[[], Any], steps: int = 3) -> dict[str, Any]:
        """Launches of a call, and the ten kernels that take longest [ms a call]."""
        from torch.profiler import ProfilerActivity, profile

        with profile(activities=[ProfilerActivity.CUDA]) as recorded:
            for _ in range(steps):
                job()
            self.settle()
        rows: dict[str, float] = {}
        launches = 0
        for event in recorded.events():
            if str(event.device_type).endswith("CUDA"):
                rows[event.name] = rows.get(event.name, 0.0) + event.device_time / steps / 1e3
                launches += 1
        slowest = sorted(rows.items(), key=lambda row: -row[1])[:10]
        return {"launches": launches / steps, "kernels": {name[:80]: round(ms, 4) for name, ms in slowest}}

    def settle(self) -> None:
        if self.on_cuda:
            torch.cuda.synchronize(self.device)

    def rasterize(self, leaves: list[torch.Tensor], camera: Camera, colors: bool = True, **options: Any) -> Any:
        values = {"sh" if colors else "features": leaves[4]}
        pose = camera.world_to_camera
        return sg.rasterize(*leaves[:4], pose, camera.K, camera.width, camera.height, **values, **options)


def backward(leaves: list[torch.Tensor], rendering: Any) -> None:
    for leaf in leaves:
        leaf.grad = None
    rendering.features.mean().backward()
