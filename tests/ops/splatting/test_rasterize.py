"""The rasterizer against the float64 oracle, and against itself in the other schedule and with other thread counts."""

import itertools
import math

import pytest
import torch
import warp as wp

import sgwarp as sg
from sgwarp.errors import InputError
from sgwarp.kernels import binning_lanes
from sgwarp.ops import arguments, launcher
from sgwarp.ops.reference import rasterizer as reference
from sgwarp.ops.splatting import tiles
from sgwarp.ops.splatting.forward import composite, rasterize
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.scene import Camera, Gaussians

# Pixels where an alpha or a transmittance lies this near (relatively) to its threshold may flip in float32.
BOUNDARY_BAND = 1e-4
IMAGE_TOLERANCE = 2e-5


def lists_of(
    gaussians: Gaussians, camera: Camera
) -> tuple[tiles.Projected, torch.Tensor, torch.Tensor, tiles.TileLists]:
    settings = RasterSettings()
    projected = tiles.project(gaussians, camera, settings)
    order = tiles.depth_order(projected)
    colors = tiles.shade(gaussians, camera, order, gaussians.sh_degree)
    return projected, order, colors, tiles.bin_splats(projected, order, colors, camera, places=True, tiles=True)


def test_colors_and_alpha_match_the_oracle(scene):
    _, gaussians, camera = scene
    expected = reference.rasterize(gaussians, camera)
    got = rasterize(gaussians, camera)
    clear = expected.margin > BOUNDARY_BAND
    assert clear.float().mean() > 0.8 or clear.numel() == 1
    torch.testing.assert_close(got.features.double()[clear], expected.features[clear], rtol=0, atol=IMAGE_TOLERANCE)
    torch.testing.assert_close(got.alpha.double()[clear], expected.alpha[clear], rtol=0, atol=IMAGE_TOLERANCE)


def test_depths_match_the_oracle(scene):
    _, gaussians, camera = scene
    expected = reference.rasterize(gaussians, camera)
    got = rasterize(gaussians, camera, depth=True, expected_depth=True)
    clear = expected.margin > BOUNDARY_BAND
    mean = got.expected_depth.double()
    torch.testing.assert_close(mean[clear], expected.expected_depth[clear], rtol=2e-5, atol=2e-5)
    clear &= (expected.surface_margin > BOUNDARY_BAND) & (expected.order_margin > 1e-6)
    torch.testing.assert_close(got.depth.double()[clear], expected.depth[clear], rtol=1e-5, atol=0)


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 16, 37, 80])
def test_any_number_of_channels_matches_the_oracle(make_scene, channels):
    _, gaussians, camera = make_scene("odd_size")
    torch.manual_seed(channels)
    features = torch.rand(len(gaussians), channels)
    background = torch.rand(channels)
    expected = reference.rasterize(gaussians, camera, features=features.double(), background=background.double())
    got = rasterize(gaussians, camera, features, background=background)
    assert got.features.shape == (*camera.size, channels)
    clear = expected.margin > BOUNDARY_BAND
    torch.testing.assert_close(got.features.double()[clear], expected.features[clear], rtol=0, atol=IMAGE_TOLERANCE)


def test_features_and_depth_in_one_call(make_scene):
    _, gaussians, camera = make_scene("random_cloud")
    features = torch.rand(len(gaussians), 20)
    both = rasterize(gaussians, camera, features, depth=True)
    assert torch.equal(both.features, rasterize(gaussians, camera, features).features)
    assert torch.equal(both.depth, rasterize(gaussians, camera, depth=True).depth)


