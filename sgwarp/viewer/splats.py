"""A shot as splats for the browser to draw: without harmonics, for small scenes and slow servers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgwarp.apps.editing.operations import SH_C0
from sgwarp.errors import InputError
from sgwarp.ops.planar.projection import rotation_matrices
from sgwarp.viewer.modes import BELOW, HIGHLIGHT, PAINTED, TINT, Shot

MOST_SPLATS = 1_000_000  # 32 bytes each
MODES = ("color", *PAINTED, "relevancy", "segmentation")  # that splats can show


@dataclass(frozen=True, eq=False)
class Splats:
    """What viser's `add_gaussian_splats` takes.

    Attributes:
        centers: [world units], float32 [N, 3].
        covariances: float32 [N, 3, 3].
        rgbs: In [0, 1], float32 [N, 3].
        opacities: In [0, 1], float32 [N, 1].
    """

    centers: NDArray[np.float32]
    covariances: NDArray[np.float32]
    rgbs: NDArray[np.float32]
    opacities: NDArray[np.float32]


def splats_of(shot: Shot) -> Splats:
    """The finite Gaussians of a shot with the colors of its mode.

    Raises:
        InputError: There are too many of them, or the mode is one of pictures only.
    """
    gaussians = shot.gaussians
    kept = gaussians.finite & (gaussians.opacities > 0)
    if int(kept.sum()) > MOST_SPLATS:
        raise InputError(f"splats: {int(kept.sum()):,} are too many for the browser, which takes {MOST_SPLATS:,}")
    if shot.mode not in MODES:
        raise InputError(f"splats: mode {shot.mode} is one of pictures; choose {', '.join(MODES)}")
    turn = rotation_matrices(torch.nn.functional.normalize(gaussians.quats[kept].double(), dim=1))
    axes = turn * gaussians.scales[kept].double()[:, None, :]
    colors = colors_of(shot)[kept]
    return Splats(
        _host(gaussians.means[kept]),
        _host(axes @ axes.transpose(1, 2)),
        _host(colors.clamp(0.0, 1.0)),
        _host(gaussians.opacities[kept][:, None]),
    )


def colors_of(shot: Shot) -> Tensor:
    """One color per Gaussian in the mode of a shot, float32 [N, 3]: that of the constant harmonic, mixed with paint or
    scores, and with the highlight where it is selected."""
    colors = (shot.gaussians.sh[:, 0] * SH_C0 + 0.5).cpu()
    if shot.mode in PAINTED and shot.paint is not None:
        known = torch.ones(len(colors), dtype=torch.bool) if shot.known is None else shot.known.cpu()
        mixed = (1 - shot.strength) * colors + shot.strength * shot.paint.cpu()
        colors = torch.where(known[:, None], mixed, colors)
    elif shot.mode in ("relevancy", "segmentation") and shot.scores is not None:
        values, seen = shot.scores.values.cpu(), shot.scores.seen.cpu()
        score, best = values.max(dim=1)
        found = seen & (score >= shot.threshold)
        own = torch.from_numpy(shot.colors).float()[best] / 255.0
        colors = torch.where(found[:, None], 0.3 * colors + 0.7 * own, BELOW * colors)
    if shot.selected is not None:
        tint = torch.tensor(HIGHLIGHT) / 255.0
        colors = torch.where(shot.selected.cpu()[:, None], (1 - TINT) * colors + TINT * tint, colors)
    return colors


def _host(values: Tensor) -> Any:
    return np.ascontiguousarray(values.detach().to("cpu", torch.float32).numpy())
