"""The oracle of a pixel's strongest contributors, on Gaussians whose weights are known in closed form."""

import pytest
import torch

from sgwarp.ops.reference.contributors import top_contributors
from sgwarp.scene import Camera, Gaussians

OPACITIES = (0.2, 0.5, 0.9)  # from front to back
WEIGHTS = (0.2, 0.8 * 0.5, 0.8 * 0.5 * 0.9)


@pytest.fixture
def scene():
    """Three wide Gaussians behind one another, given from back to front, and a tiny one behind the first pixel."""
    means = torch.tensor([[0.0, 0.0, 4.0], [0.0, 0.0, 3.0], [0.0, 0.0, 2.0], [-0.2, -0.1, 5.0]])
    quats, scales = torch.tensor([[1.0, 0, 0, 0]]).expand(4, 4), torch.full((4, 3), 30.0)
    scales[3] = 0.001
    opacities = torch.tensor([*OPACITIES[::-1], 0.9])
    K = torch.tensor([[50.0, 0.0, 2.5], [0.0, 50.0, 1.5], [0.0, 0.0, 1.0]])
    return Gaussians(means, quats, scales, opacities, torch.zeros(4, 1, 3)), Camera(K, torch.eye(4), 5, 3)


@pytest.mark.parametrize("k", [1, 2, 3, 6])
def test_weights_in_closed_form(scene, k):
    found = top_contributors(*scene, k)
    order = sorted(range(3), key=lambda place: -WEIGHTS[place])
    ids = [2 - place for place in order] + [-1] * 3
    weights = [WEIGHTS[place] for place in order] + [0.0] * 3
    assert found.ids.shape == (3, 5, k)
    assert found.ids[1, 2].tolist() == ids[:k]
    assert found.weights[1, 2].tolist() == pytest.approx(weights[:k], abs=1e-7)
    expected = torch.full((3, 5), 3)
    expected[0, 0] = 4
    far = torch.ones(3, 5, dtype=torch.bool)
    far[:2, :2], far[0, 0] = False, True  # the neighbors of the first pixel see a little of the tiny one
    assert torch.equal(found.contributors[far], expected[far])
    ranked = [WEIGHTS[place] for place in order]
    gaps = [(one - other) / one for one, other in zip(ranked, [*ranked[1:], 0.0], strict=True)]
    assert found.gap[1, 2].item() == pytest.approx(min(gaps[:k]), abs=1e-6)


def test_an_empty_pixel_has_no_contributors(scene):
    gaussians, camera = scene
    found = top_contributors(gaussians.subset(torch.tensor([3])), camera, 2)
    assert found.contributors[0, 0] == 1
    away = (slice(None), slice(3, None))
    assert bool((found.contributors[away] == 0).all())
    assert bool((found.ids[away] == -1).all())
    assert bool((found.weights[away] == 0).all())
