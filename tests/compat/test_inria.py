"""The facade of Inria's rasterizer against the float64 oracle, in Inria's conventions."""

import math
from dataclasses import replace

import pytest
import torch

from sgwarp.compat.inria import GaussianRasterizationSettings, GaussianRasterizer, SparseGaussianAdam, dist2
from sgwarp.errors import InputError
from sgwarp.ops.reference import rasterizer as reference

WIDTH, HEIGHT = 45, 37


def settings_of(raw, principal=(WIDTH / 2, HEIGHT / 2), **changes) -> GaussianRasterizationSettings:
    """The raw scene's first camera as Inria's code builds it: an OpenGL-like projection, both matrices transposed."""
    fx, fy = raw.Ks[0, 0, 0].item(), raw.Ks[0, 1, 1].item()
    near, far = 0.01, 100.0
    projection = torch.zeros(4, 4, dtype=torch.float64)
    projection[0, 0], projection[1, 1] = 2 * fx / WIDTH, 2 * fy / HEIGHT
    projection[0, 2], projection[1, 2] = 2 * principal[0] / WIDTH - 1, 2 * principal[1] / HEIGHT - 1
    projection[2, 2], projection[2, 3], projection[3, 2] = far / (far - near), -far * near / (far - near), 1.0
    view = raw.viewmats[0].double()
    fields = {
        "image_height": HEIGHT,
        "image_width": WIDTH,
        "tanfovx": WIDTH / (2 * fx),
        "tanfovy": HEIGHT / (2 * fy),
        "bg": torch.tensor([0.2, 0.5, 0.1]),
        "scale_modifier": 1.0,
        "viewmatrix": view.T.float(),
        "projmatrix": (view.T @ projection.T).float(),
        "sh_degree": 2,
        "campos": torch.linalg.inv(view)[:3, 3].float(),
        "prefiltered": False,
        "debug": False,
    }
    return GaussianRasterizationSettings(**{**fields, **changes})


def oracle(raw, settings, principal=(WIDTH / 2, HEIGHT / 2), scale=1.0, antialiased=False, sh=True):
    """Raster and leaves of the float64 reference: means, quats, scales, opacities, values, background."""
    values = raw.sh[:, :9] if sh else raw.colors
    leaves = [t.double().requires_grad_() for t in (*raw.shape, values)]
    means, quats, scales, opacities, values = leaves
    K = raw.Ks[0].double()
    K[:2, 2] = torch.tensor(principal)
    view = settings.viewmatrix.double().T
    reference_settings = reference.ReferenceSettings(alpha_max=0.99, antialiased=antialiased)
    projection = reference.project(
        means, quats, scales * scale, opacities, view, K, WIDTH, HEIGHT, near=0.2, settings=reference_settings
    )
    projection.mean2d.retain_grad()
    colors = reference.spherical_harmonics(means, values, view) if sh else values
    bg = settings.bg.double()
    return reference.composite(projection, colors, WIDTH, HEIGHT, bg, reference_settings), projection, leaves


def call(raw, settings, leaves=None, means2D=None, **values):
    """Image and radii; settings that say whether to antialias bring a third value."""
    return call_today(raw, settings, leaves, means2D, **values)[:2]


def call_today(raw, settings, leaves=None, means2D=None, **values):
    means, quats, scales, opacities = raw.shape if leaves is None else leaves
    means2D = torch.zeros_like(means) if means2D is None else means2D
    return GaussianRasterizer(settings)(
        means3D=means, means2D=means2D, opacities=opacities[:, None], scales=scales, rotations=quats, **values
    )