@pytest.mark.parametrize(
    "settings",
    [
        RasterSettings(alpha_min=0.05),
        RasterSettings(transmittance_min=0.1),
        RasterSettings(dilation=0.0),
        RasterSettings(antialiased=True),
        RasterSettings(alpha_max=0.7),
        RasterSettings(sh_degree=1),
    ],
)
def test_every_setting_matches_the_oracle(make_scene, settings):
    _, gaussians, camera = make_scene("sh3")
    plain = rasterize(gaussians, camera)
    got = rasterize(gaussians, camera, settings=settings)
    assert not torch.equal(plain.features, got.features), "the setting must do something"
    mirrored = reference.ReferenceSettings(
        **{name: getattr(settings, name) for name in ("alpha_min", "alpha_max", "transmittance_min", "antialiased")},
        eps2d=settings.dilation,
    )
    expected = reference.rasterize(gaussians, camera, settings=mirrored, sh_degree=settings.sh_degree)
    clear = expected.margin > BOUNDARY_BAND
    torch.testing.assert_close(got.features.double()[clear], expected.features[clear], rtol=0, atol=IMAGE_TOLERANCE)


def test_block_schedule_equals_lane_schedule(scene):
    _, gaussians, camera = scene
    settings = RasterSettings()
    *_, lists = lists_of(gaussians, camera)
    lanes = composite(lists, camera, settings, None, True, "lanes")
    block = composite(lists, camera, settings, None, True, "block")
    clear = reference.rasterize(gaussians, camera).margin > BOUNDARY_BAND
    assert len(lanes) == len(block) == 5  # colours, transmittance, alpha, depth sum, surface
    for a, b in zip(lanes, block, strict=True):
        torch.testing.assert_close(a[clear], b[clear], rtol=1e-6, atol=1e-5)
    features = torch.rand(len(gaussians), 21)
    lanes = composite(lists, camera, settings, features, False, "lanes")
    block = composite(lists, camera, settings, features, False, "block")
    for a, b in zip(lanes[:3], block[:3], strict=True):
        torch.testing.assert_close(a[clear], b[clear], rtol=0, atol=1e-5)


def test_sorted_lists_equal_counted_lists(scene):
    """The CUDA way of binning (emit, sort, list) gives the CPU's lists."""
    _, gaussians, camera = scene
    assert_lists_equal(gaussians, camera)


def assert_lists_equal(gaussians: Gaussians, camera: Camera) -> None:
    projected, order, colors, counted = lists_of(gaussians, camera)
    kept = [t.clone() for t in vars(counted).values()]
    memory = torch.zeros_like(counted.memory)
    packed = arguments.view(colors, wp.vec3)
    by_sort = tiles.bin_by_sorting(projected, order, packed, camera, memory, keep=True)
    for name, want, got in zip(vars(counted), kept, vars(by_sort).values(), strict=True):
        assert torch.equal(want, got), name


@pytest.mark.parametrize("size", [(170, 4200), (300, 40)])
def test_splats_across_many_tiles_are_listed_the_same(size):
    """Wider than eight bits hold columns of tiles, and taller than the rows that counting keeps for filling."""
    g = torch.Generator().manual_seed(0)
    n, (height, width) = 40, size
    K = torch.tensor([[2000.0, 0, width / 2], [0, 2000.0, height / 2], [0, 0, 1]], dtype=torch.float64)
    camera = Camera(K, torch.eye(4, dtype=torch.float64), width, height)
    spread = torch.tensor([width / 1000, height / 1000, 0.5])
    means = spread * (torch.rand(n, 3, generator=g) - 0.5) + torch.tensor([0.0, 0.0, 2.0])
    scales = 0.08 * torch.rand(n, 3, generator=g) + 0.001
    gaussians = Gaussians(
        means, torch.randn(n, 4, generator=g), scales, torch.ones(n), torch.rand(n, 1, 3, generator=g)
    )
    assert_lists_equal(gaussians, camera)
    _, _, _, lists = lists_of(gaussians, camera)
    per_splat = lists.entries.diff()
    assert int(per_splat.max()) > 20


