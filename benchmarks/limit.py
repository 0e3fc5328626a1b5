"""The limit: compositing, lifting and ranking by hand in C++ (limit.cpp), compiled here with g++, called by ctypes.

All functions take what a rasterizer has after binning, in numpy arrays:
    mean2d: Projected centres [pixels], float32 [M, 2].
    conic: a, b, c [1 / pixels^2], float32 [M, 3].
    opacity: float32 [M].
    offsets: First entry of each 16 x 16 tile in `ids`, row-major, int32 [tiles + 1].
    ids: Rows that may reach each tile, front to back, int32 [intersections].
`out` takes buffers to write to, so that a timing does not hold the first touch of fresh memory.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

PIXELS, SUMS = ("image", "alpha", "ranks"), ("ids", "dense", "weight")  # what the self-check compares
FOLDER = Path(__file__).parent
FLAGS = ("-O3", "-march=native", "-ffast-math", "-fopenmp", "-shared", "-fPIC", "-std=c++17", "-w")


@functools.cache
def library(name: str) -> ctypes.CDLL:
    """Compile `name`.cpp for this machine, once per version of it and of the headers beside it.

    Raises:
        RuntimeError: There is no g++, or it fails.
    """
    compiler = shutil.which("g++")
    if compiler is None:
        raise RuntimeError("the limit is compiled on the spot and needs g++ with OpenMP; install it (Debian: g++)")
    source = FOLDER / f"{name}.cpp"
    texts = [path.read_bytes() for path in (source, *sorted(FOLDER.glob("limit_*.h")))]
    key = hashlib.sha256(b"".join(texts) + " ".join((*FLAGS, platform.node())).encode()).hexdigest()[:16]
    folder = Path(tempfile.gettempdir()) / f"sgwarp-limit-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    target = folder / f"{name}-{key}.so"
    if not target.exists():
        fresh = folder / f"{name}-{key}.{os.getpid()}.so"
        done = subprocess.run([compiler, *FLAGS, str(source), "-o", str(fresh)], capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(f"g++ could not compile {source}:\n{done.stderr}")
        fresh.replace(target)
    return ctypes.CDLL(str(target))


def pointer(array: np.ndarray, dtype: type, shape: tuple[int, ...]) -> ctypes.c_void_p:
    right = array.dtype == dtype and array.shape == shape and array.flags.c_contiguous
    if not right:
        raise ValueError(f"expected contiguous {np.dtype(dtype)} {shape}, got {array.dtype} {array.shape}")
    return ctypes.c_void_p(array.ctypes.data)


def _tiles(offsets: np.ndarray, ids: np.ndarray, width: int, height: int) -> tuple[ctypes.c_void_p, ctypes.c_void_p]:
    count = -(-width // 16) * -(-height // 16)
    return pointer(offsets, np.int32, (count + 1,)), pointer(ids, np.int32, (len(ids),))


def composite(
    mean2d: np.ndarray,
    conic: np.ndarray,
    opacity: np.ndarray,
    color: np.ndarray,
    offsets: np.ndarray,
    ids: np.ndarray,
    width: int,
    height: int,
    threads: int = 1,
    out: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Composite colours float32 [M, 3] over black: float32 [H, W, 3], alpha [H, W] and the time taken [s].

    The time does not hold the packing of the splats, which the package's tile lists have behind them.
    """
    n, f = len(opacity), np.float32
    rgb, alpha = out or (np.empty((height, width, 3), f), np.empty((height, width), f))
    run = library("limit").composite
    run.restype = ctypes.c_double
    seconds = run(
        n,
        pointer(mean2d, f, (n, 2)),
        pointer(conic, f, (n, 3)),
        pointer(opacity, f, (n,)),
        pointer(color, f, (n, 3)),
        width,
        height,
        *_tiles(offsets, ids, width, height),
        threads,
        pointer(rgb, f, (height, width, 3)),
        pointer(alpha, f, (height, width)),
    )
    return rgb, alpha, seconds


def lift_ids(
    mean2d: np.ndarray,
    conic: np.ndarray,
    opacity: np.ndarray,
    offsets: np.ndarray,
    ids: np.ndarray,
    image: np.ndarray,
    channels: int,
    threads: int = 1,
    out: np.ndarray | None = None,
) -> np.ndarray:
    """Sum alpha T under the id of each pixel: image int32 [H, W], below `channels`, -1 for none; float32 [M, channels].

    `out` is added to.
    """
    n, f, (height, width) = len(opacity), np.float32, image.shape
    out = np.zeros((n, channels), f) if out is None else out
    library("limit").lift_ids(
        n,
        pointer(mean2d, f, (n, 2)),
        pointer(conic, f, (n, 3)),
        pointer(opacity, f, (n,)),
        width,
        height,
        *_tiles(offsets, ids, width, height),
        threads,
        pointer(image, np.int32, (height, width)),
        channels,
        pointer(out, f, (n, channels)),
    )
    return out


