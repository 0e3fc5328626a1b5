"""MinkUNet: sizes and names of MinkowskiEngine's, layers against the dense oracle, behaviour at the extremes."""

import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.network.layers.mink_unet import ARCHITECTURES, BasicBlock, MinkUNet
from sgwarp.network.layers.sparse import BatchNorm, Conv, ConvTranspose, Linear, SparseTensor, pool, relu
from sgwarp.ops.reference import convolution as reference_sparse
from sgwarp.ops.sparse.voxels import pack_voxels, unpack_voxels


def cloud(count: int = 300, spread: int = 20, channels: int = 3, dtype=torch.float32) -> SparseTensor:
    generator = torch.Generator().manual_seed(count)
    axes = torch.randint(-spread, spread, (count, 3), generator=generator)
    batch = torch.randint(2, (count, 1), generator=generator)
    keys = pack_voxels(torch.cat([batch, axes], dim=1))
    return pool(keys, torch.randn(count, channels, generator=generator, dtype=dtype))[0]


@pytest.fixture(scope="module")
def net34a() -> MinkUNet:
    torch.manual_seed(0)
    return MinkUNet(3, 512, "34A")


# The released networks: OpenScene's 18A and 34C, the paper's 34A on 56 channels.
@pytest.mark.parametrize(
    ("arch", "channels", "parameters"),
    [("34A", (3, 512), 36_638_880), ("34A", (56, 768), 36_867_264), ("18A", (3, 512), 15_540_384)],
)
def test_number_of_parameters(arch, channels, parameters):
    with torch.device("meta"):
        net = MinkUNet(*channels, arch)
    assert sum(p.numel() for p in net.parameters()) == parameters


def test_names_are_those_of_minkowski_engine(net34a):
    def norm(name: str) -> set[str]:
        parts = ("weight", "bias", "running_mean", "running_var", "num_batches_tracked")
        return {f"{name}.bn.{part}" for part in parts}

    expected = {"conv0p1s1.kernel", "final.kernel"} | norm("bn0")
    for level, stride in enumerate((1, 2, 4, 8), start=1):
        expected |= {f"conv{level}p{stride}s2.kernel"} | norm(f"bn{level}")
    for level, stride in enumerate((16, 8, 4, 2), start=4):
        expected |= {f"convtr{level}p{stride}s2.kernel"} | norm(f"bntr{level}")
    for level, blocks in enumerate((2, 3, 4, 6, 2, 2, 2, 2), start=1):
        for block in range(blocks):
            name = f"block{level}.{block}"
            expected |= {f"{name}.conv1.kernel", f"{name}.conv2.kernel"} | norm(f"{name}.norm1") | norm(f"{name}.norm2")
        if level != 1:  # the only level whose first block keeps its width
            expected |= {f"block{level}.0.downsample.0.kernel"} | norm(f"block{level}.0.downsample.1")
    names = set(net34a.state_dict())
    assert len(names) == 373
    assert names == expected


def test_shapes_are_those_of_minkowski_engine(net34a):
    shapes = {name: list(tensor.shape) for name, tensor in net34a.state_dict().items()}
    assert shapes["conv0p1s1.kernel"] == [125, 3, 32]
    assert shapes["conv1p1s2.kernel"] == [8, 32, 32]
    assert shapes["block4.0.downsample.0.kernel"] == [128, 256]
    assert shapes["convtr4p16s2.kernel"] == [8, 256, 256]
    assert [shapes[f"block{level}.0.conv1.kernel"][1] for level in (5, 6, 7, 8)] == [384, 192, 96, 96]
    assert shapes["final.kernel"] == [64, 512]


def test_initial_weights_have_the_stated_spread():
    torch.manual_seed(0)
    layers = Conv(64, 128), ConvTranspose(64, 128), Linear(256, 512)
    conv, up, linear = (layer.kernel.detach() for layer in layers)
    assert float(conv.std()) == pytest.approx((2 / (128 * 27)) ** 0.5, rel=0.02)
    assert float(linear.std()) == pytest.approx((2 / 512) ** 0.5, rel=0.02)
    bound = (128 * 8) ** -0.5
    assert float(up.abs().max()) == pytest.approx(bound, rel=0.01)
    assert float(up.std()) == pytest.approx(bound / 3**0.5, rel=0.02)


def test_a_small_net_is_the_dense_one():
    """Down, block, up and join in float64 against the dense grid."""
    x = cloud(channels=4, dtype=torch.float64)
    torch.manual_seed(1)
    down, block, up = Conv(4, 6, side=2, stride=2), BasicBlock(6, 8), ConvTranspose(8, 5)
    for module in (down, block, up):
        module.double().eval()
    coarse = down(x)
    y = up(block(coarse))
    assert (coarse.stride, y.stride) == (2, 1)

    fine, places = x.coordinates, coarse.coordinates
    units = places // torch.tensor([1, 2, 2, 2])
    dense = reference_sparse.convolve(x.features, down.kernel, fine, places, 2)

    def conv(features, layer):
        return reference_sparse.convolve(features, layer.kernel, units, units, 3)

    scale = (1 + 1e-5) ** -0.5  # a fresh batch normalisation divides by sqrt(1 + eps)
    inner = conv(torch.relu(scale * conv(dense, block.conv1)), block.conv2) * scale
    shortcut = scale * (dense @ block.downsample[0].kernel)
    expected = reference_sparse.convolve_transposed(torch.relu(inner + shortcut), up.kernel, places, fine, 2, 2)
    assert float((y.features - expected).detach().abs().max()) < 1e-12


