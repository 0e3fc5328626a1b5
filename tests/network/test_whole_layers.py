"""Layers that kernels take whole, as on CUDA, against the modules one after the other; and when they do."""

from types import SimpleNamespace

import pytest
import torch

from sgwarp.network.layers import sparse
from sgwarp.network.layers.sparse import BatchNorm, Conv, ConvTranspose, Linear, join, normalized, pool, relu
from sgwarp.ops.sparse.voxels import pack_voxels


def cloud(channels: int, seed: int = 0) -> sparse.SparseTensor:
    g = torch.Generator().manual_seed(seed)
    places = torch.randint(0, 6, (60, 3), generator=g)
    keys = pack_voxels(torch.cat([torch.zeros(60, 1, dtype=torch.int64), places], dim=1))
    return pool(keys, torch.randn(60, channels, generator=g))[0]


def layer(name: str) -> torch.nn.Module:
    torch.manual_seed(3)
    return {
        "conv": lambda: Conv(4, 16),
        "down": lambda: Conv(4, 16, side=2, stride=2),
        "linear": lambda: Linear(4, 16),
        "up": lambda: ConvTranspose(4, 16),
    }[name]()


def norm(training: bool) -> BatchNorm:
    torch.manual_seed(4)
    made = BatchNorm(16)
    torch.nn.init.uniform_(made.bn.weight, 0.5, 1.5)
    torch.nn.init.uniform_(made.bn.bias, -0.5, 0.5)
    torch.nn.init.uniform_(made.bn.running_mean, -0.5, 0.5)
    torch.nn.init.uniform_(made.bn.running_var, 0.5, 1.5)
    return made.train(training)


@pytest.mark.parametrize("training", [False, True])
@pytest.mark.parametrize("rectify", [False, True])
@pytest.mark.parametrize("more", ["", "shortcut", "beside", "shortcut beside"])
@pytest.mark.parametrize("name", ["conv", "down", "linear", "up"])
def test_a_whole_layer_is_its_modules(monkeypatch, name, more, rectify, training):
    results = []
    for whole in (False, True):
        x = cloud(4)
        if name == "up":
            x = Conv(4, 4, side=2, stride=2)(x)
            x = x.with_features(torch.randn(x.features.shape, generator=torch.Generator().manual_seed(5)))
        conv, by = layer(name), norm(training)
        pairs, stride = conv.connect(x)
        g = torch.Generator().manual_seed(6)
        extra = {
            what: sparse.SparseTensor(torch.randn(pairs.target_count, 16, generator=g), x.grid, stride)
            for what in more.split()
        }
        monkeypatch.setattr(sparse, "_fused_dtype", lambda *given: torch.float32 if whole else None)  # noqa: B023
        y, through = normalized(conv, by, x, rectify=rectify, **extra)
        assert (y.stride, y.grid) == (stride, x.grid)
        assert (through.stride, through.grid) == (x.stride, x.grid)
        assert torch.equal(through.features, x.features)
        results.append((y.features.detach(), by.bn.running_mean.clone(), by.bn.running_var.clone()))
        if not whole and not training:  # the modules, from their parts
            z = by(conv(x)).features
            z = z + extra["shortcut"].features if "shortcut" in extra else z
            z = z.clamp(min=0) if rectify else z
            z = torch.cat([z, extra["beside"].features], dim=1) if "beside" in extra else z
            torch.testing.assert_close(y.features, z)
    for one, other in zip(*results, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("offsets", [sparse.MAX_OFFSETS, sparse.MAX_OFFSETS + 1])
def test_kernels_take_layers_of_so_many_offsets(monkeypatch, offsets):
    asked = []
    monkeypatch.setattr(sparse, "_fused_dtype", lambda *given: torch.float32)
    monkeypatch.setattr(sparse, "convolve_and_normalize", lambda *given: asked.append(given) or (given[0], given[0]))
    conv, x = layer("linear"), cloud(4)
    pairs, stride = conv.connect(x)
    few = SimpleNamespace(offsets=offsets, target_count=pairs.target_count)
    monkeypatch.setattr(conv, "connect", lambda x: (few, stride))
    normalized(conv, norm(False), x)
    assert len(asked) == (offsets == sparse.MAX_OFFSETS)


@pytest.mark.parametrize(
    ("on_cuda", "features", "parameters", "autocast", "expected"),
    [
        (True, "float32", "float32", None, "float32"),
        (True, "float16", "float16", None, "float16"),
        (True, "bfloat16", "bfloat16", None, "bfloat16"),
        (True, "float16", "float32", None, "float16"),
        (True, "float32", "float16", None, None),
        (True, "float64", "float64", None, None),
        (True, "float32", "float32", "bfloat16", "bfloat16"),
        (True, "float16", "float16", "bfloat16", None),
        (True, "float64", "float64", "bfloat16", None),
        (True, "float64", "float32", "bfloat16", None),
        (False, "float32", "float32", None, None),
        (False, "float32", "float32", "bfloat16", None),
    ],
)
def test_the_precision_of_whole_layers(monkeypatch, on_cuda, features, parameters, autocast, expected):
    monkeypatch.setattr("torch.is_autocast_enabled", lambda device: device == "cuda" and autocast is not None)
    monkeypatch.setattr("torch.get_autocast_dtype", lambda device: getattr(torch, autocast))
    x = SimpleNamespace(features=SimpleNamespace(is_cuda=on_cuda, dtype=getattr(torch, features)))
    dtype = getattr(torch, parameters)
    found = sparse._fused_dtype(x, layer("linear").to(dtype).kernel, norm(False).to(dtype))
    assert found is (None if expected is None else getattr(torch, expected))


def test_parameters_of_several_precisions_are_for_the_modules(monkeypatch):
    x = SimpleNamespace(features=SimpleNamespace(is_cuda=True, dtype=torch.float16))
    monkeypatch.setattr("torch.is_autocast_enabled", lambda device: False)
    assert sparse._fused_dtype(x, layer("linear").half().kernel, norm(False)) is None
    bare = norm(False)
    bare.bn.running_mean = None
    assert sparse._fused_dtype(x, layer("linear").kernel, bare) is None


def test_joined_channels_and_rectified_rows():
    x = cloud(3)
    y = x.with_features(torch.randn(len(x.features), 2, generator=torch.Generator().manual_seed(1)))
    assert torch.equal(join(x, y).features, torch.cat([x.features, y.features], dim=1))
    assert torch.equal(relu(x).features, x.features.clamp(min=0))


@pytest.mark.parametrize("rows", [0, 1, 2])
def test_a_row_alone_has_no_statistics(rows):
    assert norm(True).learns(rows) == (rows > 1)
    assert norm(False).learns(rows) is False


def test_levels_are_made_from_the_next_finer_one_that_is_there():
    """Whichever are asked for first, the voxels of a level are those of the finest, rounded down."""
    for order in ((2, 4, 8), (8, 4, 2), (4, 8, 2)):
        grid = cloud(1).grid
        for stride in order:
            fine = sparse.unpack_voxels(grid.keys(1))
            expected = torch.unique(torch.cat([fine[:, :1], fine[:, 1:] // stride * stride], dim=1), dim=0)
            assert torch.equal(sparse.unpack_voxels(grid.keys(stride)), expected)
    first = grid.map(3, 2)
    assert grid.map(3, 2) is first, "made once"
    assert grid.map(3, 2, dilation=2) is not first
    pairs = grid.map(2, 2, 2)
    assert pairs.target_count == len(grid.keys(4))
