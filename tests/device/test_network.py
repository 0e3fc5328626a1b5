"""What MinkUNet34A gives a GPU to do, counted on a pretended CUDA device, and that it is what the CPU does.

The count does not depend on the voxels.
"""

import copy

import pytest
import torch

from sgwarp.network.layers import sparse
from sgwarp.network.layers.mink_unet import ARCHITECTURES, Architecture, MinkUNet
from sgwarp.network.layers.sparse import pool
from sgwarp.ops.sparse.voxels import pack_voxels

POINTS = 16


@pytest.fixture
def net(pretended_cuda):
    torch.manual_seed(0)
    return MinkUNet(3, 8).to("cuda")


def cloud(points: int, device: str, channels: int = 3, spread: int = 20):
    generator = torch.Generator().manual_seed(1)
    places = torch.randint(0, spread, (points, 3), generator=generator)
    keys = pack_voxels(torch.cat([torch.zeros(points, 1, dtype=torch.int64), places], dim=1)).to(device)
    return pool(keys, torch.rand(points, channels, generator=generator).to(device))[0]


@pytest.fixture
def voxels(pretended_cuda):
    return cloud(POINTS, "cuda")


def test_inference_takes_a_launch_for_a_layer(net, voxels, pretended_cuda):
    """63 layers, ten kernel maps, the last product; four coarser levels, for whose size it waits."""
    net.eval()
    pretended_cuda.reset()
    with torch.inference_mode():
        net(voxels)
    assert pretended_cuda.launches.count("convolve_and_finish_blocks") == 62
    assert pretended_cuda.work < 90
    assert [what for what, _ in pretended_cuda.waits] == ["_unique2"] * 4


def test_a_training_step_takes_fewer_than_400_launches(net, voxels, pretended_cuda):
    """Of Warp and of torch: forward, backward, and a step of the fused optimizer."""
    optimizer = torch.optim.AdamW(net.parameters(), fused=True)
    counters = [b for name, b in net.named_buffers() if name.endswith("num_batches_tracked")]
    for parameter in net.parameters():
        parameter.grad = torch.zeros_like(parameter)
    optimizer.step()  # makes the moments
    optimizer.zero_grad()
    pretended_cuda.reset()
    net(voxels).features.square().mean().backward()
    optimizer.step()
    assert pretended_cuda.work < 400
    assert [int(count) for count in counters] == [1] * 62


def test_the_count_knows_operations_of_several_kernels(pretended_cuda):
    x = torch.rand(8, 4).to("cuda").requires_grad_()
    pretended_cuda.reset()
    y = torch.nn.functional.batch_norm(x, None, None, training=True)
    assert pretended_cuda.work == 2
    pretended_cuda.reset()
    y.backward(torch.ones(8, 4).to("cuda"))
    assert pretended_cuda.work >= 2
    many = [torch.zeros(3).to("cuda") for _ in range(111)]
    pretended_cuda.reset()
    torch._foreach_add_(many, 1)
    assert pretended_cuda.work == 2  # 110 tensors to a launch


@pytest.fixture
def nets(pretended_cuda, monkeypatch):
    """A small network on the CPU and the same on the device; sizes that fill no block of channels."""
    monkeypatch.setitem(ARCHITECTURES, "odd", Architecture((1, 2, 1, 1, 1, 1, 2, 1), (40, 16, 24, 24, 40, 16, 24, 24)))
    torch.manual_seed(0)
    here = MinkUNet(5, 7, "odd")
    for name, buffer in here.named_buffers():
        if name.endswith(("mean", "var")):
            buffer.uniform_(0.5, 1.5)
    return here, copy.deepcopy(here).to("cuda")


def assert_near(ours, theirs, bound=2e-4):
    """Within float32, accumulated over some thirty layers; relative to the norm."""
    assert float((ours.cpu() - theirs).norm()) <= bound * float(theirs.norm()), float(
        (ours.cpu() - theirs).norm() / theirs.norm()
    )


