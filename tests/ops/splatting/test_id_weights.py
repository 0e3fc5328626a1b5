"""Id weights as a sparse matrix: against the float64 transpose, in both schedules, for any number of ids."""

import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.ops import launcher
from sgwarp.ops.reference import lifting as reference
from sgwarp.ops.splatting.id_weights import _lists, pair_up, weigh_pairs
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.scene import Camera

SETTINGS = RasterSettings()


def random_ids(camera: Camera, count: int, cell: int = 5) -> torch.Tensor:
    """Patches of `cell` pixels with ids from -1 to count - 1, so that a tile holds several."""
    height, width = (-(-side // cell) for side in camera.size)
    coarse = torch.randint(-1, count, (height, width), generator=torch.Generator().manual_seed(count))
    return coarse.repeat_interleave(cell, 0).repeat_interleave(cell, 1)[: camera.height, : camera.width]


def dense(pairs: tuple[torch.Tensor, ...], rows: int, columns: int) -> torch.Tensor:
    gaussian, name, weight = pairs
    keys = gaussian.long() * columns + name
    assert len(keys.unique()) == len(keys), "a pair occurs twice"
    assert bool((weight > 0).all())
    return torch.zeros(rows, columns).index_put((gaussian.long(), name.long()), weight)


@pytest.mark.parametrize("count", [1, 7, 300])
def test_pairs_are_the_transpose(make_scene, count):
    for name in ("random_cloud", "odd_size", "needles"):
        _, gaussians, camera = make_scene(name)
        ids = random_ids(camera, count)
        one_hot = torch.nn.functional.one_hot(ids.clamp(min=0), count).double() * (ids >= 0)[..., None]
        expected = reference.lift_weighted(gaussians, camera, one_hot).features
        found = dense(weigh_pairs(gaussians, camera, ids), len(gaussians), count)
        torch.testing.assert_close(found.double(), expected, rtol=1e-4, atol=2e-5 * float(expected.max()))


def test_both_schedules_agree(make_scene):
    _, gaussians, camera = make_scene("random_cloud")
    ids = random_ids(camera, 20)
    both = [
        dense(pair_up(_lists(gaussians, camera, SETTINGS), camera, ids, SETTINGS, block=block), len(gaussians), 20)
        for block in (False, True)
    ]
    torch.testing.assert_close(*both, rtol=1e-4, atol=1e-5)


def test_any_number_of_threads_gives_the_same_bits(make_scene):
    _, gaussians, camera = make_scene("random_cloud")
    ids = random_ids(camera, 20)
    before = launcher.get_threads()
    try:
        results = []
        for threads in (1, 2):
            launcher.set_threads(threads)
            results.append(weigh_pairs(gaussians, camera, ids))
    finally:
        launcher.set_threads(before)
    for one, other in zip(*results, strict=True):
        assert torch.equal(one, other)


def test_an_empty_view_has_no_pairs(make_scene):
    _, gaussians, camera = make_scene("random_cloud")
    away = Camera(camera.K, camera.world_to_camera, camera.width, camera.height, near=1e6, far=1e7)
    assert [len(part) for part in weigh_pairs(gaussians, away, random_ids(camera, 3))] == [0, 0, 0]


def test_ids_must_be_integers(make_scene):
    _, gaussians, camera = make_scene("random_cloud")
    with pytest.raises(InputError, match="ids: expected integers"):
        weigh_pairs(gaussians, camera, torch.zeros(camera.size))
