"""Sparse convolution against torch's dense one in float64, against finite differences and against spconv."""

import warnings

import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.ops.launcher import get_threads, set_threads
from sgwarp.ops.reference import convolution as reference_sparse
from sgwarp.ops.sparse.convolution import sparse_conv
from sgwarp.ops.sparse.voxels import coarsen, kernel_map, pack_voxels, unpack_voxels

# side, step of the kernel, stride of the target voxels
CASES = [(3, 1, 1), (5, 1, 1), (3, 2, 1), (1, 1, 1), (2, 1, 2), (3, 1, 2), (2, 1, 1)]


def keys_of(count: int, spread: int, seed: int = 0) -> torch.Tensor:
    """A cloud in batches 0 and 2 (1 is empty), negative coordinates among them, and one voxel alone."""
    generator = torch.Generator().manual_seed(seed)
    axes = torch.randint(-spread, spread, (count, 3), generator=generator)
    batch = 2 * torch.randint(2, (count, 1), generator=generator)
    alone = torch.tensor([[0, 4 * spread, -spread, 0]])
    return pack_voxels(torch.cat([torch.cat([batch, axes], dim=1), alone])).unique()


def inputs(rows: int, side: int, channels=(5, 7), dtype=torch.float64):
    generator = torch.Generator().manual_seed(side)
    features = torch.randn(rows, channels[0], generator=generator, dtype=dtype, requires_grad=True)
    weight = torch.randn(side**3, *channels, generator=generator, dtype=dtype, requires_grad=True)
    return features, weight


def largest_difference(ours, theirs) -> float:
    """Relative to the largest entry."""
    return float((ours - theirs).detach().abs().max() / theirs.detach().abs().max())


def assert_same(ours, theirs, inputs) -> None:
    """Values, and gradients of a random projection of them, within 1e-12."""
    assert largest_difference(ours, theirs) < 1e-12
    seed = torch.randn(theirs.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(9))
    mine = torch.autograd.grad((ours * seed).sum(), inputs)
    other = torch.autograd.grad((theirs * seed).sum(), inputs)
    for a, b in zip(mine, other, strict=True):
        assert largest_difference(a, b) < 1e-12


@pytest.mark.parametrize(("side", "step", "stride"), CASES)
def test_convolution_is_the_dense_one(side, step, stride):
    sources = keys_of(400, 5)
    targets = sources if stride == 1 else coarsen(sources, stride)
    features, weight = inputs(len(sources), side)
    ours = sparse_conv(features, weight, kernel_map(sources, targets, side, step))
    both = unpack_voxels(sources), unpack_voxels(targets)
    theirs = reference_sparse.convolve(features, weight, *both, side, step)
    assert_same(ours, theirs, (features, weight))


def assert_near(ours, theirs, inputs, wide_inputs) -> None:
    """Single against double precision: values, and gradients of a random projection of them."""
    assert ours.dtype == torch.float32
    assert largest_difference(ours, theirs) < 2e-6
    seed = torch.randn(theirs.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(9))
    mine = torch.autograd.grad((ours * seed.float()).sum(), inputs)
    other = torch.autograd.grad((theirs * seed).sum(), wide_inputs)
    for a, b in zip(mine, other, strict=True):
        assert largest_difference(a, b) < 2e-6


@pytest.mark.slow
@pytest.mark.parametrize("channels", [(32, 32), (10, 64), (96, 160), (64, 40)])
@pytest.mark.parametrize(("side", "step", "stride"), CASES)
def test_single_precision_is_the_dense_one(side, step, stride, channels):
    """A kernel of its own where both widths are multiples of 32; several blocks of targets and chunks of pairs."""
    sources = keys_of(900, 6)
    targets = sources if stride == 1 else coarsen(sources, stride)
    wide = inputs(len(sources), side, channels)
    narrow = [t.detach().float().requires_grad_() for t in wide]
    both = unpack_voxels(sources), unpack_voxels(targets)
    theirs = reference_sparse.convolve(*wide, *both, side, step)
    assert_near(sparse_conv(*narrow, kernel_map(sources, targets, side, step)), theirs, narrow, wide)


