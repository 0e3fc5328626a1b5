"""What encoders cost and what masks are worth.

    SGWARP_DATA=FOLDER python benchmarks/encoders.py [room] [time] [cost] [memory] [--out benchmarks/encoders.json]

room: on the full room (see room.py), the default encoder without masks, with OpenCV's proposals, and with the true
masks as an upper bound: furniture mIoU and localisation on the held-out views. time: seconds per view of the same.
cost: time and bytes per view of dense maps against id maps at 512 channels. memory: the peak of a process that lifts
100 synthetic views of 1080p features. Parts not asked for keep their figures in the file.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parent))

import sgwarp as sg
from sgwarp.demo.data import FURNITURE
from sgwarp.demo.measurement import measure
from sgwarp.encoders.cache import CachedMaps, pack
from sgwarp.ops.splatting.lifting import LiftSums, lift_view
from sgwarp.scene import Camera, FeatureMap, Gaussians, View

COUNT = 200_000  # Gaussians of the room
CHANNELS = 512
MASKS = 48  # of a synthetic view
TRUE_LABELS = "true labels, lifted the same way"
SOURCES = {
    "no masks": "conse:dense",
    "graph segmentation": "conse",
    "true masks": "conse+masks:{labels}",
    "true masks, crops alone": "conse:crops+masks:{labels}",
    "graph segmentation, crops alone": "conse:crops",
    "SLIC superpixels": "conse+slic",
    "graph segmentation, three scales": "conse+graph?scales=100,300,900",
}


def room_folder() -> Path:
    data = os.environ.get("SGWARP_DATA")
    if data is None:
        raise SystemExit("set SGWARP_DATA to the folder that holds room/")
    return Path(data) / "room"


def room(cache: Path, save: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    """Furniture mIoU and localisation of each source on the held-out views of the full room; saved one by one."""
    from room import FullRoom, objects_found

    folder = room_folder()
    scene = FullRoom.build(folder, COUNT)
    results: dict[str, Any] = {}
    for name, encoder in {TRUE_LABELS: "", **SOURCES}.items():
        if encoder:
            source = CachedMaps(sg.make_encoder(encoder.format(labels=folder / "labels"), scene.views), cache)
            semantics = sg.lift(scene.gaussians, scene.views, source)
            found = measure(scene, semantics, source)
        else:
            found = measure(scene, sg.lift(scene.gaussians, scene.views, scene.label_map))
        results[name] = {
            "furniture mIoU": found.miou,
            "sights": len(found.findings),
            "sights found": sum(finding.hit for finding in found.findings),
            "objects found in half of their views or more": objects_found(found),
            "IoU": dict(zip(scene.furniture, found.confusion.iou[:FURNITURE].tolist(), strict=True)),
        }
        print(f"{name:36s} mIoU {found.miou:.3f}, {results[name]['sights found']} of {len(found.findings)}", flush=True)
        save(results)
    return results


def seconds_per_view(count: int) -> dict[str, float]:
    """Median over `count` views of the time to encode one; the first view is not counted."""
    folder = room_folder()
    views = sg.load_views(folder)[:: len(sg.load_views(folder)) // count][: count + 1]
    results = {}
    for name, encoder in SOURCES.items():
        source = sg.make_encoder(encoder.format(labels=folder / "labels"), views)
        times = []
        for view in views:
            image = view.image()
            start = time.perf_counter()
            source.encode(view, image)
            times.append(time.perf_counter() - start)
        results[name] = float(np.median(times[1:]))
        print(f"{name:36s} {results[name]:.2f} s per view", flush=True)
    return results


def synthetic_scene(count: int, height: int, width: int) -> tuple[Gaussians, Camera]:
    """A wall of Gaussians in front of a camera, and the camera."""
    noise = torch.Generator().manual_seed(0)
    means = torch.rand(count, 3, generator=noise) * torch.tensor([4.0, 2.25, 1.0]) + torch.tensor([-2.0, -1.125, 2.0])
    gaussians = Gaussians(
        means=means,
        quats=torch.tensor([1.0, 0, 0, 0]).expand(count, 4),
        scales=torch.full((count, 3), 0.012),
        opacities=torch.full((count,), 0.8),
        sh=torch.zeros(count, 1, 3),
    )
    K = torch.tensor([[0.9 * width, 0, width / 2], [0, 0.9 * width, height / 2], [0, 0, 1]])
    return gaussians, Camera(K, torch.eye(4), width, height)


def id_map(height: int, width: int, seed: int) -> FeatureMap:
    """Forty-eight masks with round borders and a vector each."""
    y, x = np.mgrid[:height, :width] / height
    cells = np.floor(5 * (x + 0.1 * np.sin(7 * y + seed))) + 100 * np.floor(5 * (y + 0.1 * np.cos(5 * x + seed)))
    ids = np.unique(cells, return_inverse=True)[1].reshape(height, width) % MASKS
    vectors = torch.randn(MASKS, CHANNELS, generator=torch.Generator().manual_seed(seed))
    return FeatureMap("synthetic", ids=torch.from_numpy(ids), vectors=torch.nn.functional.normalize(vectors, dim=1))


def dense_map(height: int, width: int, seed: int) -> FeatureMap:
    """The same kind of features without structure, in half precision as networks on a GPU give them."""
    noise = torch.Generator().manual_seed(seed)
    return FeatureMap("synthetic", dense=torch.randn(height, width, CHANNELS, generator=noise).to(torch.float16))


def cost(rounds: int) -> dict[str, dict[str, float]]:
    """Lifting one view of 640 x 480 into 100,000 Gaussians: dense at full and at half resolution against ids."""
    gaussians, camera = synthetic_scene(100_000, 480, 640)
    maps = {
        "dense, full resolution": dense_map(480, 640, 0),
        "dense, half resolution": dense_map(240, 320, 0),
        "id map": id_map(480, 640, 0),
    }
    sums = {name: LiftSums.zeros(len(gaussians), CHANNELS) for name in maps}
    best = dict.fromkeys(maps, float("inf"))
    for _ in range(rounds + 1):  # the first round compiles
        for name, found in maps.items():
            start = time.perf_counter()
            lift_view(gaussians, camera, found, sums[name])
            best[name] = min(best[name], time.perf_counter() - start)
    results = {}
    for name, found in maps.items():
        with tempfile.NamedTemporaryFile(suffix=".npz") as file:
            (np.savez if found.dense is not None else np.savez_compressed)(file, **pack(found))
            stored = Path(file.name).stat().st_size
        tensors = [t for t in (found.dense, found.ids, found.vectors) if t is not None]
        held = sum(tensor.nbytes for tensor in tensors)
        results[name] = {"seconds per view": best[name], "bytes in memory": held, "bytes in the cache": stored}
        print(f"{name:24s} {1e3 * best[name]:7.1f} ms, {held / 1e6:7.2f} MB held, {stored / 1e6:7.3f} MB stored")
    return results


def lift_many(kind: str, views: int) -> None:
    """What the memory part measures, in a process of its own; prints the peak [bytes]."""
    height, width = 1080, 1920
    gaussians, camera = synthetic_scene(100_000, height, width)
    make = {
        "id map": lambda seed: id_map(height, width, seed),
        "dense": lambda seed: dense_map(height // 4, width // 4, seed),
    }[kind]
    numbered = [View(f"{number:04d}", camera) for number in range(views)]
    sg.lift(gaussians, numbered, lambda view: make(int(view.stem)))
    print(1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)


def memory(views: int) -> dict[str, dict[str, float]]:
    """Peak memory of lifting `views` views of 1080p into 100,000 Gaussians, 512 channels.

    One map is in memory at a time, so a twentieth of the views has to do for the dense ones, which take long.
    """
    results = {}
    for kind, count in (("id map", views), ("dense", max(2, views // 20))):
        start = time.perf_counter()
        done = subprocess.run(
            [sys.executable, __file__, "--lift-many", kind, "--views", str(count)],
            check=True,
            capture_output=True,
            text=True,
        )
        peak = int(done.stdout.split()[-1])
        results[kind] = {"views": count, "peak bytes": peak, "seconds": time.perf_counter() - start}
        print(f"{count} views of 1080p, {kind}: peak {peak / 1e9:.2f} GB")
    return results


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", choices=["room", "time", "cost", "memory", []], help="all if none is named")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("encoders.json"))
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "sgwarp-benchmark-maps")
    parser.add_argument("--views", type=int, default=100, help="of the memory part")
    parser.add_argument("--rounds", type=int, default=6, help="of which the fastest counts, or views that are timed")
    parser.add_argument("--lift-many", choices=["id map", "dense"], help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.lift_many:
        lift_many(options.lift_many, options.views)
        return
    results = json.loads(options.out.read_text()) if options.out.is_file() else {}

    def save(part: str, found: dict[str, Any]) -> None:
        results[part] = found
        options.out.write_text(json.dumps(results, indent=1) + "\n")

    jobs = {
        "room": lambda: room(options.cache, lambda found: save("room", found)),
        "time": lambda: seconds_per_view(options.rounds),
        "cost": lambda: cost(options.rounds),
        "memory": lambda: memory(options.views),
    }
    for part in options.parts or jobs:
        save(part, jobs[part]())
    print(f"written to {options.out}")


if __name__ == "__main__":
    main()
