"""Lifting one view against its render and against its inner loops by hand."""

from __future__ import annotations

import limit
import numpy as np
import scenes
import torch
from timing import Run, fastest, plural, report

from sgwarp.ops.splatting.forward import rasterize
from sgwarp.ops.splatting.lifting import LiftSums, lift_view
from sgwarp.scene import FeatureMap

DENSE = (16, 64, 512)


def label_image(height: int, width: int) -> np.ndarray:
    """About twenty segments with round borders, as a panoptic map has them."""
    y, x = np.mgrid[:height, :width] / height
    cells = np.floor(3 * (x + 0.1 * np.sin(7 * y))) + 100 * np.floor(3 * (y + 0.1 * np.cos(5 * x)))
    return np.unique(cells, return_inverse=True)[1].reshape(height, width).astype(np.int32)


def times_of(count: int, cores: int, rounds: int) -> dict[str, float]:
    """Ids against the view's render, dense channels against the limit's inner loops [ms]."""
    gaussians, camera, _ = scenes.room(count)
    height, width = camera.size
    packed = scenes.projected(gaussians, camera)
    geometry = (packed.mean2d, packed.conic, packed.opacity, packed.offsets, packed.ids)
    ids = label_image(height, width)
    labels = tuple(map(str, range(int(ids.max()) + 1)))
    id_map = FeatureMap(space="labels", ids=torch.from_numpy(ids), labels=labels)
    id_sums = LiftSums.zeros(count, len(labels))
    vectors = FeatureMap(space="v", ids=torch.from_numpy(ids), vectors=torch.randn(len(labels), 512))
    vector_sums = LiftSums.zeros(count, 512)
    runs = {
        "render": Run(lambda: rasterize(gaussians, camera), cores),
        "ids, one-hot": Run(lambda: lift_view(gaussians, camera, id_map, id_sums), cores),
        "ids, 512-d vectors": Run(lambda: lift_view(gaussians, camera, vectors, vector_sums), cores),
        "ids, limit": Run(lambda: limit.lift_ids(*geometry, ids, len(labels), threads=cores), cores),
    }
    times = fastest(runs, rounds)
    for channels in DENSE:
        dense = torch.randn(height, width, channels)
        image = dense.numpy()
        sums = LiftSums.zeros(count, channels)
        feature_map = FeatureMap(space="d", dense=dense)
        runs = {
            f"dense {channels}": Run(lambda m=feature_map, s=sums: lift_view(gaussians, camera, m, s), cores),
            f"dense {channels}, limit": Run(lambda i=image: limit.lift_dense(*geometry, i, threads=cores), cores),
        }
        times |= fastest(runs, max(2, rounds // 3))
    return times


def measure(headline: int, cores: int, rounds: int) -> dict[str, object]:
    """All of it, printed and returned."""
    times = times_of(headline, cores, rounds)
    print(f"\nLifting one view, {headline} Gaussians, {plural(cores)}")
    report("ids, one-hot / render", times["ids, one-hot"] / times["render"], "<= 1.5")
    report("ids, 512-d vectors / render", times["ids, 512-d vectors"] / times["render"])
    report("ids, one-hot / limit (without projection and binning)", times["ids, one-hot"] / times["ids, limit"])
    for channels in DENSE:
        report(f"dense {channels} [ms]", times[f"dense {channels}"])
        ratio = times[f"dense {channels}"] / times[f"dense {channels}, limit"]
        report(f"dense {channels} / limit (without projection and binning)", ratio)
    return dict(times)
