"""The fused layer of the block schedule, on CPU fibers, against torch's batch normalization in float64."""

import pytest
import torch
from torch.nn.functional import batch_norm

from sgwarp.ops.sparse.blocks import Running
from sgwarp.ops.sparse.convolution import sparse_conv
from sgwarp.ops.sparse.normalization import Normalization, convolve_and_normalize
from sgwarp.ops.sparse.voxels import coarsen, kernel_map, pack_voxels

EPSILON, MOMENTUM = 1e-5, 0.1
BOUND = 5e-6  # of float32, relative to the largest entry: sums of up to 27 x 40 products


def keys_of(count: int) -> torch.Tensor:
    """That many voxels, close together."""
    places = torch.randperm(4096, generator=torch.Generator().manual_seed(count))[:count]
    return pack_voxels(torch.stack([0 * places, places // 256 - 8, places // 16 % 16, places % 16], dim=1)).unique()


class Layer:
    """A layer, and the same values in float64.

    Features are of `dtype`; weights and normalisation are `parameters`, and the weights rounded as they are read.
    """

    def __init__(
        self,
        pairs,
        channels,
        shortcut=False,
        beside=0,
        epsilon=EPSILON,
        dtype=torch.float32,
        parameters=torch.float32,
        **how,
    ):
        generator = torch.Generator().manual_seed(channels[0])

        def random(*shape):
            return torch.randn(*shape, generator=generator).requires_grad_()

        self.pairs, self.how, self.epsilon = pairs, {"learns": True, "rectified": True} | how, epsilon
        self.inputs = [random(pairs.source_count, channels[0]), random(pairs.offsets, *channels)]
        self.inputs += [random(channels[1]), random(channels[1])]
        self.inputs.append(random(pairs.target_count, channels[1]) if shortcut else None)
        self.inputs.append(random(pairs.target_count, beside) if beside else None)
        self.running = [torch.randn(channels[1], generator=generator), torch.rand(channels[1], generator=generator)]
        types = [dtype, parameters, parameters, parameters, dtype, dtype]
        pairs_of = zip(self.inputs, types, strict=True)
        self.inputs = [None if t is None else t.detach().to(kind).requires_grad_() for t, kind in pairs_of]
        self.running = [t.to(parameters) for t in self.running]

    def ours(self):
        """z, and the running statistics afterwards."""
        x, weight, gain, bias, shortcut, beside = self.inputs
        running = [tensor.clone() for tensor in self.running]
        norm = Normalization(gain, bias, Running(*running, self.epsilon, MOMENTUM), **self.how)
        z, through = convolve_and_normalize(x, weight, self.pairs, norm, shortcut, beside)
        assert torch.equal(through, x)
        return z, running

    def oracle(self):
        """z, the running statistics, and the inputs that it was computed of."""
        rounded = list(self.inputs)
        rounded[1] = rounded[1].to(rounded[0].dtype)
        inputs = [None if t is None else t.detach().double().requires_grad_() for t in rounded]
        x, weight, gain, bias, shortcut, beside = inputs
        running = [tensor.double() for tensor in self.running]
        y = sparse_conv(x, weight, self.pairs, schedule="lanes")
        z = batch_norm(y, *running, gain, bias, self.how["learns"], MOMENTUM, self.epsilon)
        z = z if shortcut is None else z + shortcut
        z = torch.relu(z) if self.how["rectified"] else z
        return z if beside is None else torch.cat([z, beside], dim=1), running, inputs

    def assert_as_the_oracle(self, bound=BOUND, flat=1e-4):
        z, running = self.ours()
        expected, expected_running, inputs = self.oracle()
        seed = torch.randn(z.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(9))
        near = expected.detach().abs() < flat  # where either side of zero may be right
        seed = torch.where(near, 0.0, seed).to(z.dtype).double()
        mine = torch.autograd.grad((z * seed.to(z.dtype)).sum(), [t for t in self.inputs if t is not None])
        theirs = torch.autograd.grad((expected * seed).sum(), [t for t in inputs if t is not None])
        found = {"z": (z, expected), "mean": (running[0], expected_running[0])}
        found |= {"variance": (running[1], expected_running[1])}
        found |= {f"gradient {i}": both for i, both in enumerate(zip(mine, theirs, strict=True))}
        dtypes = {f"gradient {i}": t for i, t in enumerate(t for t in self.inputs if t is not None)}
        assert z.dtype == self.inputs[0].dtype
        for name, (our, their) in found.items():
            assert our.dtype == (z if name == "z" else dtypes.get(name, running[0])).dtype
            assert our.shape == their.shape
            if their.numel():
                error = (our - their).detach().abs().max() / their.detach().abs().max().clamp(min=1e-30)
                assert float(error) < bound, f"{name}: {float(error)}"


# Rows: fewer than a block's, as many and one more, several blocks; channels: fewer than a block's, and more.
@pytest.mark.parametrize("rows", [2, 128, 129, 300])
@pytest.mark.parametrize(
    ("channels", "shortcut", "beside"), [((3, 40), True, 0), ((33, 7), False, 35), ((4, 32), False, 0)]
)
def test_a_layer_is_that_of_torch(rows, channels, shortcut, beside):
    keys = keys_of(rows)
    # Without epsilon two rows become -1 and 1, whatever they are: their gradient is epsilon's.
    epsilon = EPSILON if rows > 2 else 1.0
    Layer(kernel_map(keys, keys, 3), channels, shortcut, beside, epsilon).assert_as_the_oracle()


@pytest.mark.parametrize("whole", [False, True])
@pytest.mark.parametrize(("dtype", "bound"), [(torch.bfloat16, 8e-3), (torch.float16, 1e-3)])
def test_half_precision_is_summed_in_single(dtype, bound, whole):
    """What is stored is rounded, by 2^-9 in bfloat16 and 2^-11 in float16, a few times over: y, z, the gradient of y.

    Sums of 891 products, and over the rows, add nothing to that.
    """
    keys = keys_of(300)
    parameters = dtype if whole else torch.float32
    layer = Layer(kernel_map(keys, keys, 3), (33, 40), True, 35, dtype=dtype, parameters=parameters)
    layer.assert_as_the_oracle(2 * bound, flat=10 * bound)
    with torch.no_grad():
        layer.how["learns"] = False
        z, expected = layer.ours()[0].double(), layer.oracle()[0]
        assert float((z - expected).abs().max()) < bound * float(expected.abs().max())


def test_weights_are_rounded_to_the_precision_of_the_features():
    """And products are taken of what was rounded: single precision would see 1 + 2^-12."""
    keys = keys_of(3)
    norm = Normalization(torch.ones(1), torch.zeros(1), Running(torch.zeros(1), torch.ones(1), 0.0, 0.1), False)
    weight = torch.full((1, 1, 1), 1 + 2.0**-12)
    x = torch.tensor([[1.0], [256.0], [3.0]], dtype=torch.bfloat16)
    with torch.no_grad():
        z, _ = convolve_and_normalize(x, weight, kernel_map(keys, keys, 1), norm)
    assert torch.equal(z, x)


@pytest.mark.parametrize("rectified", [True, False])
@pytest.mark.parametrize("learns", [True, False])
def test_frozen_statistics_and_no_rectification(learns, rectified):
    keys = keys_of(150)
    Layer(kernel_map(keys, keys, 3), (5, 9), True, learns=learns, rectified=rectified).assert_as_the_oracle()


@pytest.mark.parametrize("up", [False, True])
def test_layers_between_levels(up):
    fine = keys_of(500)
    pairs = kernel_map(fine, coarsen(fine, 2), 2)
    Layer(pairs.swapped() if up else pairs, (6, 34), beside=8 if up else 0).assert_as_the_oracle()


def test_a_linear_layer_and_many_blocks():
    """More parts than threads add up, and more rows than a part of the sums of the backward pass has at least."""
    keys = keys_of(2500)
    Layer(kernel_map(keys, keys, 1), (3, 4)).assert_as_the_oracle()


@pytest.mark.parametrize("rows", [0, 1])
@pytest.mark.parametrize("wanted", [True, False])
def test_next_to_no_rows(rows, wanted):
    """By the running statistics, with gradients and without."""
    keys = keys_of(rows)
    layer = Layer(kernel_map(keys, keys, 3), (3, 5), True, 2, learns=False)
    if wanted:
        layer.assert_as_the_oracle(1e-5)
    with torch.no_grad():
        torch.testing.assert_close(layer.ours()[0].double(), layer.oracle()[0])


def identity_layer(x: torch.Tensor, epsilon: float) -> tuple[torch.Tensor, list[torch.Tensor], torch.Tensor]:
    """Normalised columns of x, running statistics that became theirs, and the gradient of a cubic loss by x."""
    keys = keys_of(len(x))
    pairs = kernel_map(keys, keys, 1)
    channels = x.shape[1]
    running = [torch.zeros(channels), torch.ones(channels)]
    norm = Normalization(torch.ones(channels), torch.zeros(channels), Running(*running, epsilon, 1.0), True, False)
    leaf = x.clone().requires_grad_()
    z, _ = convolve_and_normalize(leaf, torch.eye(channels)[None], pairs, norm)
    (gradient,) = torch.autograd.grad(z.pow(3).sum(), leaf)
    return z.detach(), running, gradient


@pytest.mark.parametrize(("mean", "deviation"), [(0.0, 1.0), (1e3, 1e-2), (-3e4, 1.0), (1e-3, 1e-6)])
def test_a_large_mean_does_not_drown_the_deviations(mean, deviation):
    """Within float32 of float64 on the same values; sums of squares would lose all digits."""
    x = mean + deviation * torch.randn(1000, 3, generator=torch.Generator().manual_seed(1))
    z, running, gradient = identity_layer(x, 1e-20)
    wide = x.double().requires_grad_()
    expected = (wide - wide.mean(dim=0)) / (wide.var(dim=0, unbiased=False) + 1e-20).sqrt()
    (slope,) = torch.autograd.grad(expected.pow(3).sum(), wide)
    assert float((z - expected).detach().abs().max()) < 2e-6
    torch.testing.assert_close(running[0].double(), wide.detach().mean(dim=0), rtol=1e-7, atol=1e-7 * deviation)
    torch.testing.assert_close(running[1].double(), wide.detach().var(dim=0), rtol=1e-6, atol=0)
    assert float((gradient - slope).abs().max() / slope.abs().max()) < 1e-5


def test_constant_columns_become_zero():
    z, running, gradient = identity_layer(torch.full((260, 2), 12345.678), 1e-5)
    assert bool((z == 0).all())
    assert running[1].tolist() == [0.0, 0.0]
    assert bool((gradient == 0).all())


def test_nan_reaches_the_statistics_as_in_torch():
    x = torch.randn(200, 3, generator=torch.Generator().manual_seed(1))
    x[150, 1] = torch.nan
    keys, running = keys_of(200), [torch.zeros(3), torch.ones(3)]
    norm = Normalization(torch.ones(3), torch.zeros(3), Running(*running, 1e-5, 0.1), True)
    weight = torch.ones(1, 3, 3)
    with torch.no_grad():
        z, _ = convolve_and_normalize(x, weight, kernel_map(keys, keys, 1), norm)
    assert bool(z.isnan().all())
    assert bool(torch.stack(running).isnan().all())


def test_gradients_are_those_of_finite_differences():
    """Along a random direction of all inputs at once, without the kink of rectification."""
    keys = keys_of(60)
    layer = Layer(kernel_map(keys, keys, 3), (4, 6), True, rectified=False)
    generator = torch.Generator().manual_seed(3)
    given = [t for t in layer.inputs if t is not None]
    seed = torch.randn(60, 6, generator=generator)
    gradients = torch.autograd.grad((layer.ours()[0] * seed).sum(), given)
    directions = [torch.randn(t.shape, generator=generator) for t in given]
    slope = sum(float((g * d).sum()) for g, d in zip(gradients, directions, strict=True))
    values = []
    for step in (1e-2, -1e-2):
        with torch.no_grad():
            for tensor, direction in zip(given, directions, strict=True):
                tensor += step * direction
            values.append(float((layer.ours()[0].double() * seed).sum()))
            for tensor, direction in zip(given, directions, strict=True):
                tensor -= step * direction
    assert (values[0] - values[1]) / 2e-2 == pytest.approx(slope, rel=2e-3)


def test_only_the_gradients_that_are_asked_for():
    keys = keys_of(40)
    for wanted in range(6):
        layer = Layer(kernel_map(keys, keys, 3), (4, 6), True, 3)
        everything = torch.autograd.grad(layer.ours()[0].square().sum(), layer.inputs)
        layer.inputs = [t.detach().requires_grad_(i == wanted) for i, t in enumerate(layer.inputs)]
        layer.ours()[0].square().sum().backward()
        assert [t.grad is not None for t in layer.inputs] == [i == wanted for i in range(6)]
        assert torch.equal(layer.inputs[wanted].grad, everything[wanted])


def test_going_on_with_the_returned_features_adds_their_gradient():
    keys = keys_of(40)
    layer = Layer(kernel_map(keys, keys, 3), (4, 6))
    x, weight, gain, bias, *_ = layer.inputs
    norm = Normalization(gain, bias, Running(*layer.running, EPSILON, MOMENTUM), True)
    z, through = convolve_and_normalize(x, weight, layer.pairs, norm)
    (alone,) = torch.autograd.grad(z.square().sum(), x, retain_graph=True)
    (both,) = torch.autograd.grad(z.square().sum() + through.pow(3).sum(), x, retain_graph=True)
    torch.testing.assert_close(both, alone + 3 * x.detach().square())
    (without,) = torch.autograd.grad(through.pow(3).sum(), x)
    torch.testing.assert_close(without, 3 * x.detach().square())


def test_the_same_bits_every_time():
    keys = keys_of(700)
    layer = Layer(kernel_map(keys, keys, 3), (4, 6), True)
    results = []
    for _ in range(2):
        z, running = layer.ours()
        gradients = torch.autograd.grad(z.square().sum(), layer.inputs[:5])
        results.append([z.detach(), *running, *gradients])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))