def freeze(net, every: int) -> None:
    for i, module in enumerate(m for m in net.modules() if isinstance(m, sparse.BatchNorm)):
        module.train(i % every != 0)


@pytest.mark.parametrize("mode", ["train", "frozen", "mixed", "eval"])
def test_training_is_that_of_the_cpu(nets, mode):
    """Values, gradients added up over two passes, and running statistics, whose momentum is another one."""
    points = 200
    for net in nets:
        net.train(mode != "eval")
        if mode in ("frozen", "mixed"):
            freeze(net, 1 if mode == "frozen" else 2)
        for module in net.modules():
            if isinstance(module, torch.nn.BatchNorm1d):
                module.momentum = 0.3
    values = []
    for net, device in zip(nets, ("cpu", "cuda"), strict=True):
        x = cloud(points, device, 5)
        y = net(x)
        y.features.square().mean().backward()
        again = net(x)
        again.features.sum().backward()
        values.append((y.features.detach(), again.features.detach()))
    for mine, exact in zip(values[1], values[0], strict=True):
        assert_near(mine, exact)
    here, there = nets
    for (name, exact), mine in zip(here.named_parameters(), there.parameters(), strict=True):
        assert mine.grad is not None, name
        assert_near(mine.grad, exact.grad, 5e-3)
    for (name, exact), mine in zip(here.named_buffers(), there.buffers(), strict=True):
        assert_near(mine.double(), exact.double(), 1e-4), name


def test_inference_is_that_of_the_cpu(nets):
    here, there = (net.eval() for net in nets)
    with torch.inference_mode():
        assert_near(there(cloud(300, "cuda", 5)).features, here(cloud(300, "cpu", 5)).features)


def test_training_without_gradients_moves_the_statistics(nets):
    with torch.no_grad():
        here, there = (net(cloud(300, d, 5)) for net, d in zip(nets, ("cpu", "cuda"), strict=True))
    assert_near(there.features, here.features)
    for exact, mine in zip(nets[0].buffers(), nets[1].buffers(), strict=True):
        assert_near(mine.double(), exact.double(), 1e-4)


@pytest.mark.parametrize("count", [0, 1, 2])
@pytest.mark.parametrize("training", [False, True])
def test_next_to_no_voxels(nets, count, training):
    values = []
    for net, device in zip(nets, ("cpu", "cuda"), strict=True):
        y = net.train(training)(cloud(count, device, 5))
        y.features.sum().backward()
        values.append(y.features.detach())
    assert values[1].shape == values[0].shape
    if count < 2:  # two equal voxels of a coarse level: what normalises them is rounding
        assert_near(values[1], values[0])
    for (name, exact), mine in zip(nets[0].named_buffers(), nets[1].buffers(), strict=True):
        assert torch.isfinite(mine.cpu()).all(), name
        if count < 2:
            assert_near(mine.double(), exact.double(), 1e-4)


@pytest.mark.parametrize("how", ["double", "bfloat16", "autocast"])
def test_other_precisions_take_the_layers_one_by_one(nets, how, pretended_cuda):
    here, there = nets
    if how != "autocast":
        here, there = (net.to(getattr(torch, how)) for net in nets)
    dtype = torch.float32 if how == "autocast" else getattr(torch, how)
    results = []
    for net, device in ((here, "cpu"), (there, "cuda")):
        x = cloud(100, device, 5)
        x = x.with_features(x.features.to(dtype))
        with torch.autocast(device, dtype=torch.bfloat16, enabled=how == "autocast"):
            y = net(x).features
        y.float().square().mean().backward()
        results.append(y.detach())
    assert "normalize_elements" not in pretended_cuda.launches
    assert results[0].dtype == results[1].dtype == (torch.float64 if how == "double" else torch.bfloat16)
    assert_near(results[1].double(), results[0].double(), 1e-9 if how == "double" else 0.2)
    assert all(p.grad is not None for p in there.parameters())
