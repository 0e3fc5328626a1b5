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


def results_of(nets, dtype, autocast):
    """Features that both networks give, and their parameters' gradients, after a step."""
    results = []
    for net, device in zip(nets, ("cpu", "cuda"), strict=True):
        x = cloud(100, device, 5)
        x = x.with_features(x.features.to(dtype))
        with torch.autocast(device, dtype=autocast or torch.bfloat16, enabled=autocast is not None):
            y = net(x).features
        y.float().square().mean().backward()
        results.append(y.detach())
    return results


def test_double_precision_takes_the_layers_one_by_one(nets, pretended_cuda):
    exact, mine = results_of([net.double() for net in nets], torch.float64, None)
    assert "normalize_elements" not in pretended_cuda.launches
    assert mine.dtype == torch.float64
    assert_near(mine, exact, 1e-9)


@pytest.mark.parametrize("how", ["bfloat16", "autocast bfloat16", "autocast float16"])
def test_half_precision_is_near_double(nets, how, pretended_cuda):
    """As near as the CPU is, which takes the layers one by one, but for a factor of two; gradients stay float32."""
    here, there = nets
    exact = copy.deepcopy(here).double()
    x = cloud(100, "cpu", 5)
    wanted = exact(x.with_features(x.features.double())).features
    wanted.square().mean().backward()
    half = getattr(torch, how.split()[-1])
    if how == "bfloat16":
        results = results_of([net.to(half) for net in nets], half, None)
    else:
        results = results_of(nets, torch.float32, half)
    assert "normalize_elements" in pretended_cuda.launches
    assert results[0].dtype == results[1].dtype == half
    errors = [float((y.cpu().double() - wanted.detach()).norm() / wanted.detach().norm()) for y in results]
    assert errors[1] <= 2 * errors[0], errors
    assert errors[0] < 0.1
    slopes = torch.cat([p.grad.flatten() for p in exact.parameters()])
    kept = half if how == "bfloat16" else torch.float32
    for name, net, bound in (("cpu", here, None), ("cuda", there, 2.0)):
        assert all(p.grad.dtype == kept for p in net.parameters())
        ours = torch.cat([p.grad.cpu().double().flatten() for p in net.parameters()])
        error = float((ours - slopes).norm() / slopes.norm())
        if bound is None:
            usual = error
        else:
            assert error <= bound * usual, (name, error, usual)


def test_a_training_step_under_autocast_takes_no_more_launches(net, voxels, pretended_cuda):
    """What single precision does not have is the rounding of the first input."""
    counts = []
    for half in (False, True):
        pretended_cuda.reset()
        with torch.autocast("cuda", dtype=torch.bfloat16, enabled=half):
            y = net(voxels).features
        y.float().square().mean().backward()
        counts.append(pretended_cuda.work)
        for parameter in net.parameters():
            parameter.grad = None
    assert counts[1] <= counts[0] + 10, counts
    net.eval()
    pretended_cuda.reset()
    with torch.inference_mode(), torch.autocast("cuda", dtype=torch.bfloat16):
        net(voxels)
    assert pretended_cuda.launches.count("convolve_and_finish_blocks") == 62
    assert pretended_cuda.work < 95
