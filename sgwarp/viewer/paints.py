"""One color per Gaussian: principal components of the features, instances, and what the views saw."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.scene import Gaussians, InstanceMap, Semantics, View
from sgwarp.visualization.pictures import class_colours

SAMPLED = 20_000  # Gaussians that principal components are found from
ENDS = (0.02, 0.98)  # quantiles of a component that become dark and bright
CHUNK = 65536  # Gaussians projected at once
NEVER = (1.0, 0.0, 1.0)  # color of what no view saw
WELL_SEEN = 8.0  # effective views from which on the color stays the same


def feature_colors(semantics: Semantics) -> Tensor:
    """The first three principal components of the unit features as red, green and blue, float32 [N, 3]; 0 where
    nothing was seen.

    Components are those of the covariance of a sample of the seen Gaussians, signed so that their skew is positive.
    """
    rows = semantics.seen.nonzero().flatten()
    result = torch.zeros(len(semantics), 3)
    if len(rows) < 2:
        return result
    sample = _unit(semantics, rows[:: max(1, len(rows) // SAMPLED)])
    mean = sample.mean(dim=0)
    centered = (sample - mean).double()
    vectors = torch.linalg.eigh(centered.T @ centered / len(centered)).eigenvectors
    axes = vectors[:, -3:].flip(1)
    parts = centered @ axes
    axes = axes * torch.where((parts**3).sum(dim=0) < 0, -1.0, 1.0)
    low, high = torch.quantile(centered[: 2**20] @ axes, torch.tensor(ENDS, dtype=torch.float64), dim=0)
    span = torch.where(high > low, high - low, torch.inf)
    for start in range(0, len(rows), CHUNK):
        some = rows[start : start + CHUNK]
        scaled = ((_unit(semantics, some).double() - mean) @ axes - low) / span
        result[some.cpu(), : axes.shape[1]] = scaled.clamp(0.0, 1.0).float()
    return result


def _unit(semantics: Semantics, rows: Tensor) -> Tensor:
    return torch.nn.functional.normalize(semantics.features[rows].to("cpu", torch.float32), dim=1)


def instance_colors(found: InstanceMap, level: str | None = None) -> tuple[Tensor, Tensor]:
    """A color per instance, float32 [N, 3], and which Gaussians belong to one, bool [N].

    Raises:
        InputError: There is no such level.
    """
    ids = found.instance(level).cpu()
    table = torch.from_numpy(class_colours(len(found.table))).float() / 255.0
    known = ids > 0
    paint = torch.zeros(len(ids), 3)
    paint[known] = table[ids[known] - 1]
    return paint, known


def coverage_colors(gaussians: Gaussians, semantics: Semantics | None, views: Sequence[View]) -> Tensor:
    """How much of the views saw each Gaussian, from red (one) to green (8 or more), magenta for none, float32 [N, 3].

    Views count as effective ones, by the weight that each adds, where semantics were lifted; else those in whose image
    the center lies, whatever hides it.

    Raises:
        InputError: There are neither semantics nor views.
    """
    if semantics is not None:
        count = semantics.effective_views.cpu()
    elif views:
        from sgwarp.reconstruction.fitting.coverage import in_view

        means = gaussians.means.cpu()
        count = torch.stack([in_view(view.camera, means) for view in views]).sum(dim=0).float()
    else:
        raise InputError("coverage: needs --semantics or --views, to tell what was looked at")
    share = ((count - 1.0) / (WELL_SEEN - 1.0)).clamp(0.0, 1.0)[:, None]
    paint = (1 - share) * torch.tensor((0.9, 0.15, 0.1)) + share * torch.tensor((0.1, 0.75, 0.2))
    return torch.where(count[:, None] > 0, paint, torch.tensor(NEVER))
