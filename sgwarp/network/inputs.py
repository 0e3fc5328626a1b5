"""Input features of the network, and the voxel of each Gaussian."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.network.layers.sparse import SparseTensor, pool
from sgwarp.ops.planar.projection import rotation_matrices
from sgwarp.ops.sparse.voxels import key_points
from sgwarp.scene import Gaussians

InputMode = Literal["full", "xyz-rgb", "raw56", "ones", "signed-rgb"]
INPUT_CHANNELS: dict[str, int] = {"full": 10, "xyz-rgb": 3, "raw56": 56, "ones": 3, "signed-rgb": 3}
BRIGHTEST = 10.0  # colours and raw coefficients beyond this say nothing, and one would drown its neighbours
SH_C0 = 0.5 / math.sqrt(math.pi)  # value of the first spherical harmonic
ORIGIN_STEP = 16  # the coarsest voxels of a MinkUNet: an origin between them would change its grids
SMALLEST = 1e-10  # of scales [m] and of opacities before a logarithm


def input_features(gaussians: Gaussians, mode: InputMode, voxel: float) -> Tensor:
    """Input channels of finite Gaussians, float32 [N, C].

    - "full" (10): opacity, DC colour, and the covariance (paper, Sec. III-C): the six terms xx, xy, xz, yy, yz, zz of
      its matrix root R S R^T, in voxels, divided by 1 + its norm. The root turns with the scene as the covariance does,
      and unlike it spans few orders of magnitude.
    - "xyz-rgb" (3): DC colour alone; the coordinates are the voxels (the paper's ablation).
    - "ones" (3) and "signed-rgb" (3): ones, or the DC colour from -1 to 1, as OpenScene trains its networks without
      and with `input_color`.
    - "raw56": opacity logit, f_dc, f_rest channel by channel, log scales, quaternion: as a PLY file stores them, for
      networks trained with the paper's release.

    Args:
        gaussians: The scene.
        mode: See above.
        voxel: Side of a voxel [m].

    Raises:
        InputError: Unknown mode.
    """
    sh = gaussians.sh.clamp(-BRIGHTEST, BRIGHTEST)
    colors = 0.5 + SH_C0 * sh[:, 0]
    if mode == "xyz-rgb":
        return colors
    if mode == "ones":
        return torch.ones_like(colors)
    if mode == "signed-rgb":
        return (2.0 * colors - 1.0).clamp(-1.0, 1.0)
    if mode == "full":
        R = rotation_matrices(gaussians.quats)
        scales = gaussians.scales.double() / voxel  # finite scales may overflow in float32
        shape = (scales / (1.0 + scales.norm(dim=1, keepdim=True))).float()
        root = (R * shape[:, None, :]) @ R.transpose(1, 2)
        upper = root[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
        return torch.cat([gaussians.opacities[:, None], colors, upper], dim=1)
    if mode == "raw56":
        rest = sh.new_zeros(len(gaussians), 3, 15)
        rest[:, :, : sh.shape[1] - 1] = sh[:, 1:].transpose(1, 2)
        logit = torch.logit(gaussians.opacities, eps=1e-6)[:, None]
        scales = gaussians.scales.clamp(min=SMALLEST).log()
        return torch.cat([logit, sh[:, 0], rest.flatten(1), scales, gaussians.quats], dim=1)
    raise InputError(f"inputs '{mode}' do not exist; there are {', '.join(INPUT_CHANNELS)}")


class Voxelized(NamedTuple):
    """A scene as the network takes it: voxels, and the row of each Gaussian among them, -1 for none, int64 [N]."""

    voxels: SparseTensor
    rows: Tensor


def voxelize(gaussians: Gaussians, mode: InputMode, voxel: float) -> Voxelized:
    """Mean of the input channels over the Gaussians of every voxel.

    The grid starts near the median of the centres, so that it serves scenes at any place of the world. Gaussians that
    are not finite, have no direction, or lie more than 65,000 voxels away have no voxel.

    Raises:
        InputError: Unknown mode, a voxel size that is not positive, or no Gaussian has a voxel.
    """
    usable = gaussians.finite & (gaussians.quats.square().sum(dim=1) > 0)
    if not 0 < voxel < math.inf:
        raise InputError(f"voxel: expected a size above 0 [m], got {voxel}")
    if not bool(usable.any()):
        raise InputError("the scene holds no Gaussian whose values are all finite")
    step = ORIGIN_STEP * voxel
    middle = gaussians.means[usable].double().median(dim=0).values
    x, y, z = ((middle / step).floor() * step).tolist()
    keys = key_points(gaussians.means, (x, y, z), voxel)
    kept = usable & (keys >= 0)
    if not bool(kept.any()):
        raise InputError(f"voxel: with {voxel} m no Gaussian lies near enough to have a number; take larger voxels")
    voxels, rows_kept = pool(keys[kept], input_features(gaussians.subset(kept), mode, voxel))
    rows = torch.full((len(gaussians),), -1, dtype=torch.int64, device=gaussians.device)
    rows[kept] = rows_kept
    return Voxelized(voxels, rows)
