"""Gaussians under a map of space that bends it."""

from __future__ import annotations

from dataclasses import replace

import torch
import warp as wp
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.kernels.points import deformation
from sgwarp.ops.arguments import view
from sgwarp.ops.launcher import launch
from sgwarp.scene import Gaussians


def deformed(gaussians: Gaussians, means: Tensor, jacobians: Tensor) -> Gaussians:
    """The scene under a smooth map: centres as given, every covariance Sigma becomes J Sigma J^T.

    To first order, that is what the map does to a Gaussian small against its bends. Colours keep their directions.

    Args:
        gaussians: The scene, N Gaussians.
        means: Where the map takes the centres [m], float32 [N, 3].
        jacobians: J of the map at each centre, float32 [N, 3, 3].

    Raises:
        InputError: Another shape.
    """
    n, device = len(gaussians), gaussians.device
    if tuple(means.shape) != (n, 3) or tuple(jacobians.shape) != (n, 3, 3):
        shapes = f"{list(means.shape)} and {list(jacobians.shape)}"
        raise InputError(f"expected means [{n}, 3] and jacobians [{n}, 3, 3], got {shapes}")
    quats, scales = torch.empty_like(gaussians.quats), torch.empty_like(gaussians.scales)
    inputs = [view(jacobians.contiguous(), wp.mat33), view(gaussians.quats, wp.vec4), view(gaussians.scales, wp.vec3)]
    launch(deformation.deform_shapes, n, inputs, [view(quats, wp.vec4), view(scales, wp.vec3)], device=device)
    return replace(gaussians, means=means, quats=quats, scales=scales)
