"""Gaussians that no view saw: what their neighbors have."""

from __future__ import annotations

from dataclasses import replace

import torch

from sgwarp.errors import InputError
from sgwarp.scene import Gaussians, Semantics

TRUST = 1e-3  # weight of a filled Gaussian over that of its neighbors
ROWS = 65_536


def fill_holes(gaussians: Gaussians, semantics: Semantics, neighbors: int = 3) -> Semantics:
    """Give every unseen Gaussian the mean feature of the seen ones nearest to it, weighted by inverse distance.

    A filled Gaussian has a thousandth of its neighbors' mean weight and no effective views, by which it can be told
    from one that was seen.

    Args:
        gaussians: The scene.
        semantics: Lifted into it.
        neighbors: How many, 1 or more.

    Raises:
        InputError: SciPy is not installed.
    """
    try:
        from scipy.spatial import cKDTree
    except ImportError:
        raise InputError("filling holes needs SciPy: pip install 'sgwarp[apps]'") from None
    device = semantics.features.device
    finite = gaussians.finite.to(device)
    seen, empty = (mask.nonzero().flatten() for mask in (semantics.seen & finite, ~semantics.seen & finite))
    if not len(seen) or not len(empty):
        return semantics
    means = gaussians.means.detach().double().cpu().numpy()
    tree = cKDTree(means[seen.cpu().numpy()])
    count = min(neighbors, len(seen))
    features, weight = semantics.features.clone(), semantics.weight.clone()
    for rows in empty.split(ROWS):
        distance, place = tree.query(means[rows.cpu().numpy()], k=list(range(1, count + 1)))
        near = seen[torch.from_numpy(place).to(device)]  # [rows, count]
        closeness = 1.0 / torch.from_numpy(distance).to(device).clamp(min=1e-12)
        shares = (closeness / closeness.sum(dim=1, keepdim=True)).to(torch.float32)
        mean = torch.zeros(len(rows), features.shape[1], device=device)
        for k in range(count):
            mean += shares[:, k, None] * semantics.features[near[:, k]].to(torch.float32)
        features[rows] = mean.to(features.dtype)
        weight[rows] = TRUST * semantics.weight[near].mean(dim=1)
    return replace(semantics, features=features, weight=weight)
