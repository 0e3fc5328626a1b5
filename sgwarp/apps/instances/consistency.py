"""How often the labels of one Gaussian agree between views, before lifting and after it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sgwarp.apps.instances.association import name_groups
from sgwarp.apps.instances.counts import set_shares
from sgwarp.apps.instances.evidence import ViewEvidence, view_evidence
from sgwarp.apps.instances.maps import render_ids
from sgwarp.encoders.masks.sources import ViewMasks
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.scene import Gaussians, InstanceMap, View


def agreement(views: Sequence[ViewEvidence], labels: Sequence[NDArray[np.int64]], count: int) -> float:
    """Probability that two views that both label a Gaussian give it the same label.

    The label of a Gaussian in a view is drawn by weight from the masks that show it there; pixels in no mask are left
    out. Averaged over the pairs of views of a Gaussian, then over the Gaussians that two views or more label.

    Args:
        views: Evidence.
        labels: Label of every mask of each view, [M] per view.
        count: Number N of Gaussians.

    Returns:
        Between 0 and 1; NaN if no Gaussian is labeled twice.
    """
    from scipy import sparse

    columns = 1 + max((int(part.max()) + 1 for part in labels if len(part)), default=0)
    sums: Any = sparse.csr_matrix((count, columns))
    squares, times = np.zeros(count), np.zeros(count)
    for view, part in zip(views, labels, strict=True):
        shares = set_shares(view, np.arange(len(view.ranks)), part, columns)
        weights = sparse.csr_matrix((view.weights, (view.gaussians, view.sets)), shape=(count, shares.shape[0]))
        labeled = (weights @ shares).tolil(copy=False).tocsr()[:, 1:]
        total = np.asarray(labeled.sum(axis=1)).ravel()
        labeled = sparse.diags(np.where(total > 0, 1.0 / np.maximum(total, 1e-30), 0.0)) @ labeled
        squares += np.asarray(labeled.multiply(labeled).sum(axis=1)).ravel()
        times += total > 0
        sums = sums + sparse.hstack([sparse.csr_matrix((count, 1)), labeled], format="csr")
    twice = times >= 2
    same = np.asarray(sums.multiply(sums).sum(axis=1)).ravel() - squares
    pairs = times * (times - 1)
    return float((same[twice] / pairs[twice]).mean()) if twice.any() else float("nan")


def consistency(
    gaussians: Gaussians,
    views: Sequence[View],
    evidence: Sequence[ViewEvidence],
    found: InstanceMap,
    settings: RasterSettings,
) -> tuple[float, float]:
    """`agreement` of the names of the masks as they came, and of the id maps that the instances give in these views."""
    groups, _ = name_groups(evidence, "default")
    ends = np.cumsum([len(view.ranks) for view in evidence])
    before = agreement(evidence, np.split(groups, ends[:-1]), len(gaussians))
    stems = {view.stem: view for view in views}
    lifted, ids = [], []
    for one in evidence:
        view = stems[one.stem]
        shown, _ = render_ids(gaussians, found, view.camera, settings=settings)
        present = shown.unique()
        present = present[present > 0]
        masks = ViewMasks((shown == present[:, None, None]).cpu(), torch.full((len(present),), -1))
        lifted.append(view_evidence(gaussians, view, masks, settings))
        ids.append(present.cpu().numpy())
    return before, agreement(lifted, ids, len(gaussians))
