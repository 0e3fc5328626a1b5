"""gsplat's relocation of the Markov chain strategy, on the CPU as on CUDA."""

from __future__ import annotations

import torch
from torch import Tensor

from sgwarp.compat.gsplat.checks import expect_shape
from sgwarp.errors import InputError


def compute_relocation(opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity and scales of a Gaussian that becomes several in one place, as `gsplat.compute_relocation` gives them.

    Kheradmand et al. 2024, equation 9: together they look like the one they replace.

    Args:
        opacities: Of the Gaussians, [N].
        scales: Standard deviations [m], [N, 3].
        ratios: How many there are afterwards, integers [N], at least 1; more than n_max count as n_max.
        binoms: binoms[n, k] = n choose k, [n_max, n_max].

    Returns:
        New opacities [N] and scales [N, 3].

    Raises:
        InputError: Naming the argument that does not fit.
    """
    n = len(opacities)
    expect_shape("opacities", opacities, (n,))
    expect_shape("scales", scales, (n, 3))
    expect_shape("ratios", ratios, (n,))
    if binoms.ndim != 2 or binoms.shape[0] != binoms.shape[1] or not len(binoms):
        raise InputError(f"binoms: expected [n_max, n_max], got {list(binoms.shape)}")
    count = len(binoms)
    copies = ratios.to(torch.int64).clamp(1, count)
    opacity = opacities.to(torch.float64)
    shared = 1.0 - (1.0 - opacity) ** (1.0 / copies)
    k = torch.arange(count, device=opacities.device)
    terms = (-1.0) ** k * shared[:, None] ** (k + 1) / (k + 1.0).sqrt()  # [N, n_max]
    # Row i - 1 of the binomials is that of the i-th copy; only as many rows count as there are copies.
    weights = torch.tril(binoms.to(opacities.device, torch.float64)).cumsum(dim=0)
    total = (weights[copies - 1] * terms).sum(dim=1)
    return shared.to(opacities), (scales * (opacity / total)[:, None]).to(scales)
