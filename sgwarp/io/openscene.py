"""Features per point as OpenScene (Peng et al., 2023) stores them, and after it the release of Semantic Gaussians.

    {scene}_{n}.pt    {"feat": half [M, C], "mask_full": bool [N]}    the features of the M points where the mask is set

The N points are the scene's Gaussians, in their order. Nothing is lifted: these features have been fused already.
"""

from __future__ import annotations

import os

import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.files.torch_files import load_torch
from sgwarp.scene import Gaussians, Semantics


def load_openscene(path: str | os.PathLike[str], gaussians: Gaussians, space: str | None = None) -> Semantics:
    """Fused features of a scene's Gaussians.

    Args:
        path: The file.
        gaussians: The scene that they were made for.
        space: Name of their embedding space, as its encoder of phrases knows it; "files:C" if None.

    Returns:
        Semantics with weight 1 where there are features; how many views are behind them is not in the file.

    Raises:
        InputError: The file is missing, damaged, or was made for another number of points.
    """
    content = load_torch(path)
    if not isinstance(content, dict) or not {"feat", "mask_full"} <= set(content):
        raise InputError(f"{path}: is no .pt with feat and mask_full")
    features, mask = content["feat"], content["mask_full"]
    if not isinstance(features, Tensor) or not isinstance(mask, Tensor) or mask.dtype != torch.bool:
        raise InputError(f"{path}: expected tensors feat [M, C] and mask_full, bool [N]")
    if features.ndim != 2 or not features.is_floating_point() or mask.ndim != 1 or len(features) != int(mask.sum()):
        shapes = f"feat {list(features.shape)}, mask_full {list(mask.shape)} with {int(mask.sum())} set"
        raise InputError(f"{path}: expected one row of feat for each point that mask_full sets, got {shapes}")
    if len(mask) != len(gaussians):
        raise InputError(f"{path}: was made for {len(mask)} points, the scene has {len(gaussians)} Gaussians")
    whole = features.new_zeros(len(mask), features.shape[1])
    whole[mask] = features
    weight = mask.to(torch.float32)
    named = space or f"files:{features.shape[1]}"
    return Semantics(whole, weight, weight.clone(), named, gaussians.fingerprint)