def test_image_and_radii(raw):
    settings = settings_of(raw)
    raw.means[:3, 2] = torch.tensor([-3.0, math.nan, 0.0])
    result = call_today(raw, settings, shs=raw.sh)
    assert isinstance(result, tuple)
    image, radii = result
    expected, projection, _ = oracle(raw, settings)
    clear = expected.margin > 1e-4
    assert image.shape == (3, HEIGHT, WIDTH)
    torch.testing.assert_close(image.permute(1, 2, 0).double()[clear], expected.features[clear], rtol=0, atol=2e-5)
    assert radii.dtype == torch.int32
    assert radii.shape == (60,)
    seen = torch.zeros(60, dtype=torch.bool)
    seen[projection.index] = True
    assert (radii[seen] > 0).all()
    assert (radii == 0).sum() > 0
    conic = projection.conic.detach()
    matrices = torch.stack([conic[:, 0], conic[:, 1], conic[:, 1], conic[:, 2]], 1).view(-1, 2, 2)
    largest = 3 / torch.linalg.eigvalsh(matrices)[:, 0].sqrt()
    assert ((radii[projection.index] - largest.ceil()).abs() <= 1).all()


@pytest.mark.parametrize(
    ("principal", "scale", "antialiasing", "sh"),
    [((30.5, 12.0), 1.0, False, True), ((22.5, 18.5), 1.7, False, False), ((22.5, 18.5), 0.2, True, True)],
)
def test_gradients(raw, principal, scale, antialiasing, sh):
    """Principal point off centre, scale modifier, antialiasing: every gradient against autograd through the oracle."""
    settings = settings_of(raw, principal, scale_modifier=scale, antialiasing=antialiasing)
    expected, projection, wanted = oracle(raw, settings, principal, scale, antialiasing, sh)
    leaves = [t.clone().requires_grad_() for t in raw.shape]
    values = (raw.sh[:, :9] if sh else raw.colors).clone().requires_grad_()
    means2D = torch.zeros(60, 3, requires_grad=True)
    image, _ = call(raw, settings, leaves, means2D, **{"shs" if sh else "colors_precomp": values})
    clear = expected.margin > 1e-4
    torch.testing.assert_close(image.permute(1, 2, 0).double()[clear], expected.features[clear], rtol=0, atol=2e-5)
    weights = torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(4)) * clear[..., None]
    (image.permute(1, 2, 0) * weights).sum().backward()
    (expected.features * weights.double()).sum().backward()
    for name, got, want in zip(
        ("means", "quats", "scales", "opacities", "values"), [*leaves, values], wanted, strict=True
    ):
        assert (got.grad - want.grad).abs().max() <= 1e-3 * want.grad.abs().max(), name
    # The proxy is in units of half the image's size, as Inria's densification thresholds expect.
    proxy = torch.zeros(60, 3, dtype=torch.float64)
    proxy[projection.index, :2] = projection.mean2d.grad * torch.tensor([0.5 * WIDTH, 0.5 * HEIGHT])
    assert proxy.abs().max() > 0
    assert (means2D.grad - proxy).abs().max() <= 1e-3 * proxy.abs().max()


@pytest.mark.parametrize("shift", [0.0, 0.4])
def test_colors_are_those_seen_from_campos(raw, shift):
    """Also where it is not where the view matrix looks from; its gradient against autograd in float64."""
    settings = settings_of(raw)
    campos = (settings.campos + shift).requires_grad_()
    image, _ = call(raw, settings._replace(campos=campos), shs=raw.sh)
    exact = campos.detach().double().requires_grad_()
    directions = torch.nn.functional.normalize(raw.shape[0].double() - exact, dim=1)
    basis = reference.harmonics(directions, 2)
    colors = (torch.einsum("nk,nkc->nc", basis, raw.sh[:, :9].double()) + 0.5).clamp(min=0)
    expected, _ = call(raw, settings, colors_precomp=colors.detach().float())
    torch.testing.assert_close(image, expected, rtol=0, atol=2e-5)
    weights = torch.rand(3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(4))
    (image * weights).sum().backward()
    leaf = colors.detach().float().requires_grad_()
    again, _ = call(raw, settings, colors_precomp=leaf)
    (again * weights).sum().backward()
    colors.backward(leaf.grad.double())
    assert exact.grad.abs().max() > 0
    assert (campos.grad - exact.grad).abs().max() <= 1e-3 * exact.grad.abs().max()