@pytest.mark.parametrize("channels", [(10, 70), (48, 3)])
@pytest.mark.parametrize(("side", "step", "stride"), [(3, 1, 1), (2, 1, 2)])
def test_blocks_convolve_as_the_dense_one(side, step, stride, channels):
    """The kernels of CUDA: more rows and channels than a block owns, and fewer."""
    sources = keys_of(300, 6)
    targets = sources if stride == 1 else coarsen(sources, stride)
    pairs = kernel_map(sources, targets, side, step)
    wide = inputs(len(sources), side, channels)
    narrow = [t.detach().float().requires_grad_() for t in wide]
    both = unpack_voxels(sources), unpack_voxels(targets)
    theirs = reference_sparse.convolve(*wide, *both, side, step)
    assert_near(sparse_conv(*narrow, pairs, schedule="block"), theirs, narrow, wide)
    if stride == 2:  # back up on the same map, whose tables are kept
        down = torch.randn(len(targets), channels[0], generator=torch.Generator().manual_seed(1)).requires_grad_()
        up = [sparse_conv(down, narrow[1], pairs.swapped(), schedule=schedule) for schedule in ("block", "lanes")]
        assert largest_difference(*up) < 2e-6
        assert largest_difference(*(torch.autograd.grad(y.square().sum(), down)[0] for y in up)) < 1e-5


def test_blocks_leave_double_precision_and_large_kernels_to_torch():
    keys = keys_of(50, 5)
    features, weight = inputs(len(keys), 3)
    assert torch.equal(
        sparse_conv(features, weight, kernel_map(keys, keys, 3), schedule="block"),
        sparse_conv(features, weight, kernel_map(keys, keys, 3), schedule="lanes"),
    )


def test_single_precision_has_the_same_bits_for_any_number_of_threads():
    keys = keys_of(4000, 12)
    pairs = kernel_map(keys, keys, 3)
    features, weight = (t.detach().float().requires_grad_() for t in inputs(len(keys), 3, (64, 96)))
    before, results = get_threads(), []
    try:
        for threads in (1, 2, 5):
            set_threads(threads)
            y = sparse_conv(features, weight, pairs)
            results.append([y.detach(), *torch.autograd.grad(y.square().sum(), (features, weight))])
    finally:
        set_threads(before)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


