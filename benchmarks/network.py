"""The semantic network's speed: ratios within one run, printed and written to JSON.

    python benchmarks/network.py [--voxels 50000] [--out benchmarks/network.json]

(a) convolutions of 3^3 against torch.mm's flops on the same machine and, where it is installed, against the forward
pass of spconv on the CPU; (b) kernel maps as a share of a training step; (c) cost against the number of voxels;
(d) one scene predicted against the same scene lifted from views; (e) splatting 64 hidden channels against the whole
embedding. Every figure is the smallest of several runs, rivals taking turns. Carry over the ratios only.
"""

from __future__ import annotations

import argparse
import json
import math
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import torch

from sgwarp.datasets.synthetic import make_room, room_cameras
from sgwarp.lifting.lifter import lift
from sgwarp.network.inputs import voxelize
from sgwarp.network.layers.mink_unet import MinkUNet
from sgwarp.network.layers.sparse import Grid, SparseTensor
from sgwarp.network.prediction import predict
from sgwarp.network.semantic_network import SemanticNetwork
from sgwarp.ops.sparse.convolution import sparse_conv
from sgwarp.ops.sparse.voxels import kernel_map, unpack_voxels
from sgwarp.rendering.renderer import render
from sgwarp.scene import FeatureMap, View

Job = Callable[[], object]
WIDTHS = (32, 64, 128, 256)
CHANNELS = 512  # of the embedding, CLIP's


def fastest(jobs: dict[str, Job], rounds: int) -> dict[str, float]:
    """Smallest wall time of each job [ms]; the jobs take turns of three runs, so that each finds its threads awake."""
    best = dict.fromkeys(jobs, math.inf)
    for _ in range(rounds):
        for name, job in jobs.items():
            for _ in range(3):
                start = time.perf_counter()
                job()
                best[name] = min(best[name], 1e3 * (time.perf_counter() - start))
    return best


def surface(count: int) -> torch.Tensor:
    """About `count` voxels of a room's surfaces: keys."""
    room = make_room(1, 12 * count)
    side = math.sqrt(
        sum(2 * a * b for a, b in zip(room.size, (*room.size[1:], room.size[0]), strict=True)) * 1.5 / count
    )
    return voxelize(room.gaussians, "xyz-rgb", side).voxels.grid.keys(1)


def spconv_job(keys: torch.Tensor, features: torch.Tensor) -> Job | None:
    """Forward pass of spconv on the same voxels with its map made beforehand; None if it is not installed."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            import spconv.pytorch as spconv
        except ImportError:
            return None
    at = unpack_voxels(keys)[:, [0, 3, 2, 1]]
    at[:, 1:] -= at[:, 1:].amin(dim=0)
    shape = (at[:, 1:].amax(dim=0) + 1).tolist()
    channels = features.shape[1]
    layer = spconv.SubMConv3d(channels, channels, 3, bias=False, indice_key="map", algo=spconv.ConvAlgo.Native)
    tensor = spconv.SparseConvTensor(features, at.int().contiguous(), shape, 1)
    with torch.no_grad():
        layer(tensor)  # makes the map, which the tensor keeps

    def run() -> object:
        with torch.no_grad():
            return layer(tensor)

    return run


def convolutions(count: int, rounds: int) -> dict[str, object]:
    """3^3 convolutions: share of torch.mm's rate, against spconv, and backward against forward."""
    keys = surface(count)
    pairs = kernel_map(keys, keys, 3)
    results: dict[str, object] = {"voxels": len(keys), "pairs per voxel": pairs.pairs / len(keys)}
    square = torch.randn(1536, 1536)
    product = torch.empty_like(square)
    for channels in WIDTHS:
        features = torch.randn(len(keys), channels)
        weight = torch.randn(27, channels, channels)
        leaf, kernel = features.clone().requires_grad_(), weight.clone().requires_grad_()
        seed = torch.randn(len(keys), channels)

        def backward(leaf=leaf, kernel=kernel, seed=seed) -> None:
            torch.autograd.grad(sparse_conv(leaf, kernel, pairs), (leaf, kernel), seed)

        jobs: dict[str, Job] = {
            "mm": lambda: torch.mm(square, square, out=product),
            "forward": lambda f=features, w=weight: sparse_conv(f, w, pairs),
            "forward and backward": backward,
        }
        if (rival := spconv_job(keys, features)) is not None:
            jobs["spconv forward"] = rival
        times = fastest(jobs, rounds)
        peak = 2 * 1536**3 / times["mm"] / 1e6
        rate = 2 * pairs.pairs * channels**2 / times["forward"] / 1e6
        figures = {**times, "mm [GF/s]": peak, "forward [GF/s]": rate, "share of mm": rate / peak}
        if "spconv forward" in times:
            figures["spconv / ours"] = times["spconv forward"] / times["forward"]
        results[str(channels)] = figures
        print(f"  C = {channels:3d}: {rate:5.1f} GF/s, {rate / peak:.2f} of mm", end="")
        print(f", spconv / ours {figures['spconv / ours']:.2f}" if "spconv / ours" in figures else "")
    return results


