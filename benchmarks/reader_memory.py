"""Memory that readers take for large, good files: the peak over what the process held, as a multiple of the file.

    python benchmarks/reader_memory.py [--megabytes 100] [--only NAMES] [--out benchmarks/reader_memory.json]

Files are written to a temporary folder one after the other; each is read in a process of its own, twice: a small one
first, so that libraries and what they keep are there, then the large one. docs/reliability.md states the rule: at most
four times the file plus 64 MB, or a bound of its own. Linux.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from sgwarp.files.images import read_ids, read_rgb
from sgwarp.io.colmap import read_colmap
from sgwarp.io.points import load_points
from sgwarp.io.scenes import load_gaussians, save_gaussians
from sgwarp.io.store import load_semantics, save_semantics
from sgwarp.io.transforms import read_transforms
from sgwarp.network.checkpoint import read_weights
from sgwarp.runs.memory import peak, reset_peak, resident
from sgwarp.scene import Gaussians, Semantics

ALLOWANCE = 64 * 2**20  # bytes, of the rule
Write = Callable[[Path, int], Path]
Read = Callable[[Path], object]


def cloud(count: int, degree: int) -> Gaussians:
    random = torch.Generator().manual_seed(0)
    quats = torch.nn.functional.normalize(torch.randn(count, 4, generator=random), dim=1)
    scales = 0.01 * torch.rand(count, 3, generator=random) + 1e-3
    opacities = 0.9 * torch.rand(count, generator=random) + 0.05
    sh = torch.randn(count, (degree + 1) ** 2, 3, generator=random)
    return Gaussians(torch.randn(count, 3, generator=random), quats, scales, opacities, sh)


def scene(name: str, degree: int, bytes_each: float) -> tuple[Write, Read]:
    def write(folder: Path, size: int) -> Path:
        save_gaussians(cloud(max(int(size / bytes_each), 300), degree), folder / name)
        return folder / name

    return write, load_gaussians


def text_ply(folder: Path, size: int) -> Path:
    """As plyfile writes it from a binary one."""
    from plyfile import PlyData

    save_gaussians(cloud(max(size // 180, 300), 0), folder / "binary.ply")
    content = PlyData.read(str(folder / "binary.ply"))
    content.text = True
    content.write(str(folder / "text.ply"))
    return folder / "text.ply"


def sog(folder: Path, size: int, degree: int) -> Path:
    """Noise in every picture, as far as the format has room for it; with harmonics, from as many palettes as it has."""
    each = 15.5 + 2 * (degree > 0)  # bytes of a Gaussian
    palettes, width = 65536, {0: 0, 3: 15}[degree]
    side = max(int(((size - 3 * palettes * width) / each if size > 10_000_000 else size / each) ** 0.5), 16)
    rng, count = np.random.default_rng(0), side * side
    book = np.linspace(-2, 2, 256).tolist()
    meta: dict[str, Any] = {"version": 2, "count": count, "means": {"mins": [-1] * 3, "maxs": [1] * 3}}
    meta |= {name: {"codebook": book} for name in ("scales", "sh0")} | {"quats": {}}
    with zipfile.ZipFile(folder / "a.sog", "w") as archive:

        def add(section: str, names: Sequence[str], height: int, columns: int, alpha: Any = 255) -> None:
            meta[section]["files"] = [*meta[section].get("files", ()), *names]
            for name in names:
                pixels = rng.integers(0, 256, (height, columns, 4), dtype=np.uint8)
                pixels[..., 3] = rng.integers(*alpha, (height, columns)) if isinstance(alpha, tuple) else alpha
                if name == "shN_labels.webp":
                    pixels[..., 0] = 0
                _, data = cv2.imencode(".webp", pixels, [cv2.IMWRITE_WEBP_QUALITY, 101])  # above 100: lossless
                archive.writestr(name, data.tobytes())

        add("means", ("means_l.webp", "means_u.webp"), side, side)
        add("scales", ("scales.webp",), side, side)
        add("quats", ("quats.webp",), side, side, (252, 256))
        add("sh0", ("sh0.webp",), side, side, (0, 256))
        if degree:
            meta["shN"] = {"count": palettes, "bands": degree, "codebook": book}
            add("shN", ("shN_centroids.webp",), palettes // 64, 64 * width)
            add("shN", ("shN_labels.webp",), side, side)
        archive.writestr("meta.json", json.dumps(meta))
    return folder / "a.sog"


def colmap(folder: Path, size: int, suffix: str) -> Path:
    """One camera, photographs with observations, and points with tracks, of about this size together."""
    model = folder / f"model_{suffix}"
    model.mkdir()
    rng = np.random.default_rng(0)
    images, seen = max(size // 200_000, 4), 4_000
    points, track = max(size // 150, 100), 6
    if suffix == "txt":
        (model / "cameras.txt").write_text("1 PINHOLE 640 480 500 500 320 240\n")
        with open(model / "images.txt", "w") as out:
            for k in range(1, images + 1):
                out.write(f"{k} 1 0 0 0 {k} 0 0 1 {k:06d}.png\n")
                out.write(" ".join(f"{x:.3f} {y:.3f} {k}" for x, y in rng.random((seen, 2)) * 400) + "\n")
        with open(model / "points3D.txt", "w") as out:
            for k in range(1, points + 1):
                x, y, z = rng.random(3)
                out.write(f"{k} {x:.6f} {y:.6f} {z:.6f} 10 20 30 0.5 " + "1 7 " * track + "\n")
        return model
    one = np.array([(1, 1, 640, 480, (500, 500, 320, 240))], "<i4,<i4,<u8,<u8,(4,)<f8")
    (model / "cameras.bin").write_bytes(np.uint64(1).tobytes() + one.tobytes())
    observation = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
    with open(model / "images.bin", "wb") as out:
        out.write(np.uint64(images).tobytes())
        for k in range(1, images + 1):
            head = np.array([(k, (1, 0, 0, 0), (k, 0, 0), 1)], "<i4,(4,)<f8,(3,)<f8,<i4").tobytes()
            out.write(head + f"{k:06d}.png".encode() + b"\0" + np.uint64(seen).tobytes())
            out.write(np.zeros(seen, observation).tobytes())
    row = np.dtype(
        [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("n", "<u8"), ("t", "<i4", 12)]
    )
    rows = np.zeros(points, row)
    rows["id"], rows["xyz"], rows["n"] = np.arange(1, points + 1), rng.random((points, 3)), track
    (model / "points3D.bin").write_bytes(np.uint64(points).tobytes() + rows.tobytes())
    return model


def read_views(model: Path) -> object:
    return read_colmap(model, photographs=False)


def read_model_points(model: Path) -> object:
    return load_points(next(model.glob("points3D.*")))


def transforms(folder: Path, size: int) -> Path:
    pose = [[1.0, 0.0, 0.0, 0.123456], [0.0, 1.0, 0.0, 1.5], [0.0, 0.0, 1.0, -2.25], [0.0, 0.0, 0.0, 1.0]]
    frames = [{"file_path": f"{k:07d}.png", "transform_matrix": pose} for k in range(max(size // 170, 3))]
    about = {"fl_x": 50.0, "fl_y": 50.0, "cx": 32.0, "cy": 24.0, "w": 64, "h": 48}
    (folder / "transforms.json").write_text(json.dumps(about | {"frames": frames}))
    return folder


def image(folder: Path, size: int, name: str, kind: type, channels: int, bytes_each: float) -> Path:
    """Noise, which packs badly; so the file is large for its pixels."""
    side = max(int((size / bytes_each) ** 0.5), 16)
    shape = (side, side, channels) if channels > 1 else (side, side)
    cv2.imwrite(str(folder / name), np.random.default_rng(0).integers(0, np.iinfo(kind).max, shape).astype(kind))
    return folder / name


def semantics(folder: Path, size: int) -> Path:
    count = max(size // 268, 10)
    features = torch.randn(count, 128).half()
    one = Semantics(features, torch.ones(count), torch.ones(count), "x", cloud(10, 0).fingerprint)
    save_semantics(one, folder / "s.safetensors", {})
    return folder / "s.safetensors"


def weights(folder: Path, size: int) -> Path:
    one = {f"net.layer{k}.weight": torch.randn(max(size // 40, 10)) for k in range(10)}
    torch.save({"state_dict": one}, folder / "net.pth")
    return folder / "net.pth"


CASES: dict[str, tuple[Write, Read]] = {
    "PLY, degree 3": scene("a.ply", 3, 236),
    "PLY, degree 0": scene("b.ply", 0, 65),
    "PLY as text, degree 0": (text_ply, load_gaussians),
    "compressed PLY, degree 3": scene("a.compressed.ply", 3, 61),
    "compressed PLY, degree 0": scene("b.compressed.ply", 0, 16),
    "SPZ, degree 1": scene("a.spz", 1, 21),
    "SOG, degree 3": (lambda folder, size: sog(folder, size, 3), load_gaussians),
    "SOG, degree 0": (lambda folder, size: sog(folder, size, 0), load_gaussians),
    ".splat": scene("a.splat", 0, 32),
    "glTF, degree 1": scene("a.glb", 1, 92),
    "COLMAP's images.bin and the rest": (lambda folder, size: colmap(folder, size, "bin"), read_views),
    "COLMAP's points3D.bin": (lambda folder, size: colmap(folder, size, "bin"), read_model_points),
    "COLMAP's images.txt and the rest": (lambda folder, size: colmap(folder, size, "txt"), read_views),
    "COLMAP's points3D.txt": (lambda folder, size: colmap(folder, size, "txt"), read_model_points),
    "transforms.json": (transforms, lambda folder: read_transforms(folder / "transforms.json", False)),
    "PNG, 8 bit color": (lambda f, s: image(f, s, "a.png", np.uint8, 3, 3.0), read_rgb),
    "JPEG": (lambda f, s: image(f, s, "a.jpg", np.uint8, 3, 1.5), read_rgb),
    "label PNG, 16 bit": (lambda f, s: image(f, s, "l.png", np.uint16, 1, 2.0), read_ids),
    "semantics, half precision": (semantics, load_semantics),
    "weights of torch.save": (weights, read_weights),
}


def size_of(path: Path) -> int:
    return (
        sum(file.stat().st_size for file in path.rglob("*") if file.is_file()) if path.is_dir() else path.stat().st_size
    )


def measure(name: str, megabytes: float) -> dict[str, Any]:
    """In this process: bytes of the file, and the peak of reading it over what was held before."""
    write, read = CASES[name]
    with tempfile.TemporaryDirectory() as small, tempfile.TemporaryDirectory() as large:
        read(write(Path(small), 100_000))
        path = write(Path(large), int(megabytes * 1e6))
        reset_peak()
        before = resident()
        content = read(path)
        more = peak() - before
        del content
        size = size_of(path)
    return {"bytes": size, "peak": more, "times, less 64 MB": round(max(more - ALLOWANCE, 0) / size, 2)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--megabytes", type=float, default=100.0)
    parser.add_argument("--only", nargs="*", choices=CASES, default=list(CASES))
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("reader_memory.json"))
    parser.add_argument("--here", action="store_true", help="measure the first of --only in this process and print it")
    options = parser.parse_args()
    if options.here:
        print(json.dumps(measure(options.only[0], options.megabytes)))
        return
    results = json.loads(options.out.read_text()) if options.out.is_file() else {}
    for name in options.only:
        command = [sys.executable, __file__, "--here", "--megabytes", str(options.megabytes), "--only", name]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"{name}: {done.stderr[-2000:]}")
        results[name] = json.loads(done.stdout.splitlines()[-1])
        print(f"{name}: {results[name]}", flush=True)
        options.out.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