@pytest.mark.parametrize("stride", [2, 4])
def test_transposed_convolution_is_the_dense_one(stride):
    """From level `stride` to level `stride / 2`, as a U-Net goes up."""
    fine = keys_of(400, 9) if stride == 2 else coarsen(keys_of(400, 9), stride // 2)
    coarse = coarsen(fine, stride)
    features, weight = inputs(len(coarse), 2)
    ours = sparse_conv(features, weight, kernel_map(fine, coarse, 2, stride // 2).swapped())
    unit = torch.tensor([1, *[stride // 2] * 3])  # the dense grid holds one cell per fine voxel
    both = unpack_voxels(coarse) // unit, unpack_voxels(fine) // unit
    theirs = reference_sparse.convolve_transposed(features, weight, *both, side=2, stride=2)
    assert_same(ours, theirs, (features, weight))


@pytest.mark.slow
@pytest.mark.parametrize(("side", "stride", "transposed"), [(3, 1, False), (2, 2, False), (2, 2, True)])
def test_gradients_are_those_of_finite_differences(side, stride, transposed):
    fine = keys_of(25, 2)
    pairs = kernel_map(fine, fine if stride == 1 else coarsen(fine, stride), side)
    pairs = pairs.swapped() if transposed else pairs
    features, weight = inputs(pairs.source_count, side, channels=(2, 3))
    assert torch.autograd.gradcheck(lambda x, w: sparse_conv(x, w, pairs), (features, weight))


def test_only_the_gradients_that_are_asked_for():
    keys = keys_of(50, 3)
    features, weight = inputs(len(keys), 3)
    pairs = kernel_map(keys, keys, 3)
    sparse_conv(features.detach(), weight, pairs).sum().backward()
    assert features.grad is None
    assert weight.grad is not None
    both = weight.grad.clone()
    weight.grad = None
    sparse_conv(features, weight.detach(), pairs).sum().backward()
    assert weight.grad is None
    assert features.grad is not None
    assert bool(both.abs().max() > 0)


def test_a_voxel_without_neighbours_keeps_the_centre_weight():
    key = pack_voxels(torch.tensor([[0, -7, 3, 60000]]))
    features, weight = inputs(1, 3)
    assert torch.equal(sparse_conv(features, weight, kernel_map(key, key, 3)), features @ weight[13])


@pytest.mark.parametrize(("channels", "dtype"), [((5, 7), torch.float64), ((32, 64), torch.float32)])
def test_nothing_in_gives_nothing_out(channels, dtype):
    none = pack_voxels(torch.zeros(0, 4, dtype=torch.int64))
    features, weight = inputs(0, 3, channels, dtype)
    y = sparse_conv(features, weight, kernel_map(none, none, 3))
    assert y.shape == (0, channels[1])
    y.sum().backward()
    assert bool((weight.grad == 0).all())


@pytest.mark.parametrize("channels", [(5, 7), (32, 64)])
def test_a_row_of_nan_reaches_its_neighbours_and_nobody_else(channels):
    keys = pack_voxels(torch.tensor([[0, 0, 0, 0], [0, 0, 0, 1], [0, 0, 0, 2], [1, 0, 0, 0]]))
    features, weight = inputs(4, 3, channels, dtype=torch.float32)
    features = features.detach().clone()
    features[0] = float("nan")
    y = sparse_conv(features, weight, kernel_map(keys, keys, 3))
    assert torch.isnan(y).all(dim=1).tolist() == [True, True, False, False]
    assert torch.isnan(y).any(dim=1).tolist() == [True, True, False, False]


@pytest.mark.slow
@pytest.mark.parametrize("schedule", ["lanes", "block"])
@pytest.mark.parametrize(
    ("dtype", "bound", "autocast"),
    [
        (torch.float32, 2e-6, False),
        (torch.bfloat16, 8e-3, False),
        (torch.bfloat16, 8e-3, True),
        (torch.float16, 1e-3, False),
        (torch.float16, 1e-3, True),
    ],
)
def test_lower_precision_stays_near_float64(dtype, bound, autocast, schedule):
    """Half precision rounds the inputs and each product (unit roundoff 2^-9 for bfloat16, 2^-11 for float16); the sum
    over 27 offsets adds nothing to that, because it is taken in float32."""
    keys = keys_of(600, 5)
    pairs = kernel_map(keys, keys, 3)
    features, weight = inputs(len(keys), 3, channels=(16, 24))
    rounded = [t.detach().to(dtype).double().requires_grad_() for t in (features, weight)]
    expected = sparse_conv(*rounded, pairs)
    gradients = torch.autograd.grad(expected.square().sum(), rounded)
    stored = torch.float32 if autocast else dtype
    low = [t.detach().to(stored).requires_grad_() for t in (features, weight)]
    with torch.autocast("cpu", dtype=dtype, enabled=autocast):
        y = sparse_conv(*low, pairs, schedule=schedule)
    assert y.dtype == dtype
    assert largest_difference(y.double(), expected) < bound
    mine = torch.autograd.grad((y.double().square()).sum(), low)
    for got, wanted in zip(mine, gradients, strict=True):
        assert got.dtype == stored
        assert largest_difference(got.double(), wanted) < 2 * bound


def test_large_weight_gradients_do_not_overflow_under_float16_autocast():
    """Sums over many voxels pass 65504, the largest float16, while the gradient itself is float32."""
    keys = keys_of(4000, 12)
    features, weight = (t.detach().float().requires_grad_() for t in inputs(len(keys), 3))
    with torch.autocast("cpu", dtype=torch.float16):
        y = sparse_conv(features, weight, kernel_map(keys, keys, 3))
    (v_weight,) = torch.autograd.grad(y, weight, torch.full_like(y, 1000.0))
    assert float(v_weight.abs().max()) > 65504
    assert bool(torch.isfinite(v_weight).all())


def test_shapes_that_do_not_belong_together_are_refused():
    keys = keys_of(30, 3)
    pairs = kernel_map(keys, keys, 3)
    features, weight = inputs(len(keys), 3)
    for bad in [(features[1:], weight), (features, weight[1:]), (features[:, 1:], weight), (features, weight[0])]:
        with pytest.raises(InputError, match="do not fit a map"):
            sparse_conv(*bad, pairs)


def spconv_layer(kind: str, weight: torch.Tensor, side: int):
    """A layer of spconv with our weight; its own order of axes is z, y, x."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # its build tools use what Python deprecates
        spconv = pytest.importorskip("spconv.pytorch", reason="spconv is not installed; pip install 'sgwarp[spconv]'")
    channels = weight.shape[1:]
    options = {"stride": 2} if kind == "SparseConv3d" else {}
    layer = getattr(spconv, kind)(*channels, side, bias=False, indice_key="map", algo=spconv.ConvAlgo.Native, **options)
    ours = weight.view(side, side, side, *channels)  # iz, iy, ix, in, out
    layer.weight.data = ours.permute(4, 0, 1, 2, 3).contiguous()
    return spconv, layer


@pytest.mark.parametrize(
    ("kind", "side", "stride"), [("SubMConv3d", 3, 1), ("SubMConv3d", 5, 1), ("SparseConv3d", 2, 2)]
)
def test_convolution_is_that_of_spconv(kind, side, stride):
    keys = keys_of(3000, 12)
    coordinates = unpack_voxels(keys)
    low = torch.div(coordinates[:, 1:].amin(dim=0), 16, rounding_mode="floor") * 16
    moved = coordinates - torch.cat([low.new_zeros(1), low])
    features, weight = (t.detach().float() for t in inputs(len(keys), side, channels=(16, 32)))
    spconv, layer = spconv_layer(kind, weight, side)
    shape = ((moved[:, 1:].amax(dim=0) // 2 + 1) * 2).tolist()[::-1]
    tensor = spconv.SparseConvTensor(features, moved[:, [0, 3, 2, 1]].int().contiguous(), shape, 3)
    # Its threads add to the same rows at once and lose sums; alone it is right, and the same every time.
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.no_grad():
            theirs = layer(tensor)
    finally:
        torch.set_num_threads(threads)
    targets = keys if stride == 1 else coarsen(keys, stride)
    ours = sparse_conv(features, weight, kernel_map(keys, targets, side))
    places = theirs.indices[:, [0, 3, 2, 1]].long() * torch.tensor([1, stride, stride, stride])
    their_keys = pack_voxels(places + torch.cat([low.new_zeros(1), low]))
    order = their_keys.argsort()
    assert torch.equal(their_keys[order], targets)
    assert largest_difference(ours, theirs.features[order]) < 2e-6


def test_a_map_counts_its_pairs():
    keys = pack_voxels(torch.tensor([[0, 0, 0, 0], [0, 0, 0, 1], [0, 7, 7, 7]]))
    pairs = kernel_map(keys, keys, 3)
    assert (pairs.offsets, pairs.identity, pairs.pairs) == (27, 13, 5)
    assert (pairs.starts[13], pairs.starts[14], pairs.starts[27]) == (1, 1, 2)
