"""Lifting against the float64 oracle, as the transpose of the renderer, and ids against dense features."""

from dataclasses import replace

import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.ops import launcher
from sgwarp.ops.reference import lifting as reference_lift
from sgwarp.ops.splatting import tiles, wide_lifting
from sgwarp.ops.splatting.forward import rasterize
from sgwarp.ops.splatting.lifting import LiftSums, add_weighted, lift_view
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.scene import Camera, FeatureMap, Gaussians

SETTINGS = RasterSettings()


def lifted(gaussians: Gaussians, camera: Camera, feature_map: FeatureMap, **options) -> LiftSums:
    sums = LiftSums.zeros(len(gaussians), feature_map.channels)
    lift_view(gaussians, camera, feature_map, sums, **options)
    return sums


def random_map(camera: Camera, channels: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*camera.size, channels, generator=torch.Generator().manual_seed(seed))


def random_ids(height: int, width: int, count: int, levels: int = 1) -> torch.Tensor:
    generator = torch.Generator().manual_seed(count)
    return torch.randint(-1, count, (levels, height, width), generator=generator, dtype=torch.int32)


def assert_sums_close(a: LiftSums, b: LiftSums, scale: float = 1.0) -> None:
    """Sums over hundreds of pixels: float32 rounding relative to the weight behind them."""
    bound = 4e-6 * scale * (1.0 + b.weight.max().item())
    torch.testing.assert_close(a.features, b.features, rtol=1e-5, atol=bound)
    torch.testing.assert_close(a.weight, b.weight, rtol=1e-5, atol=bound)
    torch.testing.assert_close(a.weight_squared, b.weight_squared, rtol=1e-4, atol=bound)


def test_weighted_lifting_is_the_transpose_of_the_renderer(scene):
    """<A x, y> = <x, A^T y> for random x and y: one number that sees every entry of A."""
    _, gaussians, camera = scene
    x = torch.randn(len(gaussians), 16, generator=torch.Generator().manual_seed(1))
    y = random_map(camera, 16)
    rendered = rasterize(gaussians, camera, x).features.double()
    back = lifted(gaussians, camera, FeatureMap(space="t", dense=y)).features.double()
    left, right = (rendered * y).sum(), (x * back).sum()
    size = (rendered.abs() * y.abs()).sum()
    assert abs(left - right) <= 2e-6 * size


@pytest.mark.parametrize("channels", [1, 16, 40, 70])
def test_weighted_lifting_matches_the_oracle(make_scene, channels):
    for name in ("random_cloud", "odd_size", "needles", "far_coordinates"):
        _, gaussians, camera = make_scene(name)
        image = random_map(camera, channels)
        valid = torch.rand(camera.size, generator=torch.Generator().manual_seed(2)) > 0.3
        got = lifted(gaussians, camera, FeatureMap(space="t", dense=image, valid=valid))
        expected = reference_lift.lift_weighted(gaussians, camera, image.double(), valid=valid)
        scale = expected.weight.max().item()
        torch.testing.assert_close(got.features.double(), expected.features, rtol=1e-4, atol=2e-5 * scale)
        torch.testing.assert_close(got.weight.double(), expected.weight, rtol=1e-4, atol=2e-5 * scale)
        torch.testing.assert_close(got.weight_squared, got.weight**2)


