import math

import pytest
import torch

from sgwarp.compat import gsplat
from sgwarp.errors import InputError


def test_relocation_is_the_paper_s_sum():
    """Equation 9 of Kheradmand et al. 2024, written out in Python floats."""
    n_max = 51
    binoms = torch.zeros(n_max, n_max)
    for n in range(n_max):
        for k in range(n + 1):
            binoms[n, k] = math.comb(n, k)
    opacities, ratios = torch.tensor([0.1, 0.5, 0.9, 0.3, 0.7]), torch.tensor([1, 2, 5, 12, 400])
    scales = torch.rand(5, 3) + 0.1
    new_opacities, new_scales = gsplat.compute_relocation(opacities, scales, ratios, binoms)
    for i, (opacity, ratio) in enumerate(zip(opacities.tolist(), ratios.tolist(), strict=True)):
        copies = min(ratio, n_max)
        shared = 1 - (1 - opacity) ** (1 / copies)
        total = 0.0
        for j in range(1, copies + 1):
            for k in range(j):
                total += math.comb(j - 1, k) * (-1) ** k / math.sqrt(k + 1) * shared ** (k + 1)
        assert new_opacities[i].item() == pytest.approx(shared, rel=1e-5)
        assert new_scales[i].tolist() == pytest.approx((scales[i] * opacity / total).tolist(), rel=1e-4)
    assert torch.allclose(new_scales[0], scales[0])
    with pytest.raises(InputError, match=r"scales: expected shape \[5, 3\]"):
        gsplat.compute_relocation(opacities, scales[:2], ratios, binoms)


@pytest.mark.parametrize("name", ["rasterization_2dgs", "rasterize_to_pixels_2dgs", "fully_fused_projection_2dgs"])
def test_2d_gaussians_say_what_there_is_instead(name):
    with pytest.raises(InputError, match=rf"{name}: 2D Gaussians .* flat 3D Gaussians"):
        getattr(gsplat, name)(None, quats=None)


@pytest.mark.parametrize("kind", [torch.float16, torch.bfloat16])
def test_half_precision_is_computed_in_float32(kind):
    rng = torch.Generator().manual_seed(0)
    means = (torch.rand(30, 3, generator=rng) - 0.5).to(kind)
    quats = torch.randn(30, 4, generator=rng).to(kind)
    scales = torch.full((30, 3), 0.1).to(kind).requires_grad_()
    opacities, colors = torch.full((30,), 0.7).to(kind), torch.rand(30, 3, generator=rng).to(kind)
    pose = torch.eye(4)
    pose[2, 3] = 3.0
    K = torch.tensor([[40.0, 0, 16], [0, 40.0, 12], [0, 0, 1]])
    given = (means, quats, scales, opacities, colors, pose[None].to(kind), K[None].to(kind))
    image, alpha, _ = gsplat.rasterization(*given, 32, 24)
    wide, _, _ = gsplat.rasterization(*(t.detach().float() for t in given), 32, 24)
    assert (image.dtype, alpha.dtype) == (torch.float32, torch.float32)
    assert torch.equal(image, wide)
    image.sum().backward()
    assert scales.grad.dtype == kind
    assert scales.grad.abs().max() > 0
