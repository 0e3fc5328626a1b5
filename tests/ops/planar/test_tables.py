"""Projection tables made by kernels against those made in torch, which are tested against gsplat and float64."""

import math
from dataclasses import replace

import pytest
import torch

from sgwarp.ops.planar.harmonics import harmonics_sum
from sgwarp.ops.planar.projection import ProjectionSettings, project_splats
from sgwarp.ops.planar.tables import ShadeTable, read_camera
from sgwarp.scene import Gaussians

COLUMNS = ("means2d", "depths", "conics", "factors", "compensations")


def projected(gaussians, camera, settings, kernels, *, opaque=False, **options):
    fields = (gaussians.means, gaussians.quats, gaussians.scales)
    leaves = [t.detach().clone().requires_grad_() for t in fields]
    leaves.append(camera.world_to_camera.detach().clone().requires_grad_())
    table = project_splats(
        leaves[0],
        leaves[3],
        camera.K,
        camera.width,
        camera.height,
        settings,
        quats=leaves[1],
        scales=leaves[2],
        opacities=None if opaque else gaussians.opacities,
        kernels=kernels,
        **options,
    )
    assert (table.camera is not None) == kernels
    return table, leaves


def gradients(table, leaves, index, weights):
    """Of a random linear functional of all columns, over the rows that both tables have."""
    rows = torch.searchsorted(table.index, index)
    parts = [(name, getattr(table, name)) for name in COLUMNS]
    total = sum((weights[n] * t[rows].double()).sum() for n, t in parts if t is not None)
    return torch.autograd.grad(total, leaves)


