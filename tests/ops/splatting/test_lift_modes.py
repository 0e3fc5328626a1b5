"""Squared and strongest-contributor lifting against the dense matrix A of alpha T in float64."""

import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.ops.reference.rasterizer import ReferenceSettings, blend_blocks, project_scene
from sgwarp.ops.splatting import id_weights, tiles
from sgwarp.ops.splatting.lifting import LiftSums, add_weighted, lift_view
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.scene import FeatureMap

SCENES = ("random_cloud", "odd_size", "needles")


def dense_matrix(gaussians, camera) -> torch.Tensor:
    """A of a view, float64 [H W, N]."""
    projection = project_scene(gaussians, camera)
    A = torch.zeros(camera.height * camera.width, len(gaussians), dtype=torch.float64)
    for blend in blend_blocks(projection, camera.width, camera.height, ReferenceSettings()):
        rows, columns = blend.pixels, projection.index[blend.rows]
        A[rows[:, None], columns[None]] += blend.weights
    return A


def map_of(camera, kind: str) -> tuple[FeatureMap, torch.Tensor, torch.Tensor]:
    """A feature map, and its features and validity at the pixels, float64 [H W, C] and [H W]."""
    noise = torch.Generator().manual_seed(3)
    if kind == "dense":
        dense = torch.randn(*camera.size, 20, generator=noise)
        valid = torch.rand(camera.size, generator=noise) > 0.2
        return FeatureMap("t", dense=dense, valid=valid), dense.double().flatten(0, 1), valid.double().flatten()
    ids = torch.randint(-1, 12, (1, *camera.size), generator=noise)
    ids[:, : camera.height // 2] = ids[:, :1, :1]  # tiles of one id
    vectors = torch.randn(12, 20, generator=noise) if kind == "ids" else None
    labels = tuple(map(str, range(12))) if kind == "labels" else None
    table = torch.eye(12) if vectors is None else vectors
    held = (ids[0] >= 0).flatten()
    return FeatureMap("t", ids=ids, vectors=vectors, labels=labels), table.double()[ids[0].flatten()], held.double()


def assert_close(sums: LiftSums, weights: torch.Tensor, features: torch.Tensor, valid: torch.Tensor) -> None:
    """The sums against weights [H W, N] of the pixels that carry semantics."""
    weights = weights * valid[:, None]
    total = weights.sum(dim=0)
    bound = 1e-5 * float(total.max())
    torch.testing.assert_close(sums.weight.double(), total, atol=bound, rtol=1e-4)
    torch.testing.assert_close(sums.features.double(), weights.T @ features, atol=4 * bound, rtol=1e-4)
    torch.testing.assert_close(sums.weight_squared.double(), total.square(), atol=bound, rtol=1e-3)


@pytest.mark.parametrize("kind", ["dense", "ids", "labels"])
@pytest.mark.parametrize("name", SCENES)
def test_squared_weights(make_scene, name, kind):
    _, gaussians, camera = make_scene(name)
    found, features, valid = map_of(camera, kind)
    sums = LiftSums.zeros(len(gaussians), found.channels)
    lift_view(gaussians, camera, found, sums, mode="squared")
    assert_close(sums, dense_matrix(gaussians, camera).square(), features, valid)


@pytest.mark.parametrize("ordered", [True, False])
@pytest.mark.parametrize("kind", ["dense", "ids"])
@pytest.mark.cpu_only("the block schedule on CPU fibers")
def test_squared_weights_in_blocks(make_scene, kind, ordered):
    _, gaussians, camera = make_scene("odd_size")
    found, features, valid = map_of(camera, kind)
    sums = LiftSums.zeros(len(gaussians), found.channels)
    projected = tiles.project(gaussians, camera, RasterSettings())
    lists = tiles.bin_splats(projected, tiles.depth_order(projected), None, camera, places=True, tiles=True)
    add_weighted(lists, camera, found, sums, RasterSettings(), block=True, ordered=ordered, squared=True)
    assert_close(sums, dense_matrix(gaussians, camera).square(), features, valid)


@pytest.mark.parametrize("kind", ["dense", "ids", "labels"])
@pytest.mark.parametrize("name", SCENES)
def test_strongest_contributor(make_scene, name, kind):
    _, gaussians, camera = make_scene(name)
    A = dense_matrix(gaussians, camera)
    best, owner = A.max(dim=1)
    second = A.scatter(1, owner[:, None], 0.0).max(dim=1).values
    clear = (best - second > 1e-4 * best) | (best == 0)  # elsewhere rounding decides
    found, features, valid = map_of(camera, kind)
    one = torch.zeros_like(A).scatter(1, owner[:, None], best[:, None])
    sums = LiftSums.zeros(len(gaussians), found.channels)
    if found.dense is not None:
        found = FeatureMap("t", dense=found.dense, valid=found.valid & clear.view(camera.size))
    else:
        found = FeatureMap(
            "t", ids=found.ids.where(clear.view(camera.size), -1), vectors=found.vectors, labels=found.labels
        )
    lift_view(gaussians, camera, found, sums, mode="strongest")
    assert_close(sums, one, features, valid * clear)


def test_more_weights_than_int32_counts_are_refused(make_scene, monkeypatch):
    """Not wrapped around; the limit is lowered here, since 2^31 weights are 8 GiB."""
    _, gaussians, camera = make_scene("sh3")
    ids = torch.zeros(1, *camera.size, dtype=torch.int32)
    feature_map = FeatureMap("s", ids=ids, labels=("a",))
    monkeypatch.setattr(id_weights, "MOST_WEIGHTS", 10)
    with pytest.raises(InputError, match="weights of splats and the ids of their tiles exceed 10"):
        lift_view(gaussians, camera, feature_map, LiftSums.zeros(len(gaussians), 1))
    starts = id_weights.first_weights(torch.tensor([0, 2**23, 2**24], dtype=torch.int32), torch.tensor([256, 256]))
    assert starts.tolist() == [0, 2**31, 2**32]
