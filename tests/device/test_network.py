"""What MinkUNet34A gives a GPU to do, counted on a pretended CUDA device; the count does not depend on the voxels."""

import pytest
import torch

from sgwarp.network.layers.mink_unet import MinkUNet
from sgwarp.network.layers.sparse import pool
from sgwarp.ops.sparse.voxels import pack_voxels

POINTS = 16


@pytest.fixture
def net(pretended_cuda):
    torch.manual_seed(0)
    return MinkUNet(3, 8).to("cuda")


@pytest.fixture
def voxels(pretended_cuda):
    places = torch.randint(0, 20, (POINTS, 3), generator=torch.Generator().manual_seed(1))
    keys = pack_voxels(torch.cat([torch.zeros(POINTS, 1, dtype=torch.int64), places], dim=1)).to("cuda")
    return pool(keys, torch.rand(POINTS, 3).to("cuda"))[0]


def test_inference_takes_fewer_than_400_launches(net, voxels, pretended_cuda):
    net.eval()
    pretended_cuda.reset()
    with torch.inference_mode():
        net(voxels)
    assert pretended_cuda.launches.count("convolve_blocks") == 55  # one for each of the layers
    assert pretended_cuda.work < 400


def test_the_convolutions_of_a_training_step_take_fewer_than_400_launches(net, voxels, pretended_cuda):
    """One for each layer and each of its two gradients, and 30 for the kernel maps; the rest is torch's."""
    optimizer = torch.optim.AdamW(net.parameters(), fused=True)
    counters = [b for name, b in net.named_buffers() if name.endswith("num_batches_tracked")]
    for parameter in net.parameters():
        parameter.grad = torch.zeros_like(parameter)
    optimizer.step()  # makes the moments
    optimizer.zero_grad()
    pretended_cuda.reset()
    net(voxels).features.square().mean().backward()
    optimizer.step()
    assert len(pretended_cuda.launches) < 200
    assert pretended_cuda.work < 640
    assert [int(count) for count in counters] == [1] * 62
