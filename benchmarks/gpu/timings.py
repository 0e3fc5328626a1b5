"""How long things take: the device's own time, the host's, and which kernels it goes to."""

from __future__ import annotations

import math
from typing import Any

import torch

import sgwarp as sg
from benchmarks.gpu.bench import PAIRS, Bench, backward
from sgwarp.datasets.synthetic import make_room
from sgwarp.network.inputs import voxelize
from sgwarp.network.layers.mink_unet import MinkUNet
from sgwarp.network.layers.sparse import Grid, SparseTensor
from sgwarp.ops.photometric import photometric_loss
from sgwarp.ops.splatting.lifting import LiftSums, lift_view


def ceilings(bench: Bench) -> dict[str, Any]:
    """What the machine can do at best: copying and multiplying."""
    x = torch.empty(2 ** (20 if bench.tiny else 28), device=bench.device)
    y, m = torch.empty_like(x), torch.randn(*(2 * [256 if bench.tiny else 8192]), device=bench.device)
    half, one = m.bfloat16(), torch.zeros(1, device=bench.device)
    return {
        f"copy of {4 * len(x) / 2**20:.0f} MiB": bench.time("copy", lambda: y.copy_(x)),
        f"float32 product of {len(m)}": bench.time("product", lambda: m @ m, 5),
        f"bfloat16 product of {len(m)}": bench.time("product, bfloat16", lambda: half @ half, 5),
        "an empty launch": bench.time("launch", lambda: one.add_(1), 50),
    }


def rendering(bench: Bench) -> dict[str, Any]:
    """Rendering and training steps of colours, and the loss."""
    found = {}
    for count, size in PAIRS:
        gaussians, camera, leaves = bench.scene(count), bench.camera(size), bench.leaves(bench.scene(count))
        tag = f"{count} {size}"
        image, truth = torch.rand(2, *camera.size, 3, device=bench.device)
        image.requires_grad_()
        jobs = {
            "render": lambda g=gaussians, c=camera: sg.render(g, c),
            "forward": lambda x=leaves, c=camera: bench.rasterize(x, c),
            "forward + backward": lambda x=leaves, c=camera: backward(x, bench.rasterize(x, c)),
            "forward + backward, ordered": lambda x=leaves, c=camera: backward(
                x, bench.rasterize(x, c, deterministic=True)
            ),
            "loss": lambda x=image, y=truth: photometric_loss(x, y).backward(),
        }
        found |= {f"{name}, {tag}": bench.time(f"{name}, {tag}", job) for name, job in jobs.items()}
    return found


def features(bench: Bench) -> dict[str, Any]:
    """Rendering of wide features, and their training step."""
    found = {}
    for count, size in PAIRS:
        gaussians, camera = bench.scene(count), bench.camera(size)
        for channels in (16, 64, 512):
            values = torch.rand(len(gaussians), channels, device=bench.device)
            name = f"{channels} channels, {count} {size}"
            job = lambda g=gaussians, c=camera, v=values: sg.render(g, c, "features", v)  # noqa: E731
            found[name] = bench.time(name, job, 8)
            if channels < 512:
                leaves = bench.leaves(gaussians, values)
                job = lambda x=leaves, c=camera: backward(x, bench.rasterize(x, c, colors=False))  # noqa: E731
                found[f"training, {name}"] = bench.time(f"training, {name}", job, 8)
    return found


def lifting(bench: Bench) -> dict[str, Any]:
    """One view as an id map, and as dense maps."""
    found = {}
    for count, size in PAIRS:
        gaussians, camera = bench.scene(count), bench.camera(size)
        height, width = camera.size
        rows, columns = (torch.arange(n, device=bench.device) // 32 for n in (height, width))
        ids = ((rows[:, None] * 64 + columns) % 512).int()[None]
        vectors = torch.rand(512, 512, device=bench.device)
        maps = {"ids of 512 channels": sg.FeatureMap("s", ids=ids, vectors=vectors)}
        for channels in (16, 64, 512):
            dense = torch.rand(height, width, channels, device=bench.device)
            maps[f"dense {channels}"] = sg.FeatureMap("s", dense=dense)
        for name, feature_map in maps.items():
            sums = LiftSums.zeros(len(gaussians), feature_map.channels, bench.device)
            job = lambda g=gaussians, c=camera, m=feature_map, s=sums: lift_view(g, c, m, s)  # noqa: E731
            found[f"{name}, {count} {size}"] = bench.time(f"lift {name}, {count} {size}", job, 8)
    return found


def fit(bench: Bench) -> dict[str, Any]:
    """Whole steps of a fit to renderings of the room, by the wall clock, refinement included."""
    from benchmarks.gpu.photographs import photographs_of

    found = {}
    for count, size in PAIRS:
        views = photographs_of(bench, count, size)
        steps = 10 if bench.tiny else 300
        log = sg.RunLog(device=str(bench.device))
        settings = sg.FitSettings(steps=steps, cap=len(bench.scene(count)) + 1000)
        fitted = sg.fit(views, bench.scene(count), (), settings, device=bench.device, log=log)
        row = {"steps_per_second": steps / log.stages["fit"], "gaussians": len(fitted.gaussians)}
        print(f"  fit, {count} {size}: {row}", flush=True)
        found[f"{count} {size}"] = row
    return found


def network(bench: Bench) -> dict[str, Any]:
    """MinkUNet34A with 512 outputs on the surfaces of a room, 50k Gaussians."""
    count = 500 if bench.tiny else 50_000
    room = make_room(1, 12 * count)
    area = sum(2 * p * q for p, q in zip(room.size, (*room.size[1:], room.size[0]), strict=True))
    voxels = voxelize(room.gaussians.to(bench.device), "xyz-rgb", math.sqrt(1.5 * area / count)).voxels
    keys, x = voxels.grid.keys(1), voxels.features.detach()
    net = MinkUNet(x.shape[1], 512, "14A" if bench.tiny else "34A").to(bench.device)
    grid = Grid({1: keys})

    def forward() -> None:
        with torch.no_grad():
            net(SparseTensor(x, grid))

    def both() -> None:
        net.zero_grad(set_to_none=True)
        net(SparseTensor(x, grid)).features.mean().backward()

    def half() -> None:
        with torch.autocast(bench.device.type, torch.bfloat16):
            both()

    jobs = {"forward": forward, "forward + backward": both, "forward + backward, bfloat16": half}
    return {f"{name}, {len(keys)} voxels": bench.time(name, job, 6) for name, job in jobs.items()}