@pytest.mark.slow
@pytest.mark.parametrize("antialiasing", [False, True])
@pytest.mark.parametrize("given", ["shs", "colors_precomp", "cov3D_precomp"])
def test_gradients_match_central_differences(raw, assert_central_differences, given, antialiasing):
    """Every input, background and densification proxy included; the oracle is only evaluated, no autograd there."""
    settings = settings_of(raw, antialiasing=antialiasing)
    values = raw.sh[:, :9] if given == "shs" else raw.colors
    start = dict(zip(("means", "quats", "scales", "opacities"), raw.shape, strict=True))
    start |= {"values": values, "means2D": torch.zeros(60, 2), "bg": settings.bg}
    start = {name: tensor.clone() for name, tensor in start.items()}
    start["scales"] *= torch.tensor([1.0, 0.7, 1.4])  # a sphere has no orientation
    view, K = settings.viewmatrix.double().T, raw.Ks[0].double()
    K[:2, 2] = torch.tensor([WIDTH / 2, HEIGHT / 2])
    options = reference.ReferenceSettings(alpha_max=0.99, antialiased=antialiasing)

    def raster(t):
        shape = (t["means"], t["quats"], t["scales"], t["opacities"])
        projection = reference.project(*shape, view, K, WIDTH, HEIGHT, near=0.2, settings=options)
        moved = projection.mean2d + t["means2D"][projection.index] * torch.tensor([WIDTH / 2, HEIGHT / 2])
        colors = reference.spherical_harmonics(t["means"], t["values"], view) if given == "shs" else t["values"]
        return reference.composite(replace(projection, mean2d=moved), colors, WIDTH, HEIGHT, t["bg"], options)

    point = {name: tensor.double() for name, tensor in start.items()}
    at_start = raster(point)
    clear = (at_start.margin > 1e-4) & (at_start.order_margin > 1e-6)
    assert clear.double().mean() > 0.9
    weights = torch.randn(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(6)) * clear[..., None]

    t = {name: tensor.clone().requires_grad_() for name, tensor in start.items()}
    shape = {"scales": t["scales"], "rotations": t["quats"]}
    if given == "cov3D_precomp":
        axes = reference.rotation_matrices(t["quats"].double()) * t["scales"].double()[:, None]
        upper = (axes @ axes.transpose(1, 2)).flatten(1)[:, [0, 1, 2, 4, 5, 8]]
        shape = {"cov3D_precomp": upper.float()}
    image, *_ = GaussianRasterizer(settings._replace(bg=t["bg"]))(
        means3D=t["means"],
        means2D=t["means2D"],
        opacities=t["opacities"],
        **shape,
        **{"shs" if given == "shs" else "colors_precomp": t["values"]},
    )
    (image.permute(1, 2, 0) * weights).sum().backward()
    gradients = {name: leaf.grad for name, leaf in t.items()}
    assert_central_differences(lambda t: (raster(t).features * weights).sum(), point, gradients)


def test_values_of_means2D_do_not_matter(raw):
    settings = settings_of(raw)
    plain, _ = call(raw, settings, colors_precomp=raw.colors)
    assert torch.equal(plain, call(raw, settings, means2D=torch.rand(60, 3), colors_precomp=raw.colors)[0])


def test_covariances_and_channels(raw):
    axes = reference.rotation_matrices(raw.quats) * raw.scales[:, None]
    covars = axes @ axes.transpose(1, 2)
    upper = covars.flatten(1)[:, [0, 1, 2, 4, 5, 8]]
    values = torch.rand(60, 8, generator=torch.Generator().manual_seed(1))
    settings = settings_of(raw, bg=torch.zeros(8))
    by_shape, radii = call(raw, settings, colors_precomp=values)
    rasterizer = GaussianRasterizer(settings)
    by_covars, same = rasterizer(raw.means, None, raw.opacities, colors_precomp=values, cov3D_precomp=upper)
    assert by_shape.shape == (8, HEIGHT, WIDTH)
    torch.testing.assert_close(by_covars, by_shape, rtol=0, atol=1e-4)
    assert ((radii - same).abs() <= 1).all()