def test_rows_of_sums_belong_to_a_splat_in_a_patch(scene):
    _, gaussians, camera = scene
    projected, order, colors, lists = lists_of(gaussians, camera)
    lists = tiles.bin_splats(projected, order, colors, camera, tiles=True, places=True, rows=True, keep=True)
    columns, patch = -(-camera.width // 16), 4
    offsets, ranks = lists.offsets.long(), lists.listed.long()
    tile = torch.repeat_interleave(torch.arange(lists.tile_count), offsets.diff())
    place = torch.stack([ranks, tile // columns // patch, tile % columns // patch], dim=1)
    start, step = lists.row_places[ranks].long().unbind(1)
    rows = start + step * place[:, 1] + place[:, 2]
    # As many rows as there are pairs of a splat and a patch, and never two pairs in one row.
    pairs, which = place.unique(dim=0, return_inverse=True)
    owner = torch.full((int(lists.row_ranges[-1, 0]),), -1)
    owner[rows] = which
    assert torch.equal(owner[rows], which)
    assert len(owner[owner >= 0].unique()) == len(pairs)
    # The rows of a Gaussian are its own range, and the ranges follow each other.
    first, count = lists.row_ranges[order.long()].long().unbind(1)
    assert ((rows >= first[ranks]) & (rows < (first + count)[ranks])).all()
    assert torch.equal(first[1:], (first + count)[:-1])
    assert int(lists.row_ranges[:-1, 1].sum()) == len(owner)


def least_on_tile(mean: torch.Tensor, conic: torch.Tensor, tile: int, camera: Camera) -> float:
    """Smallest d^T conic d over the rectangle of a tile's pixel centres, in closed form: on its border, or 0 inside."""
    columns = -(-camera.width // 16)
    left, top = 16 * (tile % columns) + 0.5, 16 * (tile // columns) + 0.5
    (x, y), (a, b, c) = mean.tolist(), conic.tolist()
    x0, x1, y0, y1 = left - x, min(left + 15, camera.width - 0.5) - x, top - y, top + 15 - y
    if x0 <= 0 <= x1 and y0 <= 0 <= y1:
        return 0.0

    def value(u: float, v: float) -> float:
        return a * u * u + 2 * b * u * v + c * v * v

    on_columns = [value(u, min(max(-b * u / c, y0), y1)) for u in (x0, x1)]
    on_rows = [value(min(max(-b * v / a, x0), x1), v) for v in (y0, y1)]
    return min(on_columns + on_rows)


def test_tile_lists_hold_exactly_what_reaches_a_tile(make_scene):
    """Every (tile, Gaussian) with a pixel above alpha_min is listed, in (depth, index) order."""
    for name in ("needles", "odd_size", "off_centre"):
        _, gaussians, camera = make_scene(name)
        *_, lists = lists_of(gaussians, camera)
        splats, ranks = lists.splats.numpy(), lists.listed.numpy()
        p = reference.project_scene(gaussians, camera)
        y, x = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
        at = torch.stack([x, y], -1).reshape(-1, 1, 2).double() + 0.5
        d = at - p.mean2d
        a, b, c = p.conic.unbind(-1)
        power = -0.5 * (a * d[..., 0] ** 2 + c * d[..., 1] ** 2) - b * d[..., 0] * d[..., 1]
        alpha = p.opacity * power.exp()
        tile = (y // 16 * -(-camera.width // 16) + x // 16).reshape(-1)
        for t in range(lists.tile_count):
            listed = splats[ranks[lists.offsets[t] : lists.offsets[t + 1]]]
            depths = listed["depth"]
            assert (depths[1:] >= depths[:-1]).all()
            reached = set(p.index[(alpha[tile == t] > (1 / 255) * (1 + 1e-4)).any(0)].tolist())
            assert reached <= set(listed["gaussian"].tolist()), f"{name}: tile {t} lost a Gaussian"
            for gaussian in set(listed["gaussian"].tolist()) - reached:
                row = int((p.index == gaussian).nonzero()[0])
                limit = 2.0 * math.log(255.0 * float(p.opacity[row]))
                least = least_on_tile(p.mean2d[row], p.conic[row], t, camera)
                assert least <= limit + 1e-3, f"{name}: tile {t} lists Gaussian {gaussian}, which does not reach it"


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_same_bits_for_any_number_of_threads(make_scene, monkeypatch, count):
    _, gaussians, camera = make_scene("random_cloud")
    camera = camera.resized(400, 530)
    features = torch.rand(len(gaussians), 20)
    monkeypatch.setattr(launcher, "SMALL", 1)
    before = launcher.get_threads()
    try:
        launcher.set_threads(1)
        colors, wide = rasterize(gaussians, camera, depth=True), rasterize(gaussians, camera, features)
        launcher.set_threads(count)
        again, wide_again = rasterize(gaussians, camera, depth=True), rasterize(gaussians, camera, features)
    finally:
        launcher.set_threads(before)
    assert torch.equal(colors.features, again.features)
    assert torch.equal(colors.depth, again.depth)
    assert torch.equal(wide.features, wide_again.features)


def test_a_closed_pixel_stays_closed():
    """Three opaque walls close every pixel; a faint Gaussian behind them must not slip in."""
    camera = Camera(torch.tensor([[50.0, 0, 8], [0, 50, 8], [0, 0, 1]]), torch.eye(4), 16, 16)
    n = 8
    means = torch.zeros(n, 3)
    means[:, 2] = torch.arange(n) + 2.0
    opacities = torch.tensor([0.99] * 3 + [0.004, 0.5, 0.01, 0.9, 0.005])
    gaussians = Gaussians(
        means, torch.tensor([[1.0, 0, 0, 0]] * n), torch.full((n, 3), 3.0), opacities, torch.rand(n, 1, 3)
    )
    expected = reference.rasterize(gaussians, camera)
    got = rasterize(gaussians, camera)
    assert got.alpha.max() < 1.0 - 1e-6
    torch.testing.assert_close(got.alpha.double(), expected.alpha, rtol=0, atol=1e-6)


def test_bad_gaussians_are_left_out_and_counted(make_scene):
    _, gaussians, camera = make_scene("random_cloud")
    clean = rasterize(gaussians, camera)
    bad = gaussians.subset(torch.arange(6))
    means, quats, scales, opacities, sh = (t.clone() for t in (bad.means, bad.quats, bad.scales, bad.opacities, bad.sh))
    means[0, 1] = math.nan
    means[1, 2] = math.inf
    quats[2] = 0.0
    quats[3, 0] = math.nan
    scales[4, 0] = math.inf
    sh[5] = math.nan  # colour alone: its geometry is sound
    spoiled = Gaussians(
        *(
            torch.cat(pair)
            for pair in zip(
                (means, quats, scales, opacities, sh),
                (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh),
                strict=True,
            )
        )
    )
    got = rasterize(spoiled, camera, depth=True, expected_depth=True)
    assert torch.equal(got.features, clean.features)
    assert torch.isfinite(got.expected_depth).all()
    assert got.culled["non_finite"] == 6
    assert sum(got.culled.values()) < len(spoiled)


def test_empty_scene_and_nothing_in_view_give_the_background(make_scene):
    _, gaussians, camera = make_scene("random_cloud")
    background = torch.tensor([0.2, 0.4, 0.6])
    nothing = gaussians.subset(torch.zeros(len(gaussians), dtype=torch.bool))
    behind = Gaussians(
        camera.position.float() - 5.0 * camera.world_to_camera[2, :3].float() + torch.zeros(3, 3),
        gaussians.quats[:3],
        gaussians.scales[:3] * 0 + 0.01,
        gaussians.opacities[:3],
        gaussians.sh[:3],
    )
    for scene in (nothing, behind):
        got = rasterize(scene, camera, background=background, depth=True)
        assert torch.equal(got.features, background.expand(*camera.size, 3))
        assert (got.depth == 0).all()
        wide = rasterize(scene, camera, torch.zeros(len(scene), 7))
        assert (wide.features == 0).all()


@pytest.mark.parametrize("size", [(64, 48), (640, 480)])
def test_what_is_not_in_view_has_gradients_of_zero(size):
    """Nothing at all in view, after a view that showed something and left its rows in the scratch memory."""
    width, height = size
    values = {
        "means": torch.rand(40, 3, generator=torch.Generator().manual_seed(0)) + torch.tensor([-0.5, -0.5, 3.0]),
        "quats": torch.tensor([[1.0, 0, 0, 0]]).repeat(40, 1),
        "scales": torch.full((40, 3), 0.1),
        "opacities": torch.full((40,), 0.5),
        "sh": torch.full((40, 4, 3), 0.1),
    }
    K = torch.tensor([[0.8 * width, 0, width / 2], [0, 0.8 * width, height / 2], [0, 0, 1.0]])
    for turned, seen in ((1.0, True), (-1.0, False), (-1.0, False)):
        tensors = {name: value.clone().requires_grad_() for name, value in values.items()}
        pose = torch.diag(torch.tensor([turned, 1.0, turned, 1.0])).requires_grad_()
        image = sg.rasterize(**tensors, viewmat=pose, K=K, width=width, height=height).features
        (image.square().sum() + image.sum()).backward()
        for tensor in (*tensors.values(), pose):
            assert torch.isfinite(tensor.grad).all()
            assert bool(tensor.grad.any()) == seen


def test_inputs_are_checked(make_scene):
    _, gaussians, camera = make_scene("random_cloud")
    with pytest.raises(InputError, match="features"):
        rasterize(gaussians, camera, torch.rand(3, 4))
    with pytest.raises(InputError, match="background"):
        rasterize(gaussians, camera, background=torch.zeros(4))
    with pytest.raises(InputError, match="alpha_min"):
        RasterSettings(alpha_min=0.0)
    with pytest.raises(ValueError, match="at least 1"):
        launcher.set_threads(0)


@pytest.mark.parametrize(("width", "height"), [(1, 1), (64, 64), (200, 150), (1000, 70)])
def test_patches_are_ordered_by_their_intersections(width, height):
    columns, down = -(-width // 16), -(-height // 16)
    lengths = torch.randint(0, 3000, (down, columns), generator=torch.Generator().manual_seed(4))
    offsets = torch.nn.functional.pad(lengths.flatten().cumsum(0), (1, 0)).to(torch.int32)
    across, patches = -(-columns // 4), -(-columns // 4) * -(-down // 4)
    order, used = torch.full((patches,), -1, dtype=torch.int32), torch.ones(77, dtype=torch.uint8)
    outputs = [arguments.view(order, wp.int32), arguments.view(used, wp.uint8)]
    inputs = [arguments.view(offsets, wp.int32), width, height]
    launcher.launch(binning_lanes.order_patches, 1, inputs, outputs, device=offsets.device)
    assert sorted(order.tolist()) == list(range(patches))
    sums = [int(lengths[p // across * 4 :, p % across * 4 :][:4, :4].sum()) for p in order.tolist()]
    assert all(later <= 1.125 * earlier for earlier, later in itertools.pairwise(sums))
    assert not used.any()


def test_kernels_read_torch_memory_without_a_copy(make_scene):
    _, gaussians, _ = make_scene("random_cloud")
    assert arguments.view(gaussians.means, wp.vec3).data == gaussians.means.data_ptr()


def test_colours_that_are_not_finite_are_marked_as_on_cuda(make_scene):
    _, gaussians, _camera = make_scene("sh3")
    sh = gaussians.sh.clone()
    sh[3, 0, 1], sh[5, -1, 2], sh[8, 2, 0], sh[9] = torch.nan, torch.inf, -torch.inf, 3e38
    status = torch.arange(len(gaussians)).to(torch.uint8) % 5
    expected = torch.where(torch.isfinite(sh).flatten(1).all(dim=1), status, 1)
    tiles.mark_non_finite_colors(sh, status)
    assert torch.equal(status, expected.to(torch.uint8))
    assert int((expected == 1).sum()) > 3
