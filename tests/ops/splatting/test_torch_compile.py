"""Rendering inside a function that torch.compile takes: one break of the graph, and the same bits."""

import pytest
import torch

import sgwarp as sg
from sgwarp.compat.gsplat import rasterization

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]  # torch's compiler warns of its own doings


def test_the_graph_breaks_once_around_a_rendering(make_scene):
    gaussians, camera = make_scene("random_cloud")[1:]
    fields = gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities

    def loss(features):
        image = sg.rasterize(*fields, camera.world_to_camera, camera.K, camera.width, camera.height, features=features)
        return (image.features.sin() * 2.0).sum()

    def facade(features):
        pose, K = camera.world_to_camera.float()[None], camera.K.float()[None]
        image, _, _ = rasterization(*fields, features, pose, K, camera.width, camera.height)
        return image.square().sum()

    graphs = []

    def backend(graph, inputs):
        graphs.append(graph)
        return graph.forward

    for function in (loss, facade):
        plain, compiled = (
            torch.rand(len(gaussians), 5, generator=torch.Generator().manual_seed(0)).requires_grad_() for _ in range(2)
        )
        expected = function(plain)
        expected.backward()
        graphs.clear()
        found = torch.compile(function, backend=backend)(compiled)
        found.backward()
        assert torch.equal(found, expected)
        assert torch.equal(compiled.grad, plain.grad)
        assert 1 <= len(graphs) <= 2  # before and after the rendering
