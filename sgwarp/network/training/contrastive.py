"""The contrastive loss: rendered features of a mask against the vectors of all masks of its view.

The paper's loss compares the network's features with lifted ones, Gaussian by Gaussian. This one asks what they look
like: the features of the strongest contributors of each pixel are rendered, averaged over each mask, and have to be
nearer to the vector of that mask than to those of the others (InfoNCE, as in Quantile Rendering, arXiv 2512.20927).
Rendering and mean are linear, so a mask is one sparse row of weights over the voxels, and no image of features is made.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from sgwarp.errors import InputError
from sgwarp.ops.splatting.contributors import top_contributors
from sgwarp.scene import Camera, FeatureMap, Gaussians

SAME = 0.999  # cosine from which the vectors of two masks mean the same
LEAST_SHARE = 0.5  # of a mask's pixels that has to be covered by what has a voxel


@dataclass(frozen=True, eq=False)
class MaskedView:
    """A view with masks: ids with a vector each, or label images.

    Raises:
        InputError: The map is dense, so it has no masks.
    """

    camera: Camera
    masks: FeatureMap

    def __post_init__(self) -> None:
        if self.masks.ids is None:
            raise InputError("contrastive loss: needs masks, id maps with a vector each; this encoder gives dense maps")


@dataclass(frozen=True, eq=False)
class MaskRows:
    """Weights of the masks of a view over voxels, and what the masks mean.

    Attributes:
        mask: Row of each entry, int64 [E].
        voxel: Column, int64 [E].
        weight: Sum of alpha T over the mask's pixels, over their number, float32 [E].
        vectors: Unit vectors of the masks, float32 [M, C].
    """

    mask: Tensor
    voxel: Tensor
    weight: Tensor
    vectors: Tensor


def mask_rows(gaussians: Gaussians, voxels: Tensor, view: MaskedView, contributors: int) -> MaskRows:
    """The sparse matrix that takes features of voxels to the mean rendered features of a view's masks.

    Args:
        gaussians: The scene.
        voxels: Voxel of each Gaussian, -1 for none, int64 [N].
        view: With M masks, of which those are left out that hardly show anything with a voxel.
        contributors: How many a pixel has.
    """
    assert view.masks.ids is not None
    camera = view.camera.resized(*view.masks.size)
    owners, weights = top_contributors(gaussians, camera, contributors)
    owners, weights = owners.flatten(0, 1), weights.flatten(0, 1)
    column = torch.where(owners >= 0, voxels.to(owners.device)[owners.clamp(min=0).long()], -1)
    count = view.masks.channels if view.masks.vectors is None else len(view.masks.vectors)
    parts = []
    sizes = torch.zeros(count, device=owners.device)
    for level in view.masks.ids.to(owners.device):
        mask = level.flatten().long()
        sizes += torch.bincount(mask[mask >= 0], minlength=count)
        held = (mask[:, None] >= 0) & (column >= 0) & (weights > 0)
        row = mask[:, None].expand_as(column)[held]
        parts.append((row * (len(gaussians) + 1) + column[held], weights[held]))
    keys, place = torch.cat([key for key, _ in parts]).unique(return_inverse=True)
    total = torch.zeros(len(keys), device=owners.device).index_add_(0, place, torch.cat([w for _, w in parts]))
    row, voxel = keys // (len(gaussians) + 1), keys % (len(gaussians) + 1)
    shown = torch.zeros(count, device=owners.device).index_add_(0, row, total) / sizes.clamp(min=1)
    kept = (shown >= LEAST_SHARE).nonzero().flatten()
    number = torch.full((count,), -1, device=owners.device)
    number[kept] = torch.arange(len(kept), device=owners.device)
    mine = number[row] >= 0
    vectors = torch.eye(count) if view.masks.vectors is None else view.masks.vectors
    unit = normalize(vectors.to(owners.device, torch.float32), dim=1)[kept]
    return MaskRows(number[row[mine]], voxel[mine], (total / sizes[row].clamp(min=1))[mine], unit)


def contrastive_loss(predicted: Tensor, rows: MaskRows, temperature: float) -> Tensor:
    """Mean over the masks of -log of the share that softmax(cosine / temperature) over all masks gives to the vectors
    that mean the same as its own.

    Args:
        predicted: Features of the voxels, float32 [V, C].
        rows: Of the masks of a view, at least one.
        temperature: Of the softmax.
    """
    pooled = predicted.new_zeros(len(rows.vectors), predicted.shape[1])
    pooled = pooled.index_add(0, rows.mask, rows.weight[:, None] * predicted[rows.voxel])
    logits = normalize(pooled, dim=1, eps=1e-20) @ rows.vectors.T / temperature
    same = rows.vectors @ rows.vectors.T > SAME
    share = logits.masked_fill(~same, -torch.inf).logsumexp(dim=1) - logits.logsumexp(dim=1)
    return -share.mean()