@pytest.mark.parametrize("compensated", [False, True])
def test_tables_of_kernels_are_those_of_torch(scene, compensated):
    _, gaussians, camera = scene
    settings = ProjectionSettings(near=camera.near, far=camera.far, compensated=compensated)
    (mine, here), (exact, there) = (projected(gaussians, camera, settings, kernels) for kernels in (True, False))
    index = mine.index[torch.isin(mine.index, exact.index)]
    assert len(index) >= 0.98 * max(len(mine.index), len(exact.index))  # radii are rounded up: a few differ by one
    rows, rows_of_torch = (torch.searchsorted(t.index, index) for t in (mine, exact))
    assert (mine.radii[rows] - exact.radii[rows_of_torch]).abs().max() <= 1
    weights = {}
    for name in (*COLUMNS, "covariances"):
        if getattr(exact, name) is None:
            assert getattr(mine, name) is None
            continue
        got, want = (getattr(t, name).detach()[r].double() for t, r in ((mine, rows), (exact, rows_of_torch)))
        size = want.abs().flatten(1).amax(1) if want.ndim > 1 else want.abs()
        error = (got - want).abs().flatten(1).amax(1) if want.ndim > 1 else (got - want).abs()
        assert (error <= 1e-3 * size + 1e-6).all(), f"{name}: {error.max()}"
        # Each row's share about as large as that of the others.
        noise = torch.randn(want.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
        weights[name] = noise / size.clamp(min=1e-6).reshape(-1, *[1] * (want.ndim - 1))
        if name == "factors":  # what compositing gives: random moments of u^2, u v, v^2
            (a, b, c), (uu, uv, vv) = want.unbind(1), noise.unbind(1)
            weights[name] = torch.stack([(uu - b / c * uv) / a, uv / c, vv / c], dim=1)
        elif name == "conics" and scene.name == "needles":  # whose moments would be differences of large terms
            weights[name] = torch.zeros_like(noise)
    pairs = zip(gradients(mine, here, index, weights), gradients(exact, there, index, weights), strict=True)
    for name, (got, want) in zip(("means", "quats", "scales", "world_to_camera"), pairs, strict=True):
        if name == "world_to_camera":
            got, want = got[None, :3], want[None, :3]
        error, size = ((t.double()).flatten(1).norm(dim=1) for t in (got - want, want))
        bound = 1e-3 * size.clamp(min=0.1 * size[size > 0].median())
        assert (error <= bound).all(), f"{name}: {(error / bound).max():.1f} times its bound"


def test_a_compensation_that_is_held_has_no_gradient(make_scene):
    """Points and lines without area among others, whose opacities are held at half a percent; float64 in torch."""
    _, gaussians, camera = make_scene("random_cloud")
    count = len(gaussians)
    scales = gaussians.scales.clone()
    scales[: count // 3] *= 1e-4
    scales[count // 3 : count // 2, 1:] = 0.0
    gaussians = replace(gaussians, scales=scales, opacities=torch.full((count,), 0.95))
    doubled = Gaussians.unchecked(
        *(getattr(gaussians, name).double() for name in ("means", "quats", "scales", "opacities", "sh"))
    )
    settings = ProjectionSettings(near=0.2, compensated=True, min_area_ratio=2.5e-5)
    (mine, here), (exact, there) = (
        projected(scene, camera, settings, kernels) for scene, kernels in ((gaussians, True), (doubled, False))
    )
    assert torch.equal(mine.index, exact.index)
    torch.testing.assert_close(mine.compensations.double(), exact.compensations, rtol=1e-4, atol=0)
    held = exact.compensations == math.sqrt(2.5e-5)
    assert held.sum() > 5
    assert (~held).sum() > 5
    weights = torch.linspace(-1, 1, len(held), dtype=torch.float64)
    found = []
    for table, leaves in ((mine, here), (exact, there)):
        found.append(torch.autograd.grad((weights * table.compensations.double()).sum(), leaves))
    for got, want in zip(*found, strict=True):
        assert torch.isfinite(got).all()
        assert want.norm() > 0
        assert (got - want).norm() <= 1e-4 * want.norm()
    assert (found[0][2][mine.index[held]] == 0).all()


def test_without_opacities_and_with_sparse_gradients(make_scene):
    _, gaussians, camera = make_scene("sh3")
    settings = ProjectionSettings(radius_clip=2.0)
    (mine, here), (exact, there) = (
        projected(gaussians, camera, settings, kernels, opaque=True, sparse=True) for kernels in (True, False)
    )
    assert torch.equal(mine.index, exact.index)
    for table, leaves in ((mine, here), (exact, there)):
        table.means2d.sum().backward()
        assert leaves[0].grad.is_sparse
    torch.testing.assert_close(here[0].grad.to_dense(), there[0].grad.to_dense(), rtol=1e-4, atol=1e-4)


def test_colors_of_a_table(make_scene):
    _, gaussians, camera = make_scene("sh3")
    index = torch.arange(0, len(gaussians), 3)
    results = []
    for kernels in (True, False):
        means, sh = (t.detach().clone().requires_grad_() for t in (gaussians.means, gaussians.sh))
        center = camera.position.clone().requires_grad_()
        if kernels:
            colors = ShadeTable.apply(means, sh, center, index, camera, 2)
        else:
            directions = (means[index].double() - center).float()
            colors = (harmonics_sum(directions, sh[index], 2) + 0.5).clamp(min=0.0)
        weights = torch.linspace(-1, 1, colors.numel()).view_as(colors)
        results.append([colors.detach(), *torch.autograd.grad((weights * colors).sum(), (means, sh, center))])
    for got, want in zip(*results, strict=True):
        assert (got - want).norm() < 1e-5 * want.norm()


def test_colors_that_are_not_finite_are_nan_and_have_no_gradient(make_scene):
    _, gaussians, camera = make_scene("sh3")
    sh = gaussians.sh.clone()
    sh[2, 3, 1], sh[4, 0, 0], sh[6, 12, 0] = math.nan, math.inf, math.nan  # the last above the degree that is used
    means, sh = gaussians.means.clone().requires_grad_(), sh.requires_grad_()
    colors = ShadeTable.apply(means, sh, camera.position, torch.arange(len(sh)), camera, 2)
    assert torch.isnan(colors).any(dim=1).nonzero().flatten().tolist() == [2, 4]
    colors.nan_to_num().sum().backward()
    assert torch.isfinite(means.grad).all()
    assert torch.isfinite(sh.grad).all()
    assert (means.grad[[2, 4]] == 0).all()


@pytest.mark.parametrize("case", ["fisheye", "double", "covariances", "far planes", "skewed", "lens"])
def test_what_kernels_cannot_do_stays_with_torch(case, make_scene):
    _, gaussians, camera = make_scene("odd_size")
    settings = {
        "fisheye": ProjectionSettings("fisheye"),
        "far planes": ProjectionSettings(near=-1.0),
    }.get(case, ProjectionSettings())
    K, dtype = camera.K.clone(), torch.float64 if case == "double" else torch.float32
    if case == "skewed":
        K[0, 1] = 3.0
    K.requires_grad_(case == "lens")
    shape = {"quats": gaussians.quats.to(dtype), "scales": gaussians.scales.to(dtype)}
    if case == "covariances":
        shape = {"covars": torch.eye(3).expand(len(gaussians), 3, 3) * 0.01}
    options = {**shape, "opacities": gaussians.opacities.to(dtype)}
    size = (camera.width, camera.height, settings)
    tables = [
        project_splats(gaussians.means.to(dtype), camera.world_to_camera, K, *size, **options, kernels=kernels)
        for kernels in (True, False)
    ]
    assert tables[0].camera is None
    assert torch.equal(tables[0].means2d, tables[1].means2d)
    if case == "lens":  # whose focal lengths and principal point are being fitted
        (slope,) = torch.autograd.grad(tables[0].means2d.sum(dim=0) @ torch.tensor([1.0, 2.0]), K)
        count = float(len(tables[0].index))
        assert (slope[0, 2].item(), slope[1, 2].item()) == (count, 2 * count)
        assert min(abs(slope[0, 0].item()), abs(slope[1, 1].item())) > 1e-3


def test_a_pose_that_is_not_rigid_is_no_camera():
    assert read_camera(2 * torch.eye(4), torch.eye(3), 8, 8, 0.01, math.inf) is None
    assert read_camera(torch.eye(4), torch.eye(3), 8, 8, 0.01, math.inf).far == math.inf
