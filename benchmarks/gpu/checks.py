"""Is everything right on the device: against the float64 oracle, the CPU, another stream, and itself."""

from __future__ import annotations

import math
from copy import deepcopy
from dataclasses import replace
from typing import Any

import torch

import sgwarp as sg
from benchmarks.gpu.bench import Bench, backward
from sgwarp.demo.data import Room
from sgwarp.demo.measurement import measure
from sgwarp.evaluation.report.extremes import EXTREMES
from sgwarp.evaluation.report.stability import check, check_gradients
from sgwarp.network.layers.mink_unet import MinkUNet
from sgwarp.network.layers.sparse import Grid, SparseTensor
from sgwarp.ops.sparse.voxels import pack_voxels
from sgwarp.ops.splatting.lifting import LiftSums, lift_view


def extremes(bench: Bench) -> dict[str, Any]:
    """Each extreme scene of the report against the oracle, images and gradients."""
    found = {}
    for name in list(EXTREMES)[: 2 if bench.tiny else None]:
        extreme = EXTREMES[name]
        schedule = "block" if bench.on_cuda else "lanes"
        image = check(extreme, schedule, bench.device)
        bounded = extreme.gradient_bound is not None
        gradient = check_gradients(extreme, schedule, bench.device).error if bounded else None
        found[name] = {"error": image.error, "finite": image.finite, "gradient_error": gradient}
        print(f"  {name:40s} {found[name]}", flush=True)
    return found


def difference(there: torch.Tensor, here: torch.Tensor) -> dict[str, float]:
    """Largest difference, and the share of values off by more than a thousandth of the largest."""
    there, here = there.detach().cpu().double(), here.detach().double()
    apart = torch.where(there == here, 0.0, (there - here).abs()).nan_to_num(nan=math.inf, posinf=math.inf)
    if not apart.numel():
        return {"largest": 0.0, "share": 0.0}
    scale = here.abs().nan_to_num(0.0, 0.0, 0.0).max()
    return {"largest": float(apart.max()), "share": float((apart > 1e-3 * scale).double().mean())}


def feature_maps(size: tuple[int, int]) -> dict[str, sg.FeatureMap]:
    dice = torch.Generator().manual_seed(0)
    height, width = size
    ids = torch.randint(-1, 5, (2, height, width), generator=dice).int()
    vectors = torch.rand(5, 24, generator=dice)
    return {
        "dense 16": sg.FeatureMap("s", dense=torch.rand(height, width, 16, generator=dice)),
        "dense 130": sg.FeatureMap("s", dense=torch.rand(height, width, 130, generator=dice)),
        "ids": sg.FeatureMap("s", ids=ids, vectors=vectors),
        "labels": sg.FeatureMap("s", ids=ids[0].clamp(max=3), labels=("a", "b", "c", "d")),
    }


def operations(bench: Bench) -> dict[str, Any]:
    """Every operation on the device against the same one on the CPU."""
    there, camera = bench.scene("100k"), bench.camera("480p")
    here, found = there.to("cpu"), {}
    for mode in ("rgb", "depth", "expected_depth", "alpha"):
        found[f"render {mode}"] = difference(sg.render(there, camera, mode), sg.render(here, camera, mode))
    for channels in (2, 16, 64):
        values = torch.rand(len(here), channels, generator=torch.Generator().manual_seed(channels))
        pair = [bench.leaves(g, values.to(g.device)) for g in (there, here)]
        images = [bench.rasterize(leaves, camera, colors=False, expected_depth=True, depth=True) for leaves in pair]
        found[f"{channels} channels"] = difference(images[0].features, images[1].features)
        for leaves, image in zip(pair, images, strict=True):
            backward(leaves, image)
        for name, mine, exact in zip(("means", "quats", "scales", "opacities", "values"), *pair, strict=True):
            found[f"{channels} channels, gradient of {name}"] = difference(mine.grad, exact.grad)
    for name, feature_map in feature_maps(camera.size).items():
        for mode in ("weighted", "center"):
            sums = [LiftSums.zeros(len(g), feature_map.channels, g.device) for g in (there, here)]
            for gaussians, total in zip((there, here), sums, strict=True):
                lift_view(gaussians, camera, feature_map, total, mode=mode)
            found[f"lift {name}, {mode}"] = difference(sums[0].features, sums[1].features)
    found["contributors"] = difference(*(sg.top_contributors(g, camera, k=8)[1] for g in (there, here)))
    for name, row in found.items():
        print(f"  {name:50s} {row}", flush=True)
    return found


