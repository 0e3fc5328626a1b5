"""Rendering from the strongest contributors against the full rendering and the dense matrix in float64."""

import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.ops.reference.rasterizer import ReferenceSettings, blend_blocks, project_scene
from sgwarp.ops.splatting.forward import rasterize
from sgwarp.rendering.strongest import render_strongest


def dense_matrix(gaussians, camera) -> torch.Tensor:
    """A of a view, float64 [H W, N]."""
    projection = project_scene(gaussians, camera)
    A = torch.zeros(camera.height * camera.width, len(gaussians), dtype=torch.float64)
    for blend in blend_blocks(projection, camera.width, camera.height, ReferenceSettings()):
        A[blend.pixels[:, None], projection.index[blend.rows][None]] += blend.weights
    return A


def test_with_all_contributors_it_is_the_rendering(make_scene):
    _, gaussians, camera = make_scene("odd_size")
    features = torch.randn(len(gaussians), 7, generator=torch.Generator().manual_seed(0))
    full = rasterize(gaussians, camera, features).features
    torch.testing.assert_close(
        render_strongest(gaussians, camera, features, len(gaussians)), full, atol=2e-5, rtol=1e-4
    )


@pytest.mark.parametrize("k", [1, 3])
def test_what_is_left_out_is_the_weight_of_the_others(make_scene, k):
    _, gaussians, camera = make_scene("random_cloud")
    A = dense_matrix(gaussians, camera)
    features = torch.rand(len(gaussians), 3, generator=torch.Generator().manual_seed(0))
    kept = A.topk(k, dim=1).values.sum(dim=1)
    missed = A @ features.double() - render_strongest(gaussians, camera, features, k).double().flatten(0, 1)
    assert (missed.abs() <= (A.sum(dim=1) - kept)[:, None] + 1e-4).all()
    assert missed.abs().max() > 0.01


def test_gradients_are_the_transpose(make_scene):
    _, gaussians, camera = make_scene("odd_size")
    features = torch.randn(len(gaussians), 2, requires_grad=True)
    outer = torch.randn(*camera.size, 2, generator=torch.Generator().manual_seed(1))
    (render_strongest(gaussians, camera, features, len(gaussians)) * outer).sum().backward()
    expected = dense_matrix(gaussians, camera).T @ outer.double().flatten(0, 1)
    torch.testing.assert_close(features.grad.double(), expected, atol=1e-3, rtol=1e-3)


def test_features_of_another_scene_are_refused(make_scene):
    _, gaussians, camera = make_scene("odd_size")
    with pytest.raises(InputError, match="features: expected"):
        render_strongest(gaussians, camera, torch.zeros(3, 2))
