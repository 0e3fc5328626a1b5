"""NaN and infinity in the arguments of the public operations: refused in one line, or left out."""

import math

import pytest
import torch

import sgwarp as sg
from sgwarp.errors import InputError

BAD = [math.nan, math.inf]
N = 12
FIELDS = ("means", "quats", "scales", "sh")


def fields() -> dict[str, torch.Tensor]:
    rng = torch.Generator().manual_seed(5)
    return {
        "means": torch.rand(N, 3, generator=rng) - 0.5,
        "quats": torch.randn(N, 4, generator=rng),
        "scales": torch.rand(N, 3, generator=rng) * 0.2 + 0.05,
        "opacities": torch.rand(N, generator=rng) * 0.7 + 0.2,
        "sh": torch.rand(N, 4, 3, generator=rng),
    }


def camera() -> sg.Camera:
    pose = torch.eye(4)
    pose[2, 3] = 2.0
    return sg.Camera(torch.tensor([[30.0, 0, 16], [0, 30, 12], [0, 0, 1]]), pose, 32, 24)


def spoiled(values: dict[str, torch.Tensor], name: str, value: float, row: int = 3) -> dict[str, torch.Tensor]:
    changed = values[name].clone()
    changed.view(N, -1)[row, 0] = value
    return values | {name: changed}


@pytest.mark.cpu_only("on CUDA to look is to wait")
@pytest.mark.parametrize("value", BAD)
def test_backgrounds_are_refused(value):
    background = torch.tensor([0.0, value, 0.0])
    with pytest.raises(InputError, match=r"^background: holds NaN or infinity"):
        sg.render(sg.Gaussians(**fields()), camera(), background=background)
    for grad in (True, False):
        values = fields()
        values["means"].requires_grad_(grad)
        with pytest.raises(InputError, match=r"^background: holds NaN or infinity"):
            rasterize(values, background=background)


def rasterize(values, **more):
    view = camera()
    return sg.rasterize(**values, viewmat=view.world_to_camera, K=view.K, width=32, height=24, **more)


@pytest.mark.parametrize("value", BAD)
@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize("features", [False, True])
def test_rows_are_left_out_of_images_and_gradients(name, value, features):
    """Also where colors and features are rendered together: a Gaussian without a color was black there."""
    rng = torch.Generator().manual_seed(6)
    more = {"features": torch.rand(N, 5, generator=rng)} if features else {}

    def run(values, more):
        leaves = {key: tensor.clone().requires_grad_() for key, tensor in values.items()}
        image = rasterize(leaves, **more).features
        (image**2).sum().backward()
        return image, {key: leaf.grad for key, leaf in leaves.items()}

    image, gradients = run(spoiled(fields(), name, value), more)
    kept = torch.arange(N) != 3
    want, right = run(
        {key: tensor[kept] for key, tensor in fields().items()}, {key: tensor[kept] for key, tensor in more.items()}
    )
    torch.testing.assert_close(image, want)
    for key, gradient in gradients.items():
        assert not gradient[3].any()
        torch.testing.assert_close(gradient[kept], right[key])


@pytest.mark.parametrize("value", BAD)
@pytest.mark.parametrize("name", FIELDS)
def test_no_view_of_a_scene_knows_of_such_a_row(name, value):
    scene, rest = (
        sg.Gaussians(**spoiled(fields(), name, value)),
        sg.Gaussians(**{key: tensor[torch.arange(N) != 3] for key, tensor in fields().items()}),
    )
    for mode in ("rgb", "alpha", "depth", "expected_depth"):
        assert torch.equal(sg.render(scene, camera(), mode=mode), sg.render(rest, camera(), mode=mode))
    ids, weights = sg.top_contributors(scene, camera())
    assert not bool((ids == 3).any())
    assert torch.equal(weights, sg.top_contributors(rest, camera())[1])
    pixels = torch.rand(24, 32, 4, generator=torch.Generator().manual_seed(7))
    maps = {"a": sg.FeatureMap("mine", dense=pixels)}
    views = [sg.View("a", camera())]
    for mode in ("weighted", "squared"):
        lifted, plain = sg.lift(scene, views, maps, mode=mode), sg.lift(rest, views, maps, mode=mode)
        assert float(lifted.weight[3]) == 0
        assert torch.equal(lifted.features[torch.arange(N) != 3], plain.features)


def test_harmonics_of_another_number_of_rows_are_refused():
    with pytest.raises(InputError, match=r"^sh: expected shape \[12, "):
        rasterize(fields() | {"sh": torch.rand(N - 1, 4, 3)}, features=torch.rand(N, 2))


@pytest.mark.parametrize("value", BAD)
def test_semantics_are_refused(value):
    from sgwarp.querying.scores import _cosines

    rows = torch.ones(N)
    spoiled_rows = rows.clone()
    spoiled_rows[2] = value
    for name, weight, views in (("weight", spoiled_rows, rows), ("effective_views", rows, spoiled_rows)):
        with pytest.raises(InputError, match=f"^{name}: holds NaN or infinity"):
            sg.Semantics(torch.rand(N, 4), weight, views, "mine", "0")
    features = torch.rand(N, 4)
    features[5, 1] = value
    with pytest.raises(InputError, match=r"^features: of the semantics hold NaN or infinity, first in row 5"):
        _cosines(sg.Semantics(features, rows, rows, "mine", "0"), torch.rand(2, 4))