def step(bench: Bench, camera: sg.Camera, **options: Any) -> list[torch.Tensor]:
    """A rendering, its gradients, and a lifted view."""
    gaussians = bench.scene("100k")
    leaves = bench.leaves(gaussians)
    rendering = bench.rasterize(leaves, camera, expected_depth=True, depth=True, **options)
    (rendering.features.mean() + rendering.depth.mean() + rendering.expected_depth.mean()).backward()
    feature_map = feature_maps(camera.size)["dense 16"]
    sums = LiftSums.zeros(len(gaussians), 16, bench.device)
    lift_view(gaussians, camera, feature_map, sums, deterministic=options.get("deterministic"))
    return [rendering.features.detach(), *(leaf.grad for leaf in leaves), sums.features]


def layers(bench: Bench) -> dict[str, Any]:
    """A training step of the network on voxels and its inference, on the device twice and on the CPU.

    On the device both times have the same bits; the blocks that count each other would show it if they did not.
    """
    dice = torch.Generator().manual_seed(0)
    torch.manual_seed(0)
    net = MinkUNet(3, 16, "14A")
    count = 300 if bench.tiny else 30_000
    places = torch.randint(0, round(2 * count ** (1 / 3)), (count, 3), generator=dice)
    keys = pack_voxels(torch.cat([torch.zeros(count, 1, dtype=torch.int64), places], dim=1)).unique()
    values, results = torch.rand(len(keys), 3, generator=dice), []
    for device in (bench.device, bench.device, torch.device("cpu")):
        copy = deepcopy(net).to(device)
        voxels = SparseTensor(values.to(device), Grid({1: keys.to(device)}))
        y = copy(voxels).features
        y.square().mean().backward()
        with torch.inference_mode():
            inferred = copy.eval()(voxels).features
        named = {"trained on": y, "inferred": inferred} | dict(copy.named_buffers())
        named |= {f"gradient of {name}": p.grad for name, p in copy.named_parameters()}
        results.append({name: tensor.detach().cpu().double() for name, tensor in named.items()})
    first, second, exact = results
    found = {"same bits twice": all(torch.equal(first[name], second[name]) for name in first)}
    for name in ("trained on", "inferred"):
        found[name] = difference(first[name], exact[name])
    for kind in ("running", "gradient"):
        errors = {n: float((first[n] - e).norm() / e.norm().clamp(min=1e-30)) for n, e in exact.items() if kind in n}
        found[f"{kind}, worst by norm"] = dict([max(errors.items(), key=lambda pair: pair[1])])
    print(f"  {found}", flush=True)
    return found


def streams(bench: Bench) -> dict[str, Any]:
    """The same on a side stream that is busy: what ran elsewhere would come too early."""
    if not bench.on_cuda:
        return {"left_out": "no streams on the CPU"}
    camera = bench.camera("480p")
    expected = [t.cpu() for t in step(bench, camera, deterministic=True)]
    junk, worst = torch.randn(4096, 4096, device=bench.device), 0.0
    for _ in range(5):
        stream = torch.cuda.Stream(bench.device)
        stream.wait_stream(torch.cuda.current_stream(bench.device))
        with torch.cuda.stream(stream):
            for _ in range(5):
                junk = junk @ junk * 1e-4
            seen = step(bench, camera, deterministic=True)
        bench.settle()
        worst = max(worst, *(difference(a, b)["largest"] for a, b in zip(seen, expected, strict=True)))
    return {"largest": worst}


def determinism(bench: Bench) -> dict[str, Any]:
    """`deterministic=True` twice: the same bits in every output and gradient."""
    camera = bench.camera("480p")
    pair = [step(bench, camera, deterministic=True) for _ in range(2)]
    names = ("image", "means", "quats", "scales", "opacities", "sh", "lifted")
    return {name: bool(torch.equal(a, b)) for name, a, b in zip(names, *pair, strict=True)}


def demo(bench: Bench) -> dict[str, Any]:
    """The room of the demonstration with its true labels, on the device and on the CPU."""
    room = Room.load()
    if bench.tiny:
        thin = room.gaussians.subset(torch.arange(0, len(room.gaussians), 50))
        room = replace(room, gaussians=thin, views=room.views[:2], held_out=room.held_out[:1])
    found = {}
    for device in {str(bench.device), "cpu"}:
        there = room.to(device)
        result = measure(there, sg.lift(there.gaussians, there.views, there.label_map))
        found[device] = {"miou": result.miou, "coverage": result.coverage}
    return found