def steps(counts: list[int], arch: str, rounds: int) -> dict[str, object]:
    """One training step: its parts, the share of the kernel maps, and how the cost grows."""
    torch.manual_seed(0)
    net = MinkUNet(10, CHANNELS, arch)
    results: dict[str, object] = {}
    cost = []
    for count in counts:
        keys = surface(count)
        features = torch.randn(len(keys), 10)
        target = torch.randn(len(keys), CHANNELS)

        def maps(keys=keys) -> Grid:
            grid = Grid({1: keys})
            for side, stride, coarser in (
                (5, 1, 1),
                *((3, 2**k, 1) for k in range(5)),
                *((2, 2**k, 2) for k in range(4)),
            ):
                grid.map(side, stride, coarser)
            return grid

        grid = maps()

        def forward(features=features, grid=grid) -> torch.Tensor:
            return net(SparseTensor(features, grid)).features

        def step(features=features, target=target, maps=maps) -> None:
            y = net(SparseTensor(features, maps())).features
            (1 - torch.nn.functional.cosine_similarity(y, target)).mean().backward()

        times = fastest({"maps": maps, "forward": forward, "step": step}, rounds)
        share = times["maps"] / times["step"]
        results[str(len(keys))] = {
            **times,
            "maps / step": share,
            "maps / (maps + forward)": times["maps"] / (times["maps"] + times["forward"]),
        }
        cost.append((len(keys), times["step"]))
        print(f"  {arch}, {len(keys)} voxels: step {times['step']:.0f} ms, maps {share:.3f} of it")
    x, y = (torch.tensor(column, dtype=torch.float64).log() for column in zip(*cost, strict=True))
    exponent = float(((x - x.mean()) * (y - y.mean())).sum() / (x - x.mean()).square().sum())
    results["exponent of the cost"] = exponent
    print(f"  cost grows with voxels^{exponent:.2f}")
    return results


def inference(arch: str, rounds: int) -> dict[str, object]:
    """One scene: predicted, against lifted from views; and hidden channels against the embedding in a picture."""
    room = make_room(2, 50_000)
    cameras = room_cameras(room, 0, 20, 640, 480)
    torch.manual_seed(0)
    network = SemanticNetwork(MinkUNet(10, CHANNELS, arch), "full", 0.05, "random")
    prediction = predict(room.gaussians, network)
    vectors = torch.randn(len(room.class_of_piece), CHANNELS)
    images = [
        render(room.gaussians, c, "features", torch.eye(len(vectors))[room.pieces]).argmax(dim=2) for c in cameras
    ]
    views = [View(f"{k:02d}", camera) for k, camera in enumerate(cameras)]
    ids = {v.stem: FeatureMap("random", ids=image, vectors=vectors) for v, image in zip(views, images, strict=True)}
    small = torch.randn(120, 160, CHANNELS)
    features = prediction.semantics().features
    camera = cameras[0]
    jobs: dict[str, Job] = {
        "predict": lambda: predict(room.gaussians, network).semantics(),
        "lift 20 id maps": lambda: lift(room.gaussians, views, ids),
        "lift 1 dense map of 160 x 120": lambda: lift(
            room.gaussians, views[:1], lambda view: FeatureMap("random", dense=small)
        ),
        "render embedding": lambda: render(room.gaussians, camera, "features", features),
        "render hidden, then map": lambda: prediction.render(room.gaussians, camera),
        "render hidden": lambda: render(room.gaussians, camera, "features", prediction.hidden_of_gaussians),
    }
    times = fastest(jobs, rounds)
    ratios = {
        "20 id maps / predict": times["lift 20 id maps"] / times["predict"],
        "20 dense maps / predict": 20 * times["lift 1 dense map of 160 x 120"] / times["predict"],
        "embedding / hidden, mapped to 512": times["render embedding"] / times["render hidden, then map"],
        "embedding / hidden": times["render embedding"] / times["render hidden"],
    }
    for name, value in ratios.items():
        print(f"  {name}: {value:.2f}")
    return {"Gaussians": len(room.gaussians), "voxels": len(prediction.hidden), "arch": arch, **times, **ratios}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--voxels", type=int, default=50_000)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--arch", default="34A")
    parser.add_argument("--parts", nargs="+", default=["convolutions", "steps", "inference"])
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("network.json"))
    options = parser.parse_args()
    results = json.loads(options.out.read_text()) if options.out.exists() else {}
    results["threads"] = torch.get_num_threads()
    if "convolutions" in options.parts:
        print(f"3^3 convolutions, about {options.voxels} voxels, float32")
        results["convolutions"] = convolutions(options.voxels, options.rounds)
    if "steps" in options.parts:
        print(f"training steps, {CHANNELS} output channels")
        counts = [options.voxels // 20, options.voxels // 10, options.voxels // 5, options.voxels // 2]
        results["steps"] = steps(counts, options.arch, max(2, options.rounds // 2))
    if "inference" in options.parts:
        print("one scene")
        results["inference"] = inference(options.arch, max(2, options.rounds // 2))
    options.out.write_text(json.dumps(results, indent=1) + "\n")
    print(f"written to {options.out}")


if __name__ == "__main__":
    main()