def lift_dense(
    mean2d: np.ndarray,
    conic: np.ndarray,
    opacity: np.ndarray,
    offsets: np.ndarray,
    ids: np.ndarray,
    image: np.ndarray,
    threads: int = 1,
    out: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Sum alpha T f(pixel) and alpha T: image float32 [H, W, C]; features float32 [M, C] and weight [M].

    `out` is added to.
    """
    n, f, (height, width, channels) = len(opacity), np.float32, image.shape
    features, weight = out or (np.zeros((n, channels), f), np.zeros(n, f))
    library("limit").lift_dense(
        n,
        pointer(mean2d, f, (n, 2)),
        pointer(conic, f, (n, 3)),
        pointer(opacity, f, (n,)),
        width,
        height,
        *_tiles(offsets, ids, width, height),
        threads,
        pointer(image, f, (height, width, channels)),
        channels,
        pointer(features, f, (n, channels)),
        pointer(weight, f, (n,)),
    )
    return features, weight


def rank(
    mean2d: np.ndarray,
    conic: np.ndarray,
    opacity: np.ndarray,
    offsets: np.ndarray,
    ids: np.ndarray,
    width: int,
    height: int,
    places: int,
    threads: int = 1,
    out: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """The `places` rows of largest alpha T at each pixel, int32 [H, W, places], -1 for none, and their alpha T."""
    n, f, shape = len(opacity), np.float32, (height, width, places)
    rows, weights = out or (np.empty(shape, np.int32), np.empty(shape, f))
    library("limit").rank(
        n,
        pointer(mean2d, f, (n, 2)),
        pointer(conic, f, (n, 3)),
        pointer(opacity, f, (n,)),
        width,
        height,
        *_tiles(offsets, ids, width, height),
        threads,
        places,
        pointer(rows, np.int32, shape),
        pointer(weights, f, shape),
    )
    return rows, weights


def self_check(threads: int = 2) -> dict[str, float]:
    """Compare all with the float64 oracle on a small room whose size fills no number of tiles.

    Pixels within 1e-4 of a threshold are left out of the comparison of images; lifting compares sums.

    Returns:
        Largest absolute difference of the image and alpha, and of the lifted sums over the largest sum.

    Raises:
        RuntimeError: One of them is not small.
    """
    import torch
    from scenes import LABELS, projected, room

    from sgwarp.ops.reference.lifting import lift_weighted
    from sgwarp.ops.reference.rasterizer import rasterize

    gaussians, camera, _ = room(3000, seed=1)
    camera = camera.resized(101, 150)
    p = projected(gaussians, camera)
    raster = rasterize(gaussians, camera)
    rgb, alpha, _ = composite(p.mean2d, p.conic, p.opacity, p.color, p.offsets, p.ids, p.width, p.height, threads)
    clear = ((raster.margin > 1e-4) & (raster.order_margin > 2e-6)).numpy()
    errors = {
        "image": float(np.abs(rgb - raster.features.numpy())[clear].max()),
        "alpha": float(np.abs(alpha - raster.alpha.numpy())[clear].max()),
    }
    ranked = rank(p.mean2d, p.conic, p.opacity, p.offsets, p.ids, p.width, p.height, 128, threads)[1]
    if ranked[..., -1].any() or (np.diff(ranked, axis=2) > 0).any():
        raise RuntimeError("limit.cpp: the lists of contributors are cut or out of order")
    errors["ranks"] = float(np.abs(ranked.sum(axis=2) - raster.alpha.numpy())[clear].max())
    rng = np.random.default_rng(0)
    labels = rng.integers(-1, len(LABELS), camera.size, dtype=np.int32)
    labels[:50] = 3  # one id over many tiles, besides tiles that hold all of them
    one_hot = np.concatenate([np.eye(len(LABELS)), np.zeros((1, len(LABELS)))])[labels]
    lists = (p.mean2d, p.conic, p.opacity, p.offsets, p.ids)
    expected = lift_weighted(gaussians, camera, torch.from_numpy(one_hot)).features.numpy()[p.order]
    got = lift_ids(*lists, labels, len(LABELS), threads)
    errors["ids"] = float(np.abs(got - expected).max() / expected.max())
    for channels in (5, 16, 40, 70):
        image = rng.random((*camera.size, channels), dtype=np.float32)
        lifted = lift_weighted(gaussians, camera, torch.from_numpy(image))
        features, weight = lift_dense(*lists, image, threads)
        for name, got, expected in (("dense", features, lifted.features), ("weight", weight, lifted.weight)):
            expected = expected.numpy()[p.order]
            errors[name] = max(errors.get(name, 0.0), float(np.abs(got - expected).max() / expected.max()))
    if (
        max(errors[k] for k in ("image", "alpha", "ranks")) > 1e-4
        or max(errors[k] for k in ("ids", "dense", "weight")) > 1e-3
    ):
        raise RuntimeError(f"limit.cpp differs from the oracle: {errors}")
    return errors


if __name__ == "__main__":
    print({name: f"{error:.1e}" for name, error in self_check().items()})
