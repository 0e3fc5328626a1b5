"""Lifting only what changed gives the bits of lifting everything, whatever changes."""

from dataclasses import replace

import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.ops.launcher import get_threads, set_threads
from sgwarp.ops.splatting.incremental import IncrementalLift
from sgwarp.ops.splatting.lifting import LiftSums, lift_view
from sgwarp.scene import Camera, FeatureMap, Gaussians

COUNT = 600


def cloud(seed: int, count: int = COUNT) -> Gaussians:
    """Gaussians of every size before the cameras, some coincident, some in two at the same depth."""
    random = torch.Generator().manual_seed(seed)
    means = torch.randn(count, 3, generator=random) * torch.tensor([1.5, 1.2, 0.6]) + torch.tensor([0.0, 0.0, 4.0])
    means[:40] = means[40:80]
    return Gaussians(
        means=means,
        quats=torch.randn(count, 4, generator=random),
        scales=torch.exp(0.8 * torch.randn(count, 3, generator=random) - 2.5),
        opacities=torch.rand(count, generator=random),
        sh=torch.zeros(count, 1, 3),
    )


def camera(x: float, width: int = 100, height: int = 70) -> Camera:
    pose = torch.eye(4)
    pose[0, 3] = x
    K = torch.tensor([[60.0, 0.0, width / 2 + 4], [0.0, 61.0, height / 2 - 3], [0.0, 0.0, 1.0]])
    return Camera(K, pose, width, height)


CAMERAS = [camera(-0.5), camera(0.4), camera(0.1, 64, 48)]


