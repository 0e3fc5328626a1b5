"""Training scenes: pairs of a scene and its lifted semantics, and what one training step is given of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.network.augmentation import Augmentation
from sgwarp.network.inputs import InputMode, voxelize
from sgwarp.network.layers.sparse import SparseTensor
from sgwarp.network.training.batches import Lifted, batch_results, is_batch
from sgwarp.network.training.contrastive import MaskedView
from sgwarp.scene import Gaussians, Semantics

CHUNK = 65536  # Gaussians whose features are widened at once
KEPT = 4  # scenes whose views and sources of masks stay: those of a step, not those of a data set
LoadMasks = Callable[[], MaskedView]
MasksOf = Callable[[Path], list[LoadMasks]]


@dataclass(frozen=True)
class TrainingScene:
    """A scene by name, read anew each time it is its turn: a data set need not fit into memory."""

    name: str
    load: Callable[[], tuple[Gaussians, Semantics]]
    stamp: str = ""  # changes when the files do: a run is not resumed on other data
    files: tuple[Path, ...] = ()
    masks: Callable[[], list[LoadMasks]] | None = None  # of the views, for the contrastive loss


def scenes_in(paths: Sequence[Path], masks: MasksOf | None = None) -> list[TrainingScene]:
    """Scenes {name}.ply with what `sgwarp lift` wrote for them, {name}.safetensors, beside each.

    Args:
        paths: Scenes, folders of them, or what `sgwarp batch` wrote: its folder of results, or that of one scene. Of
            those the scenes count that are done.
        masks: Masks of the views of a scene, given their folder, for the contrastive loss.

    Raises:
        InputError: A folder holds no scene, or a scene has no semantics beside it.
    """
    found: list[Lifted] = []
    for path in paths:
        inside = batch_results(path) if path.is_dir() else []
        if not inside and not is_batch(path):
            inside = [_beside(ply) for ply in (sorted(path.glob("*.ply")) if path.is_dir() else [path])]
            if not inside:
                raise InputError(f"{path}: holds no scene .ply")
        found += inside
    if paths and not found:
        raise InputError(f"{paths[0]}: no scene of this batch is done; see why in its summary.csv")
    few = None if masks is None else lru_cache(KEPT)(masks)
    return [_scene(lifted, few) for lifted in found]


def _beside(path: Path) -> Lifted:
    stem = path.with_name(path.name.removesuffix(".ply").removesuffix(".compressed"))
    return Lifted(path, stem.with_name(f"{stem.name}.safetensors"), stem)


def _scene(lifted: Lifted, masks: MasksOf | None) -> TrainingScene:
    path, semantics = lifted.scene, lifted.semantics
    if not path.is_file():
        raise InputError(f"{path}: no such file; check the path")
    if not semantics.is_file():
        raise InputError(f"{path}: has no {semantics.name} beside it; write one with `sgwarp lift`")

    def load() -> tuple[Gaussians, Semantics]:
        from sgwarp.io.scenes import load_gaussians
        from sgwarp.io.store import load_semantics

        gaussians = load_gaussians(path)
        return gaussians, load_semantics(semantics, gaussians)

    files = (path, semantics)
    stamp = " ".join(f"{file.stat().st_size}:{file.stat().st_mtime_ns}" for file in files)
    return TrainingScene(str(path), load, stamp, files, None if masks is None else partial(masks, lifted.views))


@dataclass(frozen=True, eq=False)
class Example:
    """One scene as a training step sees it.

    Attributes:
        voxels: Input of the network.
        targets: Mean direction of the lifted features in each voxel that has some, unit vectors [T, C].
        rows: Their voxels, int64 [T].
        weights: Reliability of each target, or ones, [T].
        of_gaussians: Voxel of every Gaussian, -1 for none, int64 [N].
    """

    voxels: SparseTensor
    targets: Tensor
    rows: Tensor
    weights: Tensor
    of_gaussians: Tensor


def reliability(semantics: Semantics) -> Tensor:
    """Reliability of lifted features, float32 [N] from 0 (not seen) to 1.

    w / (w + median w) times v / (v + 1), with w its weight and v the views that share it: a single grazing pixel says
    little, and one view alone may be wrong.
    """
    seen = semantics.seen
    if not bool(seen.any()):
        return torch.zeros_like(semantics.weight)
    weight, views = semantics.weight, semantics.effective_views
    return weight / (weight + weight[seen].median()) * views / (views + 1.0)


def make_example(
    gaussians: Gaussians,
    semantics: Semantics,
    inputs: InputMode,
    voxel: float,
    *,
    augment: Augmentation | None = None,
    generator: torch.Generator | None = None,
    by_reliability: bool = False,
) -> Example:
    """Voxels of a scene, changed at random if asked for, and what the network should say about them.

    Raises:
        InputError: The semantics belong to another scene, or no Gaussian falls into a voxel.
    """
    semantics.require_scene(gaussians)
    if augment is not None:
        gaussians = augment(gaussians, voxel, generator or torch.Generator())
    voxels, rows = voxelize(gaussians, inputs, voxel)
    trust = reliability(semantics) if by_reliability else semantics.seen.to(torch.float32)
    trust = torch.where(rows >= 0, trust.to(rows.device), 0.0)
    known = (trust > 0).nonzero()[:, 0]
    here = rows[known]
    count = len(voxels.features)
    sums = voxels.features.new_zeros(count, semantics.features.shape[1])
    for start in range(0, len(known), CHUNK):
        part = known[start : start + CHUNK]
        features = semantics.features[part.to(semantics.features.device)].to(sums)
        unusable = ~torch.isfinite(features).all(dim=1)
        trust[part[unusable]] = 0.0
        unit = torch.nn.functional.normalize(torch.where(unusable[:, None], 0.0, features), dim=1, eps=1e-20)
        sums.index_add_(0, here[start : start + CHUNK], unit * trust[part][:, None])
    weights = sums.new_zeros(count).index_add_(0, here, trust[known])
    filled = (sums.square().sum(dim=1) > 0).nonzero()[:, 0]
    targets = torch.nn.functional.normalize(sums[filled], dim=1, eps=1e-20)
    mean_trust = weights[filled] / sums.new_zeros(count).index_add_(0, here, torch.ones_like(trust[known]))[filled]
    return Example(voxels, targets, filled, mean_trust, rows)