@pytest.mark.parametrize("dilation", [1, 2, 3])
def test_a_dilated_layer_is_the_dense_one(dilation):
    x = cloud(channels=4, spread=6, dtype=torch.float64)
    layer = Conv(4, 5, dilation=dilation).double()
    expected = reference_sparse.convolve(x.features, layer.kernel, x.coordinates, x.coordinates, 3, dilation)
    assert float((layer(x).features - expected).detach().abs().max()) < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("arch", ["14A", "34A"])
def test_every_parameter_gets_a_gradient(arch):
    torch.manual_seed(0)
    net = MinkUNet(3, 8, arch)
    y = net(cloud(2000, 24))
    assert y.features.shape == (len(y.coordinates), 8)
    y.features.square().mean().backward()
    for name, parameter in net.named_parameters():
        assert bool(torch.isfinite(parameter.grad).all()), name
        if name.endswith("kernel"):
            assert bool(parameter.grad.abs().max() > 0), name


def test_hidden_features_before_the_last_layer(net34a):
    x = cloud()
    net34a.eval()
    with torch.no_grad():
        hidden = net34a.hidden(x)
        assert hidden.features.shape[1] == 64
        assert torch.equal(hidden.features @ net34a.final.kernel, net34a(x).features)


def test_ten_maps_serve_a_whole_forward_pass(net34a):
    x = cloud()
    net34a.eval()(x)
    assert len(x.grid._maps) == 10
    assert sorted(x.grid.levels) == [1, 2, 4, 8, 16]


def test_batch_items_do_not_see_each_other(net34a):
    """Outside training, a scene's prediction is the same alone and beside another one."""
    x = cloud()
    net34a.eval()
    with torch.no_grad():
        together = net34a(x)
        for number in (0, 1):
            mine = x.coordinates[:, 0] == number
            alone = net34a(pool(x.grid.keys(1)[mine], x.features[mine])[0])
            torch.testing.assert_close(alone.features, together.features[mine], rtol=1e-4, atol=1e-4)


def test_a_shift_by_sixteen_voxels_changes_nothing(net34a):
    x = cloud()
    net34a.eval()
    keys = pack_voxels(unpack_voxels(x.grid.keys(1)) + torch.tensor([0, -160, 32, 16]))
    with torch.no_grad():
        moved = net34a(pool(keys, x.features)[0])
        torch.testing.assert_close(moved.features, net34a(x).features, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("training", [False, True])
@pytest.mark.parametrize("count", [0, 1, 2])
def test_next_to_no_voxels(count, training):
    """At stride 16 a small scene has one voxel, of which no variance can be taken."""
    torch.manual_seed(0)
    net = MinkUNet(3, 8, "14A").train(training)
    keys = pack_voxels(torch.tensor([[0, 0, 0, 0], [0, 1, 0, 0]])[:count])
    y = net(pool(keys, torch.ones(count, 3))[0])
    assert y.features.shape == (count, 8)
    assert bool(torch.isfinite(y.features).all())
    y.features.sum().backward()


def test_batch_norm_of_one_row_leaves_the_statistics_alone():
    norm = BatchNorm(3)
    single = pool(pack_voxels(torch.zeros(1, 4, dtype=torch.int64)), torch.tensor([[1.0, 2.0, 3.0]]))[0]
    torch.testing.assert_close(norm(single).features, single.features, rtol=1e-4, atol=0)
    assert norm.bn.running_mean.tolist() == [0, 0, 0]


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_autocast_follows_float32(dtype):
    torch.manual_seed(0)
    net = MinkUNet(3, 8, "14A").eval()
    x = cloud(2000, 24)
    with torch.no_grad():
        exact = net(x).features
        with torch.autocast("cpu", dtype=dtype):
            rounded = net(x).features
    assert rounded.dtype == dtype
    error = (rounded.float() - exact).norm() / exact.norm()
    assert float(error) < (0.05 if dtype == torch.bfloat16 else 0.007)


def test_pooling_takes_means_and_leads_back():
    keys = pack_voxels(torch.tensor([[0, 5, 0, 0], [0, -1, 0, 0], [0, 5, 0, 0], [1, 5, 0, 0]]))
    x, rows = pool(keys, torch.tensor([[1.0], [7.0], [3.0], [9.0]]))
    assert x.coordinates.tolist() == [[0, -1, 0, 0], [0, 5, 0, 0], [1, 5, 0, 0]]
    assert x.features[rows].flatten().tolist() == [2.0, 7.0, 2.0, 9.0]


def test_pooling_refuses_points_without_a_voxel():
    with pytest.raises(InputError, match="without voxel"):
        pool(torch.tensor([3, -1]), torch.ones(2, 1))
    with pytest.raises(InputError, match=r"keys \[P\]"):
        pool(torch.tensor([3]), torch.ones(2, 1))


def test_refining_past_the_finest_level_is_refused():
    with pytest.raises(InputError, match="cannot be refined"):
        ConvTranspose(3, 4)(cloud())


def test_an_unknown_architecture_is_refused():
    with pytest.raises(InputError, match=", ".join(ARCHITECTURES)):
        MinkUNet(3, 8, "50")


def test_relu_keeps_the_voxels():
    x = cloud()
    y = relu(x)
    assert y.grid is x.grid
    assert torch.equal(y.features, x.features.clamp(min=0))