def label_maps(seed: int, labels: int = 5, scale: int = 1) -> list[FeatureMap]:
    random = torch.Generator().manual_seed(seed)
    maps = []
    for one in CAMERAS:
        blocks = torch.randint(-1, labels, (12, 15), generator=random)
        ids = blocks.repeat_interleave(9, 0).repeat_interleave(9, 1)[: one.height // scale, : one.width // scale]
        maps.append(FeatureMap("labels", ids=ids, labels=tuple(map(str, range(labels)))))
    return maps


def vector_maps(seed: int, channels: int = 20) -> list[FeatureMap]:
    random = torch.Generator().manual_seed(seed)
    maps = []
    for plain in label_maps(seed):
        ids = torch.stack([plain.ids[0], plain.ids[0].flip(0)])  # two levels
        maps.append(FeatureMap("toy", ids=ids, vectors=torch.randn(5, channels, generator=random)))
    return maps


def in_full(gaussians: Gaussians, maps: list[FeatureMap]) -> LiftSums:
    sums = LiftSums.zeros(len(gaussians), maps[0].channels)
    for one, feature_map in zip(CAMERAS, maps, strict=True):
        lift_view(gaussians, one, feature_map, sums)
    return sums


def step(lift: IncrementalLift, gaussians: Gaussians, maps: list[FeatureMap]) -> LiftSums:
    lift.begin(gaussians)
    for number, (one, feature_map) in enumerate(zip(CAMERAS, maps, strict=True)):
        lift.add(str(number), one, feature_map)
    return lift.finish()


def assert_same_bits(found: LiftSums, wanted: LiftSums) -> None:
    assert torch.equal(found.features, wanted.features)
    assert torch.equal(found.weight, wanted.weight)
    assert torch.equal(found.weight_squared, wanted.weight_squared)


def moved(gaussians: Gaussians, rows: slice, by: float) -> Gaussians:
    means = gaussians.means.clone()
    means[rows] += torch.tensor([by, -by, 0.5 * by])
    return replace(gaussians, means=means)


@pytest.mark.parametrize("make", [label_maps, vector_maps])
def test_moving_gaussians(make):
    lift, gaussians, maps = IncrementalLift(), cloud(0), make(1)
    assert_same_bits(step(lift, gaussians, maps), in_full(gaussians, maps))
    for rows in (slice(0, 0), slice(7, 8), slice(0, 60), slice(100, 350)):
        gaussians = moved(gaussians, rows, 0.3)
        assert_same_bits(step(lift, gaussians, maps), in_full(gaussians, maps))
        assert lift.work.changed == rows.stop - rows.start
        assert lift.work.projections == len(CAMERAS) * lift.work.changed
        assert not lift.work.direct


@pytest.mark.parametrize("make", [label_maps, vector_maps])
def test_changing_maps(make):
    lift, gaussians = IncrementalLift(), cloud(2)
    step(lift, gaussians, make(3))
    maps = make(3)
    maps[1] = make(4)[1]
    assert_same_bits(step(lift, gaussians, maps), in_full(gaussians, maps))
    assert 0 < lift.work.tiles <= 35  # of the one view


def test_one_pixel_wakes_one_tile():
    lift, gaussians, maps = IncrementalLift(), cloud(2), label_maps(3)
    step(lift, gaussians, maps)
    ids = maps[0].ids.clone()
    ids[0, 20, 50] = (ids[0, 20, 50] + 1) % 5
    maps[0] = replace(maps[0], ids=ids)
    assert_same_bits(step(lift, gaussians, maps), in_full(gaussians, maps))
    assert lift.work.tiles == 1


def test_maps_smaller_than_the_image():
    lift, gaussians = IncrementalLift(), cloud(2)
    step(lift, gaussians, label_maps(3, scale=2))
    maps = label_maps(3, scale=2)
    maps[0].ids[0, 5:8, 7] = 4
    gaussians = moved(gaussians, slice(3, 5), 0.1)
    assert_same_bits(step(lift, gaussians, maps), in_full(gaussians, maps))


def test_a_still_frame_does_nothing():
    lift, gaussians, maps = IncrementalLift(), cloud(5), label_maps(6)
    before = step(lift, gaussians, maps).features.clone()
    copies = [replace(one, ids=one.ids.clone()) for one in maps]
    after = step(lift, replace(gaussians, means=gaussians.means.clone()), copies)
    assert torch.equal(after.features, before)
    work = lift.work
    assert (work.changed, work.projections, work.tiles, work.affected) == (0, 0, 0, 0)
    assert work.left_out == 1.0
    assert work.all_tiles == 35 + 35 + 12


def test_gaussians_that_leave_come_back_or_turn_into_nan():
    lift, start, maps = IncrementalLift(), cloud(7), label_maps(8)
    step(lift, start, maps)
    away, opacities = start.means.clone(), start.opacities.clone()
    away[10:20, 2] = -5.0  # behind the cameras
    away[30] = torch.nan
    away[31] = 1e4
    opacities[50:60] = 0.0
    changed = replace(start, means=away, opacities=opacities)
    assert_same_bits(step(lift, changed, maps), in_full(changed, maps))
    assert_same_bits(step(lift, changed, maps), in_full(changed, maps))
    assert lift.work.changed == 0  # NaN is the same as itself
    assert_same_bits(step(lift, start, maps), in_full(start, maps))
    assert lift.work.changed == 22


def test_colors_that_turn_into_nan_hide_a_gaussian():
    lift, gaussians, maps = IncrementalLift(), cloud(7), label_maps(8)
    step(lift, gaussians, maps)
    sh = gaussians.sh.clone()
    sh[5] = torch.inf
    gaussians = replace(gaussians, sh=sh)
    assert_same_bits(step(lift, gaussians, maps), in_full(gaussians, maps))
    assert lift.work.changed == 1


def test_views_come_and_go():
    lift, gaussians, maps = IncrementalLift(), cloud(9), label_maps(10)
    step(lift, gaussians, maps)
    gaussians = moved(gaussians, slice(0, 9), 0.2)
    for chosen in ([0, 2], [0, 1, 2], [2], [2, 1, 0]):
        lift.begin(gaussians)
        wanted = LiftSums.zeros(len(gaussians), 5)
        for number in chosen:
            lift.add(str(number), CAMERAS[number], maps[number])
            lift_view(gaussians, CAMERAS[number], maps[number], wanted)
        assert_same_bits(lift.finish(), wanted)


def test_a_frame_without_views_and_one_without_gaussians():
    lift, gaussians, maps = IncrementalLift(), cloud(9), label_maps(10)
    step(lift, gaussians, maps)
    lift.begin(gaussians)
    sums = lift.finish()
    assert not bool(sums.weight.any())
    assert not bool(sums.features.any())
    nothing = gaussians.subset(torch.empty(0, dtype=torch.int64))
    assert len(step(lift, nothing, maps).weight) == 0
    assert_same_bits(step(lift, gaussians, maps), in_full(gaussians, maps))


def test_a_camera_that_moves():
    lift, gaussians, maps = IncrementalLift(), cloud(11), label_maps(12)
    step(lift, gaussians, maps)
    other = camera(0.7)
    lift.begin(gaussians)
    wanted = LiftSums.zeros(len(gaussians), 5)
    for number, one in enumerate([CAMERAS[0], other, CAMERAS[2]]):
        lift.add(str(number), one, maps[number])
        lift_view(gaussians, one, maps[number], wanted)
    assert_same_bits(lift.finish(), wanted)
    assert lift.work.tiles == 35


def test_ids_that_appear_later():
    lift, gaussians = IncrementalLift(), cloud(13)
    step(lift, gaussians, label_maps(14, labels=3))
    maps = label_maps(14, labels=40)
    assert_same_bits(step(lift, gaussians, maps), in_full(gaussians, maps))
    with pytest.raises(InputError, match="3 channels, those before it 40"):
        step(lift, gaussians, label_maps(14, labels=3))


def test_everything_moves_and_dense_maps_are_lifted_in_full():
    lift, gaussians, maps = IncrementalLift(), cloud(15), label_maps(16)
    step(lift, gaussians, maps)
    gaussians = moved(gaussians, slice(0, COUNT), 0.1)
    assert_same_bits(step(lift, gaussians, maps), in_full(gaussians, maps))
    assert lift.work.direct
    assert lift.kept_bytes == 0
    lift.begin(gaussians)
    lift.add("2", CAMERAS[2], maps[2])
    wanted = LiftSums.zeros(COUNT, 5)
    lift_view(gaussians, CAMERAS[2], maps[2], wanted)
    assert_same_bits(lift.finish(), wanted)
    gaussians = moved(gaussians, slice(0, 20), 0.1)  # kept again
    assert_same_bits(step(lift, gaussians, maps), in_full(gaussians, maps))
    assert not lift.work.direct
    assert lift.kept_bytes > 0
    gaussians = moved(gaussians, slice(0, 20), 0.1)
    assert_same_bits(step(lift, gaussians, maps), in_full(gaussians, maps))
    assert lift.work.left_out > 0.1
    random = torch.Generator().manual_seed(1)
    dense = [FeatureMap("toy", dense=torch.rand(*one.size, 5, generator=random)) for one in CAMERAS]
    assert_same_bits(step(lift, gaussians, dense), in_full(gaussians, dense))
    assert lift.work.direct


def test_any_number_of_threads():
    before = get_threads()
    results = []
    try:
        for threads in (1, 2, 5):
            set_threads(threads)
            lift, gaussians, maps = IncrementalLift(), cloud(17), vector_maps(18)
            step(lift, gaussians, maps)
            results.append(step(lift, moved(gaussians, slice(0, 100), 0.2), maps))
    finally:
        set_threads(before)
    for other in results[1:]:
        assert_same_bits(other, results[0])


def test_misuse():
    lift, gaussians, maps = IncrementalLift(), cloud(0), label_maps(1)
    with pytest.raises(InputError, match="begin"):
        lift.finish()
    lift.begin(gaussians)
    lift.add("0", CAMERAS[0], maps[0])
    with pytest.raises(InputError, match="added to this frame before"):
        lift.add("0", CAMERAS[0], maps[0])
