"""Voxel keys against integers, kernel maps against a dictionary of voxels."""

import itertools
import math

import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.ops import launcher
from sgwarp.ops.sparse.voxels import (
    LIMIT,
    MARGIN,
    MAX_BATCH,
    coarsen,
    kernel_map,
    key_points,
    pack_voxels,
    unpack_voxels,
)

EDGE = LIMIT - 1


def voxels(count: int, spread: int, seed: int = 0, batches: int = 2) -> torch.Tensor:
    """Sorted unique keys of about `count` voxels around the origin, negative coordinates among them."""
    generator = torch.Generator().manual_seed(seed)
    axes = torch.randint(-spread, spread, (count, 3), generator=generator)
    batch = torch.randint(batches, (count, 1), generator=generator)
    return pack_voxels(torch.cat([batch, axes], dim=1)).unique()


def offsets(side: int, step: int) -> list[tuple[int, int, int]]:
    first = -(side // 2) if side % 2 else 0
    along = [step * (first + i) for i in range(side)]
    return [(x, y, z) for z, y, x in itertools.product(along, repeat=3)]


def pairs_by_dictionary(sources, targets, side: int, step: int) -> list[set[tuple[int, int]]]:
    rows = {tuple(voxel): row for row, voxel in enumerate(unpack_voxels(sources).tolist())}
    found = []
    for dx, dy, dz in offsets(side, step):
        reached = [rows.get((b, x + dx, y + dy, z + dz)) for b, x, y, z in unpack_voxels(targets).tolist()]
        found.append({(source, target) for target, source in enumerate(reached) if source is not None})
    return found


def pairs_of(map_) -> list[set[tuple[int, int]]]:
    found = []
    for k in range(map_.offsets):
        part = slice(map_.starts[k], map_.starts[k + 1])
        pairs = list(zip(map_.sources[part].tolist(), map_.targets[part].tolist(), strict=True))
        assert len(pairs) == len(set(pairs))
        found.append(set(pairs))
    if map_.identity is not None:
        assert not found[map_.identity]
        found[map_.identity] = {(row, row) for row in range(map_.target_count)}
    return found


def test_keys_go_there_and_back_in_lexicographic_order():
    corners = [list(c) for c in itertools.product((0, MAX_BATCH - 1), *[(-EDGE, -1, 0, EDGE)] * 3)]
    coordinates = torch.tensor(sorted(corners))
    keys = pack_voxels(coordinates)
    assert torch.equal(unpack_voxels(keys), coordinates)
    assert bool((keys[1:] > keys[:-1]).all())
    assert int(keys.min()) >= 0


@pytest.mark.parametrize(
    "row", [[0, LIMIT, 0, 0], [0, 0, -LIMIT, 0], [-1, 0, 0, 0], [MAX_BATCH, 0, 0, 0], [0, 0, 0, 2**40]]
)
def test_a_voxel_out_of_range_is_named(row):
    with pytest.raises(InputError, match=r"coordinates\[1\].*move the scene"):
        pack_voxels(torch.tensor([[0, 1, 2, 3], row]))


@pytest.mark.parametrize("bad", [torch.zeros(3, 3, dtype=torch.int64), torch.zeros(3, 4)])
def test_coordinates_of_another_kind_are_refused(bad):
    with pytest.raises(InputError, match=r"integers \[N, 4\]"):
        pack_voxels(bad)


@pytest.mark.parametrize("size", [0.02, 0.3, 7.0])
def test_points_fall_into_the_voxel_that_float64_says(size):
    generator = torch.Generator().manual_seed(1)
    points = 20 * torch.randn(5000, 3, generator=generator)
    points[:100] = torch.round(points[:100] / 0.25) * 0.25  # on faces of voxels
    origin = (-1.25, 0.5, 1.3e3)
    keys = key_points(points, origin, size, batch=5)
    expected = ((points.double() - torch.tensor(origin, dtype=torch.float64)) / size).floor().long()
    inside = (expected.abs() < LIMIT).all(dim=1)
    packed = pack_voxels(torch.cat([torch.full((int(inside.sum()), 1), 5), expected[inside]], dim=1))
    assert torch.equal(keys[inside], packed)
    assert bool((keys[~inside] == -1).all())
    assert bool(inside.all()) == (size > 0.02)


def test_points_that_are_nowhere_have_no_voxel():
    points = torch.zeros(6, 3)
    points[0, 1], points[1, 2], points[2, 0] = math.nan, math.inf, -math.inf
    points[3, 0], points[4, 1] = 1e38, -float(LIMIT)
    assert (key_points(points, (0.0, 0.0, 0.0), 1.0) == -1).tolist() == [True] * 5 + [False]


@pytest.mark.parametrize(("size", "batch"), [(0.0, 0), (math.nan, 0), (math.inf, 0), (1.0, MAX_BATCH), (1.0, -1)])
def test_a_voxel_size_or_batch_that_cannot_be_is_refused(size, batch):
    with pytest.raises(InputError, match="voxel size above 0"):
        key_points(torch.zeros(1, 3), (0.0, 0.0, 0.0), size, batch)


@pytest.mark.parametrize("stride", [2, 4, 16])
def test_coarser_voxels_are_floors_in_absolute_coordinates(stride):
    keys = voxels(500, 50)
    expected = unpack_voxels(keys)
    expected[:, 1:] = torch.div(expected[:, 1:], stride, rounding_mode="floor") * stride
    assert torch.equal(coarsen(keys, stride), pack_voxels(expected).unique())


@pytest.mark.parametrize(("side", "step"), [(3, 1), (5, 1), (3, 2), (1, 1), (2, 1), (3, 16)])
@pytest.mark.parametrize("count", [1, 7, 700])
def test_maps_without_stride_are_those_of_a_dictionary(side, step, count):
    keys = voxels(count, 6 * step)
    assert pairs_of(kernel_map(keys, keys, side, step)) == pairs_by_dictionary(keys, keys, side, step)


@pytest.mark.parametrize("side", [2, 3])
def test_maps_with_stride_and_their_transpose(side):
    keys = voxels(900, 12)
    coarse = coarsen(keys, 2)
    down = kernel_map(keys, coarse, side)
    expected = pairs_by_dictionary(keys, coarse, side, 1)
    assert pairs_of(down) == expected
    assert down.identity is None
    up = down.swapped()
    assert pairs_of(up) == [{(target, source) for source, target in offset} for offset in expected]
    assert (up.source_count, up.target_count) == (len(coarse), len(keys))
    if side == 2:
        assert down.pairs == len(keys)  # every fine voxel lies in exactly one coarse one


def pairs_of_table(map_, by_target: bool) -> list[set[tuple[int, int]]]:
    """(source, target) of each offset, as a table has them."""
    table, mirrored = map_.table(by_target)
    rows = table.flip(0) if mirrored else table
    found = [{(e, row) for row, e in enumerate(offset.tolist()) if e >= 0} for offset in rows]
    return found if by_target else [{(row, e) for e, row in offset} for offset in found]


@pytest.mark.parametrize(("side", "step", "stride"), [(3, 1, 1), (5, 2, 1), (2, 1, 1), (2, 1, 2), (3, 1, 2), (2, 4, 4)])
def test_tables_are_those_of_a_dictionary(side, step, stride):
    """Of the map and of its transpose; a symmetric one has one table for both, read backwards."""
    keys = voxels(300, 5 * step)
    targets = keys if stride == 1 else coarsen(keys, stride)
    map_ = kernel_map(keys, targets, side, step)
    expected = pairs_by_dictionary(keys, targets, side, step)
    turned = [{(target, source) for source, target in offset} for offset in expected]
    for by_target in (True, False):
        assert pairs_of_table(map_, by_target) == expected
        assert pairs_of_table(map_.swapped(), by_target) == turned
    assert len(map_.kept["tables"]) == 2


def test_maps_at_the_border_of_the_range_do_not_wrap_around():
    """A carry into the next field would connect opposite ends of the range."""
    ends = torch.tensor([[0, 0, 0, EDGE], [0, 0, 1, -EDGE], [0, 1, -EDGE, -EDGE], [0, 0, EDGE, EDGE], [1, -EDGE, 0, 0]])
    keys = pack_voxels(ends).unique()
    assert kernel_map(keys, keys, 3, MARGIN).pairs == len(keys)
    assert int((kernel_map(keys, keys, 3, MARGIN).table(by_target=True)[0] >= 0).sum()) == len(keys)
    with pytest.raises(InputError, match="reaches"):
        kernel_map(keys, keys, 5, MARGIN)


def test_far_apart_batches_and_voxels_are_alone():
    keys = pack_voxels(torch.tensor([[0, 0, 0, 0], [2, 0, 0, 0], [2, 2, 0, 0]]))
    assert kernel_map(keys, keys, 3).pairs == 3


def test_maps_of_nothing():
    none, some = voxels(0, 1), voxels(20, 3)
    assert kernel_map(none, none, 3).pairs == 0
    assert kernel_map(some, none, 2).pairs == 0
    assert kernel_map(none, some, 2).pairs == 0


def test_a_map_does_not_depend_on_the_number_of_threads():
    keys = voxels(40_000, 40, batches=1)
    before = launcher.get_threads()
    maps = []
    try:
        for threads in (1, 2, 5):
            launcher.set_threads(threads)
            maps.append(kernel_map(keys, keys, 3))
    finally:
        launcher.set_threads(before)
    for other in maps[1:]:
        assert other.starts == maps[0].starts
        assert torch.equal(other.sources, maps[0].sources)
        assert torch.equal(other.targets, maps[0].targets)