def test_mark_visible(raw):
    settings = settings_of(raw)
    means = raw.means - torch.tensor([0.0, 0.0, 3.2])
    pose = settings.viewmatrix.T
    visible = GaussianRasterizer(settings).markVisible(means)
    assert visible.dtype == torch.bool
    assert 0 < visible.sum() < 60
    assert torch.equal(visible, (means @ pose[:3, :3].T + pose[:3, 3])[:, 2] > 0.2)


def test_near_plane_is_inrias(raw):
    """Nothing nearer than 0.2 is shown."""
    pose = settings_of(raw).viewmatrix.T
    at = torch.tensor([[0.0, 0.0, 0.19], [0.0, 0.0, 0.21]]) @ torch.linalg.inv(pose[:3, :3]).T
    means = at - pose[:3, 3] @ torch.linalg.inv(pose[:3, :3]).T
    two = raw.replace(
        means=means,
        quats=raw.quats[:2],
        scales=torch.full((2, 3), 0.01),
        opacities=torch.ones(2),
        colors=raw.colors[:2],
    )
    assert call(two, settings_of(raw), colors_precomp=two.colors)[1].bool().tolist() == [False, True]


@pytest.mark.parametrize(
    ("changes", "arguments", "message"),
    [
        ({}, {}, "shs, colors_precomp"),
        ({}, {"shs": "sh", "colors_precomp": "colors"}, "shs, colors_precomp"),
        ({}, {"colors_precomp": "colors", "cov3D_precomp": "means"}, "cov3D_precomp"),
        ({"sh_degree": 4}, {"shs": "sh"}, "shs"),
        ({"bg": torch.zeros(4)}, {"colors_precomp": "colors"}, "bg"),
        ({"tanfovx": 0.7}, {"colors_precomp": "colors"}, "tanfovx"),
        ({"projmatrix": torch.eye(4)}, {"colors_precomp": "colors"}, "projmatrix"),
        ({"viewmatrix": torch.eye(3)}, {"colors_precomp": "colors"}, "viewmatrix"),
    ],
)
def test_mistakes_are_named(raw, changes, arguments, message):
    with pytest.raises(InputError, match=message):
        call(raw, settings_of(raw, **changes), **{name: getattr(raw, field) for name, field in arguments.items()})


def nearest_by_sorting(points):
    distances = torch.cdist(points.double(), points.double(), compute_mode="donot_use_mm_for_euclid_dist")
    distances.fill_diagonal_(math.inf)
    return distances.sort(dim=1).values[:, :3].square().mean(dim=1)


@pytest.mark.parametrize("kind", ["uniform", "clusters", "plane", "outlier", "duplicates", "one_place", "far", "four"])
def test_dist2(kind):
    rng = torch.Generator().manual_seed(7)
    points = torch.rand(1500, 3, generator=rng)
    if kind == "clusters":
        points = torch.randn(1500, 3, generator=rng) * torch.rand(30, 1, generator=rng).pow(6).repeat(50, 1)
    elif kind == "plane":
        points[:, 2] = 0.25
    elif kind == "outlier":
        points[700] = 1e6
    elif kind == "duplicates":
        points = points[torch.randint(0, 500, (1500,), generator=rng)]
    elif kind == "one_place":
        points = points[:1].expand(100, 3)
    elif kind == "far":
        points = points.double() + 1e6
    elif kind == "four":
        points = points[:4]
    got = dist2(points)
    assert got.dtype == torch.float32
    torch.testing.assert_close(got.double(), nearest_by_sorting(points), rtol=2e-6, atol=1e-12)


