"""Where the grid of a scene starts, and how much of an opacity the network is shown."""

import math
from dataclasses import replace

import pytest
import torch

from sgwarp.network.inputs import input_features, voxelize
from sgwarp.scene import Gaussians


def cloud(centre: tuple[float, float, float], count: int = 60) -> Gaussians:
    g = torch.Generator().manual_seed(0)
    return Gaussians(
        means=torch.rand(count, 3, generator=g) + torch.tensor(centre),
        quats=torch.tensor([1.0, 0, 0, 0]).expand(count, 4),
        scales=torch.full((count, 3), 0.01),
        opacities=torch.full((count,), 0.5),
        sh=torch.zeros(count, 1, 3),
    )


@pytest.mark.parametrize("centre", [(1000.0, 0.0, 0.0), (0.0, -1000.0, 0.0), (0.0, 0.0, 3000.0)])
def test_fine_voxels_serve_a_scene_far_from_the_origin(centre):
    """At 5 mm the origin of the world lies more than the 65,000 voxels away that have a number."""
    rows = voxelize(cloud(centre), "ones", 0.005).rows
    assert bool((rows >= 0).all())


@pytest.mark.parametrize("voxel", [0.02, 0.3, 2.0])
def test_the_grid_starts_within_sixteen_voxels_of_the_median(voxel):
    gaussians = cloud((57.3, -21.9, 130.4))
    voxels, rows = voxelize(gaussians, "ones", voxel)
    cells = voxels.coordinates[rows, 1:].double()
    means = gaussians.means.double()
    middle = means.median(dim=0).values
    # The origin lies where every centre falls into its voxel: an interval of each axis.
    low = (means - (cells + 1) * voxel).amax(dim=0)
    high = (means - cells * voxel).amin(dim=0)
    assert bool((low <= high).all())
    assert bool((high <= middle + 1e-6).all())
    assert bool((middle - low < 17 * voxel).all())
    # It is a multiple of sixteen voxels, the coarsest of the network, so that the coarse ones keep their places.
    multiple = (high / (16 * voxel) + 1e-6).floor() * 16 * voxel
    assert bool((multiple >= low - 1e-6).all())


@pytest.mark.parametrize("logit", [-13.7, -8.0, 0.0, 8.0, 13.7])
def test_logits_of_files_come_back_as_far_as_float32_tells_them(logit):
    opacity = torch.sigmoid(torch.tensor(logit, dtype=torch.float64))
    gaussians = replace(cloud((0.0, 0.0, 0.0), 1), opacities=opacity.float()[None])
    assert float(input_features(gaussians, "raw56", 0.02)[0, 0]) == pytest.approx(logit, abs=0.05)


@pytest.mark.parametrize("opacity", [0.0, 1.0])
def test_the_logit_of_nothing_and_of_a_wall_is_bounded(opacity):
    """By that of one in a million."""
    gaussians = replace(cloud((0.0, 0.0, 0.0), 1), opacities=torch.tensor([opacity]))
    found = float(input_features(gaussians, "raw56", 0.02)[0, 0])
    assert found == pytest.approx(math.copysign(math.log(1e6), opacity - 0.5), abs=0.05)
