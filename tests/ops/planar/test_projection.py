"""Projection in torch: every camera model against its linearisation by autograd, gradients against differences."""

import math

import numpy as np
import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.ops.planar.harmonics import harmonics_basis
from sgwarp.ops.planar.projection import ProjectionSettings, project_splats, select_rows
from sgwarp.ops.reference import rasterizer as reference

K = torch.tensor([[90.0, 0.0, 30.0], [0.0, 80.0, 25.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
SIZE = (64, 48)


def image_point(model, p):
    """Pixel of a camera point, written as each camera model is defined."""
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    if model == "ortho":
        x, y = p[0] * 0.1, p[1] * 0.1
    elif model == "pinhole":
        x, y = p[0] / p[2], p[1] / p[2]
    else:
        r = torch.hypot(p[0], p[1])
        theta = torch.atan2(r, p[2])
        x, y = theta * p[0] / r, theta * p[1] / r
    return torch.stack([fx * x + cx, fy * y + cy])


def gaussians(n=40):
    rng = torch.Generator().manual_seed(3)
    means = torch.rand(n, 3, generator=rng, dtype=torch.float64)
    means = means * torch.tensor([1.4, 1.2, 4.0]) - torch.tensor([0.6, 0.5, -1.5])
    quats = torch.randn(n, 4, generator=rng, dtype=torch.float64)
    scales = torch.rand(n, 3, generator=rng, dtype=torch.float64) * 0.2 + 0.01
    return means, quats, scales


def intrinsics(model):
    """Those that `image_point` means."""
    scaled = K.clone()
    scaled[[0, 1], [0, 1]] *= 0.1
    return scaled if model == "ortho" else K


@pytest.mark.parametrize("model", ["pinhole", "ortho", "fisheye"])
def test_linearisation_is_the_models_jacobian(model):
    means, quats, scales = gaussians()
    settings = ProjectionSettings(model, dilation=0.2)
    p = project_splats(means, torch.eye(4), intrinsics(model), *SIZE, settings, quats=quats, scales=scales)
    assert len(p.index) > 20
    R = reference.rotation_matrices(quats) * scales[:, None]
    for row, i in enumerate(p.index.tolist()):
        torch.testing.assert_close(p.means2d[row], image_point(model, means[i]), rtol=1e-9, atol=1e-9)
        J = torch.autograd.functional.jacobian(lambda q: image_point(model, q), means[i])
        cov = J @ R[i] @ R[i].T @ J.T + 0.2 * torch.eye(2, dtype=torch.float64)
        xx, xy, yy = p.covariances[row]
        torch.testing.assert_close(torch.stack([xx, xy, xy, yy]), cov.flatten(), rtol=1e-8, atol=1e-8)
        a, b, c = p.factors[row]
        L = torch.tensor([[a, 0.0], [b, c]], dtype=torch.float64)
        torch.testing.assert_close(L @ L.T, 0.5 * math.log2(math.e) * torch.linalg.inv(cov), rtol=1e-8, atol=1e-10)
        A, B, C = p.conics[row]
        torch.testing.assert_close(torch.stack([A, B, B, C]), torch.linalg.inv(cov).flatten(), rtol=1e-8, atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("given", ["quats", "covars"])
@pytest.mark.parametrize("model", ["pinhole", "ortho", "fisheye"])
def test_gradients(model, given):
    """Central differences in float64, of everything that comes out with respect to everything that goes in."""
    means, quats, scales = gaussians(8)
    axes = reference.rotation_matrices(quats) * scales[:, None]
    shape = (quats, scales) if given == "quats" else (axes @ axes.transpose(1, 2),)
    settings = ProjectionSettings(model, compensated=True)

    def run(means, world_to_camera, *shape):
        named = dict(zip(("quats", "scales"), shape, strict=True)) if given == "quats" else {"covars": shape[0]}
        p = project_splats(means, world_to_camera, intrinsics(model), *SIZE, settings, **named)
        return p.means2d, p.depths, p.conics, p.factors, p.compensations

    inputs = [t.clone().requires_grad_() for t in (means, torch.eye(4, dtype=torch.float64), *shape)]
    assert len(run(*inputs)[0]) >= 5
    assert torch.autograd.gradcheck(run, inputs, atol=1e-5, rtol=1e-4)


def test_fisheye_on_and_near_the_axis():
    """No seam and no 0 / 0 where the series takes over, neither in values nor in gradients."""
    x = torch.tensor([0.0, 1e-8, 1e-4, 0.1, 0.19999, 0.20001, 0.5], dtype=torch.float64)
    means = torch.stack([x * 2, x * 0, x * 0 + 2.0], 1).requires_grad_()
    quats = torch.tensor([[1.0, 0.2, -0.1, 0.3]], dtype=torch.float64).expand(len(x), 4)
    scales = torch.tensor([[0.1, 0.2, 0.3]], dtype=torch.float64).expand(len(x), 3)
    p = project_splats(means, torch.eye(4), K, *SIZE, ProjectionSettings("fisheye"), quats=quats, scales=scales)
    assert len(p.index) == len(x)
    torch.testing.assert_close(p.means2d[:, 0], 90.0 * x.atan() + 30.0, rtol=1e-10, atol=1e-10)
    (grad,) = torch.autograd.grad(p.conics.sum(), means)
    assert torch.isfinite(grad).all()
    slope = (p.conics[5] - p.conics[4]) / (means[5, 0] - means[4, 0])
    torch.testing.assert_close(slope.sum(), grad[4, 0], rtol=1e-3, atol=1e-9)


def test_what_cannot_be_seen_is_left_out():
    means, quats, scales = (t.float() for t in gaussians(10))
    opacities = torch.full((10,), 0.5)
    means[0, 2], means[1, 2], means[2, 0] = -1.0, 50.0, 100.0
    means[3, 1], quats[4], scales[5, 1] = math.nan, 0.0, math.inf
    opacities[6], scales[7] = 0.003, 0.0
    settings = ProjectionSettings(near=0.1, far=40.0)
    p = project_splats(means, torch.eye(4), K, *SIZE, settings, quats=quats, scales=scales, opacities=opacities)
    assert p.index.tolist() == [7, 8, 9]
    torch.testing.assert_close(p.covariances[0], torch.tensor([0.3, 0.0, 0.3]))


def test_settings_are_checked():
    with pytest.raises(InputError, match="camera_model"):
        ProjectionSettings("spherical")
    with pytest.raises(InputError, match="near_plane"):
        ProjectionSettings(near=2.0, far=1.0)


@pytest.mark.parametrize("sparse", [False, True])
def test_selected_rows_hand_their_gradient_back(sparse):
    values = torch.arange(12.0).view(4, 3).requires_grad_()
    rows = select_rows(values, torch.tensor([0, 2]), sparse)
    assert torch.equal(rows, values[[0, 2]])
    (rows * torch.tensor([[1.0], [5.0]])).sum().backward()
    assert values.grad.is_sparse == sparse
    dense = values.grad.to_dense() if sparse else values.grad
    assert torch.equal(dense, torch.tensor([[1.0], [0], [5], [0]]).expand(4, 3))


def test_harmonics_match_the_oracle_and_are_orthonormal():
    rng = torch.Generator().manual_seed(1)
    directions = torch.nn.functional.normalize(torch.randn(50, 3, generator=rng, dtype=torch.float64), dim=1)
    torch.testing.assert_close(harmonics_basis(directions, 3), reference.harmonics(directions, 3), rtol=0, atol=1e-12)
    # Exact quadrature on the sphere: Gauss-Legendre in z, equal steps in longitude.
    z, weight = (torch.tensor(t) for t in np.polynomial.legendre.leggauss(8))
    phi = torch.arange(16, dtype=torch.float64) * (2 * math.pi / 16)
    r = (1 - z * z).sqrt()
    points = torch.stack([r[:, None] * phi.cos(), r[:, None] * phi.sin(), z[:, None].expand(8, 16)], -1).view(-1, 3)
    basis = harmonics_basis(points, 4)
    area = (weight[:, None] * torch.full((16,), 2 * math.pi / 16, dtype=torch.float64)).reshape(-1, 1)
    torch.testing.assert_close(basis.T @ (basis * area), torch.eye(25, dtype=torch.float64), rtol=0, atol=1e-12)