def test_dist2_names_what_is_wrong():
    with pytest.raises(InputError, match="at least 4"):
        dist2(torch.rand(3, 3))
    with pytest.raises(InputError, match=r"\[N, 3\]"):
        dist2(torch.rand(5, 2))
    points = torch.rand(9, 3)
    points[6, 1] = math.nan
    with pytest.raises(InputError, match=r"points\[6\]"):
        dist2(points)


@pytest.mark.parametrize("antialiasing", [False, True])
def test_inverse_depth_is_the_third_value(raw, antialiasing):
    """The sum of alpha T / z, with gradients, as Inria's rasterizer returns it since October 2024."""
    settings = settings_of(raw, antialiasing=antialiasing)
    means, quats, scales, opacities = (t.clone().requires_grad_() for t in raw.shape)
    image, _, depth = call_today(raw, settings, (means, quats, scales, opacities), shs=raw.sh)
    expected, projection, leaves = oracle(raw, settings, antialiased=antialiasing)
    view = settings.viewmatrix.double().T
    inverse = 1.0 / (leaves[0] @ view[2, :3] + view[2, 3])[:, None]
    options = reference.ReferenceSettings(alpha_max=0.99, antialiased=antialiasing)
    wanted = reference.composite(projection, inverse, WIDTH, HEIGHT, None, options)
    clear = wanted.margin > 1e-4
    assert depth.shape == (1, HEIGHT, WIDTH)
    torch.testing.assert_close(depth[0].double()[clear], wanted.features[..., 0][clear], rtol=0, atol=2e-5)
    torch.testing.assert_close(image.permute(1, 2, 0).double()[clear], expected.features[clear], rtol=0, atol=2e-5)
    (depth[0] * clear).sum().backward()
    (wanted.features[..., 0] * clear).sum().backward()
    torch.testing.assert_close(means.grad.double(), leaves[0].grad, rtol=2e-3, atol=2e-4)


def test_harmonics_in_two_parts(raw):
    settings = settings_of(raw, antialiasing=False)
    whole = call_today(raw, settings, shs=raw.sh)
    parts = call_today(raw, settings, dc=raw.sh[:, :1], shs=raw.sh[:, 1:])
    assert all(torch.equal(a, b) for a, b in zip(whole, parts, strict=True))
    flat = settings_of(raw, sh_degree=0, antialiasing=False)
    assert torch.equal(call_today(raw, flat, dc=raw.sh[:, :1])[0], call_today(raw, flat, shs=raw.sh[:, :1])[0])
    with pytest.raises(InputError, match=r"dc: expected shape \[60, 1, 3\]"):
        call_today(raw, settings, dc=raw.sh, shs=raw.sh)


def test_sparse_adam_moves_what_was_seen():
    """Against the update written out for one number: no bias correction, unseen rows keep value and moments."""
    values = torch.tensor([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]], requires_grad=True)
    optimizer = SparseGaussianAdam([{"params": [values], "lr": 0.1, "name": "xyz"}], lr=0.0, eps=1e-15)
    expected, moments = values.detach().clone(), torch.zeros(2, 3, 2)
    for step, seen in enumerate(([True, False, True], [True, True, False], [False, True, True])):
        values.grad = torch.tensor([[0.5, -1.0], [2.0, 0.25], [-4.0, 1.0]]) * (step + 1)
        optimizer.step(torch.tensor(seen), 3)
        for row in range(3):
            for column in range(2):
                if seen[row]:
                    g = values.grad[row, column]
                    moments[0, row, column] = 0.9 * moments[0, row, column] + 0.1 * g
                    moments[1, row, column] = 0.999 * moments[1, row, column] + 0.001 * g * g
                    first, second = moments[:, row, column]
                    expected[row, column] -= 0.1 * first / (second.sqrt() + 1e-15)
    assert torch.allclose(values.detach(), expected, rtol=1e-5)
    with pytest.raises(InputError, match="expected one tensor of 5 rows"):
        optimizer.step(torch.ones(5, dtype=torch.bool), 5)
