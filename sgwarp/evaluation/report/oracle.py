"""The float64 oracle on patches of a view: exact where a whole image would take minutes."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sgwarp.ops.reference import rasterizer as reference
from sgwarp.scene import Gaussians, View

SIDE = 16  # of a patch [pixels]
# No cut-offs: what the sum over all Gaussians converges to. Alpha below 2^-16 is beneath an 8-bit image's notice.
LIMIT = reference.ReferenceSettings(alpha_min=2.0**-16, transmittance_min=0.0)
SAME = reference.ReferenceSettings()  # with the renderer's own defaults: what remains is rounding

# Where a decision hangs on less than float32 resolves, the image may differ by a whole Gaussian. Such pixels are not
# measured but counted: an alpha or a transmittance this near (relatively) to its threshold, or two depths this close
# (relatively) that are not exactly equal.
THRESHOLD_BAND = 1e-4
ORDER_BAND = 2e-6


@dataclass(frozen=True, eq=False)
class Patches:
    """The oracle's rendering of patches of a view.

    Attributes:
        corners: (left, top) of each patch [pixels].
        colors: float64 [h, w, 3] of each.
        decided: Pixels at which float32 can take every decision, bool [h, w] of each.
    """

    corners: list[tuple[int, int]]
    colors: list[Tensor]
    decided: list[Tensor]

    @property
    def pixels(self) -> int:
        return sum(patch.shape[0] * patch.shape[1] for patch in self.colors)

    def pairs(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """The same pixels of a rendering [H, W, 3] and of the oracle, float64 [P, 3] each."""
        cut = [
            image[top : top + patch.shape[0], left : left + patch.shape[1]].double()
            for (left, top), patch in zip(self.corners, self.colors, strict=True)
        ]
        return torch.cat([c.reshape(-1, 3) for c in cut]), torch.cat([c.reshape(-1, 3) for c in self.colors])

    def rounding(self, image: Tensor) -> Tensor:
        """Largest error over the colours at each decided pixel, float64 [P]."""
        mine, exact = self.pairs(image)
        return (mine - exact).abs().amax(dim=1)[torch.cat([d.flatten() for d in self.decided])]


def see_patches(
    gaussians: Gaussians, view: View, count: int, settings: reference.ReferenceSettings, seed: int
) -> Patches:
    """Composite `count` patches of SIDE x SIDE pixels, drawn at random among the squares of a grid.

    Projection is that of the whole camera; a patch only moves the origin of the image.
    """
    camera = view.camera
    squares = [(left, top) for top in range(0, camera.height, SIDE) for left in range(0, camera.width, SIDE)]
    chosen = torch.randperm(len(squares), generator=torch.Generator().manual_seed(seed))[:count].sort().values
    corners = [squares[k] for k in chosen.tolist()]
    projection = reference.project_scene(gaussians, camera, settings)
    everything = reference.spherical_harmonics(
        gaussians.means[projection.index].double(), gaussians.sh[projection.index].double(), camera.world_to_camera
    )
    projection = replace(projection, index=torch.arange(len(everything)))
    colors, decided = [], []
    for left, top in corners:
        width, height = min(SIDE, camera.width - left), min(SIDE, camera.height - top)
        moved = replace(projection, mean2d=projection.mean2d - torch.tensor([left, top], dtype=torch.float64))
        seen = reference.composite(moved, everything, width, height, settings=settings)
        colors.append(seen.features)
        decided.append(decidable(seen))
    return Patches(corners, colors, decided)


def psnr(mine: Tensor, exact: Tensor) -> float:
    """Peak signal to noise ratio of colours with peak 1 [dB]; infinity if there is no difference."""
    mse = float((mine.double() - exact.double()).square().mean())
    return -10.0 * math.log10(mse) if mse > 0 else math.inf


def decidable(expected: reference.Raster) -> Tensor:
    """Pixels at which float32 can take every decision, bool [H, W]."""
    return (expected.margin > THRESHOLD_BAND) & (expected.order_margin > ORDER_BAND)