def wide_maps(camera: Camera) -> list[FeatureMap]:
    """129 and 208 channels: two and three groups of four slices, with one slice left over; plain, masked and small."""
    valid = torch.rand(camera.size, generator=torch.Generator().manual_seed(2)) > 0.3
    small = random_map(camera.resized(*(-(-side // 2) for side in camera.size)), 129)
    wide = random_map(camera, 208)
    return [FeatureMap("t", dense=wide), FeatureMap("t", dense=wide, valid=valid), FeatureMap("t", dense=small)]


@pytest.mark.parametrize("squared", [False, True])
def test_many_channels_have_the_bits_of_few(make_scene, monkeypatch, squared):
    """Written down or walked for, the entries of A give the same sums; so do any threads and ranges of ranks."""
    mode = "squared" if squared else "weighted"
    _, gaussians, camera = make_scene("odd_size")
    for feature_map in wide_maps(camera):
        with monkeypatch.context() as patch:
            patch.setattr(wide_lifting, "PAIR_BYTES", 0)  # never written down
            walked = lifted(gaussians, camera, feature_map, mode=mode)
        assert walked.weight.any()
        for threads, ranks in ((1, 2**18), (2, 7), (5, 2**18)):
            monkeypatch.setattr(launcher, "SMALL", 1)
            monkeypatch.setattr(wide_lifting, "MOST_RANKS", ranks)
            before = launcher.get_threads()
            try:
                launcher.set_threads(threads)
                written = lifted(gaussians, camera, feature_map, mode=mode)
            finally:
                launcher.set_threads(before)
            for name in ("slices", "weight", "weight_squared"):
                assert torch.equal(getattr(written, name), getattr(walked, name)), (threads, name)


def test_many_channels_match_the_oracle(make_scene):
    for name in ("random_cloud", "needles"):
        _, gaussians, camera = make_scene(name)
        plain, masked, _ = wide_maps(camera)
        got = lifted(gaussians, camera, masked)
        expected = reference_lift.lift_weighted(gaussians, camera, plain.dense.double(), valid=masked.valid)
        scale = expected.weight.max().item()
        torch.testing.assert_close(got.features.double(), expected.features, rtol=1e-4, atol=2e-5 * scale)
        torch.testing.assert_close(got.weight.double(), expected.weight, rtol=1e-4, atol=2e-5 * scale)


def test_many_channels_of_nothing(make_scene):
    _, gaussians, camera = make_scene("odd_size")
    far = replace(camera, near=1e6, far=2e6)
    assert not lifted(gaussians, far, wide_maps(far)[0]).slices.any()


def test_ids_equal_the_dense_map_they_stand_for(scene):
    _, gaussians, camera = scene
    height, width = camera.size
    ids = random_ids(height, width, 9)
    vectors = torch.randn(9, 70, generator=torch.Generator().manual_seed(3))
    held = ids[0] >= 0
    dense = torch.where(held[..., None], vectors[ids[0].clamp(min=0).long()], 0.0)
    by_id = lifted(gaussians, camera, FeatureMap(space="t", ids=ids, vectors=vectors))
    assert_sums_close(by_id, lifted(gaussians, camera, FeatureMap(space="t", dense=dense, valid=held)))
    labels = tuple("abcdefghi")
    one_hot = lifted(gaussians, camera, FeatureMap(space="labels", ids=ids, labels=labels))
    torch.testing.assert_close(one_hot.features @ vectors, by_id.features, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(one_hot.features.sum(1), by_id.weight, rtol=1e-5, atol=1e-5)


def test_few_large_and_many_small_segments(make_scene):
    """Tiles with one id, with up to four (masked sums) and with more (pixel by pixel)."""
    _, gaussians, camera = make_scene("odd_size")
    height, width = camera.size
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    for cell in (64, 12, 3, 1):
        ids = ((y // cell) * 64 + x // cell).to(torch.int32)
        ids = torch.unique(ids, return_inverse=True)[1].to(torch.int32)
        vectors = torch.randn(int(ids.max()) + 1, 5, generator=torch.Generator().manual_seed(cell))
        by_id = lifted(gaussians, camera, FeatureMap(space="t", ids=ids, vectors=vectors))
        assert_sums_close(by_id, lifted(gaussians, camera, FeatureMap(space="t", dense=vectors[ids.long()])))


def test_levels_add_up(make_scene):
    _, gaussians, camera = make_scene("random_cloud")
    ids = random_ids(*camera.size, 6, levels=3)
    vectors = torch.randn(6, 8)
    together = lifted(gaussians, camera, FeatureMap(space="t", ids=ids, vectors=vectors))
    apart = [lifted(gaussians, camera, FeatureMap(space="t", ids=level, vectors=vectors)) for level in ids]
    torch.testing.assert_close(together.features, sum(s.features for s in apart), rtol=1e-4, atol=1e-4)


def test_smaller_maps_are_read_where_they_lie(make_scene):
    _, gaussians, camera = make_scene("odd_size")
    height, width = camera.size
    ids = random_ids(height // 3, width // 2, 7)[0]
    row = (2 * torch.arange(height) + 1) * ids.shape[0] // (2 * height)
    column = (2 * torch.arange(width) + 1) * ids.shape[1] // (2 * width)
    vectors = torch.randn(7, 4)
    small = lifted(gaussians, camera, FeatureMap(space="t", ids=ids, vectors=vectors))
    assert_sums_close(small, lifted(gaussians, camera, FeatureMap(space="t", ids=ids[row][:, column], vectors=vectors)))

    dense = torch.randn(height // 3, width // 2, 20)
    full = torch.nn.functional.interpolate(dense.permute(2, 0, 1)[None], camera.size, mode="bilinear")[0].permute(
        1, 2, 0
    )
    small = lifted(gaussians, camera, FeatureMap(space="t", dense=dense))
    assert_sums_close(small, lifted(gaussians, camera, FeatureMap(space="t", dense=full.contiguous())))


def test_invalid_pixels_do_not_dilute_a_smaller_map(make_scene):
    """A constant feature stays that constant, however its valid region is cut."""
    _, gaussians, camera = make_scene("odd_size")
    h, w = camera.size[0] // 4, camera.size[1] // 4
    valid = torch.rand(h, w, generator=torch.Generator().manual_seed(0)) > 0.5
    dense = torch.full((h, w, 3), 2.0)
    dense[~valid] = float("nan")
    sums = lifted(gaussians, camera, FeatureMap(space="t", dense=dense, valid=valid))
    seen = sums.weight > 1e-3
    assert seen.any()
    mean = sums.features[seen] / sums.weight[seen, None]
    torch.testing.assert_close(mean, torch.full_like(mean, 2.0), rtol=1e-4, atol=0)


def test_center_mode_matches_the_oracle(scene):
    _, gaussians, camera = scene
    image = random_map(camera, 5)
    valid = torch.rand(camera.size, generator=torch.Generator().manual_seed(4)) > 0.3
    got = lifted(gaussians, camera, FeatureMap(space="t", dense=image, valid=valid), mode="center", border=2)
    expected = reference_lift.lift_center(gaussians, camera, image.double(), valid=valid, border=2)
    clear = expected.margin > 1e-4
    assert torch.equal(got.weight.double()[clear], expected.weight[clear])
    torch.testing.assert_close(got.features.double()[clear], expected.features[clear], rtol=0, atol=1e-6)


def test_center_mode_reads_ids_and_averages_levels(make_scene):
    _, gaussians, camera = make_scene("random_cloud")
    ids = random_ids(*camera.size, 6, levels=2)
    vectors = torch.randn(6, 4)
    got = lifted(gaussians, camera, FeatureMap(space="t", ids=ids, vectors=vectors), mode="center", border=0)
    held = ids >= 0
    mean = (
        torch.where(held[..., None], vectors[ids.clamp(min=0).long()], 0.0).sum(0) / held.sum(0).clamp(min=1)[..., None]
    )
    feature_map = FeatureMap(space="t", dense=mean, valid=held.any(0))
    expected = lifted(gaussians, camera, feature_map, mode="center", border=0)
    assert expected.weight.sum() > 10
    torch.testing.assert_close(got.features, expected.features)
    assert torch.equal(got.weight, expected.weight)


@pytest.mark.parametrize("ordered", [False, True])
def test_block_schedule_equals_lane_schedule(scene, ordered):
    _, gaussians, camera = scene
    projected = tiles.project(gaussians, camera, SETTINGS)
    order = tiles.depth_order(projected)
    lists = tiles.bin_splats(projected, order, None, camera, places=True, tiles=True)
    ids = random_ids(*camera.size, 20)
    blocky = torch.arange(20).view(4, 5)[None].repeat_interleave(max(camera.height // 4, 1), dim=1).to(torch.int32)
    maps = [
        FeatureMap(space="t", dense=random_map(camera, 20), valid=ids[0] > 5),
        FeatureMap(space="t", ids=blocky, vectors=torch.randn(20, 20)),
        FeatureMap(space="t", ids=ids, vectors=torch.randn(20, 20)),
        FeatureMap(space="labels", ids=ids, labels=tuple(str(i) for i in range(20))),
    ]
    for feature_map in maps:
        sums = [LiftSums.zeros(len(gaussians), 20) for _ in range(2)]
        add_weighted(lists, camera, feature_map, sums[0], SETTINGS, block=False, ordered=True)
        add_weighted(lists, camera, feature_map, sums[1], SETTINGS, block=True, ordered=ordered)
        assert_sums_close(sums[1], sums[0], scale=4.0)


@pytest.mark.parametrize("ordered", [False, True])
def test_blocks_lift_any_number_of_channels(make_scene, ordered):
    """More and fewer channels than a block lifts, and opaque tiles, whose blocks end early."""
    _, gaussians, camera = make_scene("opaque_stack")
    projected = tiles.project(gaussians, camera, SETTINGS)
    lists = tiles.bin_splats(projected, tiles.depth_order(projected), None, camera, places=True)
    for channels in (1, 16, 40, 96):
        feature_map = FeatureMap(space="t", dense=random_map(camera, channels))
        sums = [LiftSums.zeros(len(gaussians), channels) for _ in range(2)]
        for schedule, result in zip(("lanes", "block"), sums, strict=True):
            block = schedule == "block"
            add_weighted(lists, camera, feature_map, result, SETTINGS, block=block, ordered=ordered or not block)
        assert_sums_close(sums[1], sums[0])


def test_same_bits_for_any_number_of_threads(make_scene, monkeypatch):
    _, gaussians, camera = make_scene("random_cloud")
    camera = camera.resized(300, 410)
    ids = random_ids(30, 41, 12)
    maps = [
        FeatureMap(space="t", dense=random_map(camera, 80)),
        FeatureMap(space="t", ids=ids, vectors=torch.randn(12, 24)),
    ]
    monkeypatch.setattr(launcher, "SMALL", 1)
    before = launcher.get_threads()
    try:
        results = []
        for count in (1, 2, 5):
            launcher.set_threads(count)
            results.append([lifted(gaussians, camera, m) for m in maps])
    finally:
        launcher.set_threads(before)
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            assert torch.equal(a.features, b.features)
            assert torch.equal(a.weight, b.weight)
            assert torch.equal(a.weight_squared, b.weight_squared)


def test_views_accumulate(make_scene):
    _, gaussians, camera = make_scene("random_cloud")
    feature_map = FeatureMap(space="t", dense=random_map(camera, 7))
    sums = lifted(gaussians, camera, feature_map)
    once = sums.features.clone()
    lift_view(gaussians, camera, feature_map, sums)
    torch.testing.assert_close(sums.features, 2 * once, rtol=1e-6, atol=1e-6)
    seen = sums.weight > 0
    effective = sums.weight[seen] ** 2 / sums.weight_squared[seen]
    torch.testing.assert_close(effective, torch.full_like(effective, 2.0))


def test_inputs_are_checked(make_scene):
    _, gaussians, camera = make_scene("random_cloud")
    feature_map = FeatureMap(space="t", dense=random_map(camera, 7))
    with pytest.raises(InputError, match="channels"):
        lift_view(gaussians, camera, feature_map, LiftSums.zeros(len(gaussians), 8))
    with pytest.raises(InputError, match="mode"):
        lift_view(gaussians, camera, feature_map, LiftSums.zeros(len(gaussians), 7), mode="median")
