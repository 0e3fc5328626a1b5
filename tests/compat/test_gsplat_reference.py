"""The facade against gsplat 1.5.3 itself: its signatures, and its torch reference of every stage."""

import inspect

import pytest
import torch

from sgwarp.compat import gsplat as ours

theirs = pytest.importorskip("gsplat", reason="gsplat is not installed")
if theirs.__version__ != "1.5.3":
    pytest.skip("the facade follows gsplat 1.5.3", allow_module_level=True)

from gsplat import rendering  # noqa: E402
from gsplat.cuda import _torch_impl as reference  # noqa: E402
from gsplat.cuda import _wrapper  # noqa: E402

FUNCTIONS = (
    "rasterization",
    "fully_fused_projection",
    "isect_tiles",
    "isect_offset_encode",
    "rasterize_to_pixels",
    "rasterize_to_indices_in_range",
    "accumulate",
    "spherical_harmonics",
    "quat_scale_to_covar_preci",
)
MODELS = ("pinhole", "ortho", "fisheye")
IMAGE_TOLERANCE = 2e-5


@pytest.fixture
def without_cuda(monkeypatch):
    """gsplat's reference rasterizer, with our functions where it would call CUDA or nerfacc."""
    monkeypatch.setattr(_wrapper, "rasterize_to_indices_in_range", ours.rasterize_to_indices_in_range)
    monkeypatch.setattr(reference, "accumulate", ours.accumulate)
    for name in ("isect_tiles", "isect_offset_encode", "spherical_harmonics"):
        monkeypatch.setattr(rendering, name, getattr(ours, name))


def covariances(raw):
    return reference._quat_scale_to_covar_preci(raw.quats, raw.scales, True, False)[0]


def ortho(raw, model):
    """The scene with intrinsics that suit the camera model: an orthographic image is in pixels per metre."""
    return raw.replace(Ks=raw.Ks * torch.tensor([[0.3], [0.3], [1.0]])) if model == "ortho" else raw


def flatten(values, shape):
    """Row-major: one vector per splat."""
    return values.reshape(-1, *shape)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_signatures_are_gsplats(name):
    expected = inspect.signature(getattr(theirs, name)).parameters
    got = inspect.signature(getattr(ours, name)).parameters
    assert list(got) == list(expected)
    for key, parameter in expected.items():
        if key == "rolling_shutter":
            assert got[key].default.name == parameter.default.name
        else:
            assert got[key].default == parameter.default, key


@pytest.mark.parametrize("given", ["quats", "covars"])
@pytest.mark.parametrize("model", MODELS)
def test_projection(raw, model, given):
    raw = ortho(raw, model)
    covars = covariances(raw)
    expected = reference._fully_fused_projection(
        raw.means, covars, *raw.camera, calc_compensations=True, camera_model=model
    )
    upper = None if given == "quats" else covars.flatten(1)[:, [0, 1, 2, 4, 5, 8]]
    shape = (raw.quats, raw.scales) if given == "quats" else (None, None)
    got = ours.fully_fused_projection(
        raw.means, upper, *shape, *raw.camera, calc_compensations=True, camera_model=model
    )
    radii, *rest = got
    assert (radii - expected[0]).abs().max() <= 1
    seen = (radii > 0).all(-1) & (expected[0] > 0).all(-1)
    assert 20 < seen.sum() < seen.numel()
    for a, b in zip(rest, expected[1:], strict=True):
        torch.testing.assert_close(a[seen], b[seen], rtol=1e-4, atol=1e-4)
    packed = ours.fully_fused_projection(
        raw.means, upper, *shape, *raw.camera, calc_compensations=True, camera_model=model, packed=True
    )
    _, cameras, gaussians, *values = packed
    for a, b in zip(values, got, strict=True):
        assert torch.equal(a, b[cameras, gaussians])
    assert len(cameras) == (radii > 0).all(-1).sum()


@pytest.mark.parametrize("model", MODELS)
def test_gradients_of_projection(raw, model):
    """Against autograd through gsplat's reference, all in float64."""
    raw = ortho(raw, model)
    leaves = [t.double().requires_grad_() for t in (raw.means, raw.quats, raw.scales, raw.viewmats)]
    means, quats, scales, viewmats = leaves
    covars = reference._quat_scale_to_covar_preci(quats, scales, True, False)[0]
    camera = (viewmats, raw.Ks.double(), raw.width, raw.height)
    theirs_out = reference._fully_fused_projection(means, covars, *camera, calc_compensations=True, camera_model=model)
    ours_out = ours.fully_fused_projection(
        means, None, quats, scales, *camera, calc_compensations=True, camera_model=model
    )
    seen = (ours_out[0] > 0).all(-1) & (theirs_out[0] > 0).all(-1)
    rng = torch.Generator().manual_seed(1)
    gradients = []
    weights = [torch.rand(t[seen].shape, generator=rng, dtype=torch.float64) for t in theirs_out[1:]]
    for out in (theirs_out, ours_out):
        loss = sum((t[seen] * w).sum() for t, w in zip(out[1:], weights, strict=True))
        gradients.append(torch.autograd.grad(loss, leaves))
    for name, a, b in zip(("means", "quats", "scales", "viewmats"), *gradients, strict=True):
        assert (a - b).abs().max() <= 1e-6 * b.abs().max(), name


@pytest.mark.parametrize("tile_size", [16, 5])
def test_intersections(raw, tile_size):
    radii, means2d, depths, *_ = ours.fully_fused_projection(raw.means, None, raw.quats, raw.scales, *raw.camera)
    columns, rows = -(-raw.width // tile_size), -(-raw.height // tile_size)
    expected = reference._isect_tiles(means2d, radii, depths, tile_size, columns, rows)
    got = ours.isect_tiles(means2d, radii, depths, tile_size, columns, rows)
    for a, b in zip(got, expected, strict=True):
        assert a.dtype == b.dtype
        assert torch.equal(a, b)
    offsets = ours.isect_offset_encode(got[1], 2, columns, rows)
    assert torch.equal(offsets, reference._isect_offset_encode(expected[1], 2, columns, rows))
    unsorted = ours.isect_tiles(means2d, radii, depths, tile_size, columns, rows, sort=False)
    theirs_unsorted = reference._isect_tiles(means2d, radii, depths, tile_size, columns, rows, sort=False)
    for a, b in zip(unsorted, theirs_unsorted, strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("degree", range(5))
def test_spherical_harmonics(degree):
    rng = torch.Generator().manual_seed(degree)
    dirs = torch.randn(2, 7, 3, generator=rng, dtype=torch.float64).requires_grad_()
    coeffs = torch.randn(2, 7, 25, 3, generator=rng, dtype=torch.float64).requires_grad_()
    got, expected = (f(degree, dirs, coeffs) for f in (ours.spherical_harmonics, reference._spherical_harmonics))
    torch.testing.assert_close(got, expected, rtol=1e-7, atol=1e-7)
    weights = torch.randn(got.shape, generator=rng, dtype=torch.float64)
    gradients = [
        torch.autograd.grad((t * weights).sum(), [dirs, coeffs], materialize_grads=True) for t in (got, expected)
    ]
    for a, b in zip(*gradients, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-6, atol=1e-6)
    masks = torch.rand(2, 7, generator=rng) < 0.5
    masked = ours.spherical_harmonics(degree, dirs, coeffs, masks)
    assert torch.equal(masked, torch.where(masks[..., None], got, 0.0))


@pytest.mark.parametrize("triu", [False, True])
def test_covariances_and_precisions(raw, triu):
    quats, scales = raw.quats.view(3, 20, 4), raw.scales.view(3, 20, 3)
    expected = reference._quat_scale_to_covar_preci(quats, scales, True, True, triu)
    got = ours.quat_scale_to_covar_preci(quats, scales, triu=triu)
    for a, b in zip(got, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)
    assert ours.quat_scale_to_covar_preci(quats, scales, compute_preci=False)[1] is None


@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
@pytest.mark.parametrize("render_mode", ["RGB", "D", "ED", "RGB+D", "RGB+ED"])
@pytest.mark.usefixtures("without_cuda")
def test_images(raw, render_mode, rasterize_mode):
    """gsplat's whole reference rasterizer agrees with ours, away from opacities at the threshold."""
    request = {"render_mode": render_mode, "rasterize_mode": rasterize_mode, "sh_degree": 2}
    backgrounds = torch.rand(2, 3, generator=torch.Generator().manual_seed(3))
    arguments = (*raw.shape, raw.sh, *raw.camera)
    colors, alphas, meta = ours.rasterization(*arguments, backgrounds=backgrounds, **request)
    expected, expected_alphas, expected_meta = rendering._rasterization(*arguments, backgrounds=backgrounds, **request)
    missing = set(expected_meta) - set(meta)
    assert missing == set()
    clear = away_from_thresholds(expected_meta, raw)
    assert clear.float().mean() > 0.98
    torch.testing.assert_close(colors[clear], expected[clear], rtol=0, atol=IMAGE_TOLERANCE * max(1, expected.max()))
    torch.testing.assert_close(alphas[clear], expected_alphas[clear], rtol=0, atol=IMAGE_TOLERANCE)


def away_from_thresholds(meta, raw):
    """Pixels [2, H, W] at which no opacity is within 1e-3 (relative) of 1/255: there rounding decides."""
    y, x = torch.meshgrid(torch.arange(raw.height), torch.arange(raw.width), indexing="ij")
    d = torch.stack([x, y], -1)[None, :, :, None] + 0.5 - meta["means2d"][:, None, None]
    A, B, C = meta["conics"][:, None, None].unbind(-1)
    power = 0.5 * (A * d[..., 0] ** 2 + C * d[..., 1] ** 2) + B * d[..., 0] * d[..., 1]
    alpha = meta["opacities"][:, None, None] * torch.exp(-power)
    visible = (meta["radii"] > 0).all(-1)[:, None, None]
    return ~((((alpha * 255) - 1).abs() < 1e-3) & visible).any(-1)


@pytest.mark.cpu_only("gradients of results do not come back from the device")
@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
@pytest.mark.usefixtures("without_cuda")
def test_gradients(raw, rasterize_mode):
    """Every gradient, against autograd in float64 through gsplat's reference."""
    names = ("means", "quats", "scales", "opacities", "sh", "viewmats", "backgrounds")
    backgrounds = torch.rand(2, 3, generator=torch.Generator().manual_seed(3))
    values = (*raw.shape, raw.sh, raw.viewmats, backgrounds)
    request = {"render_mode": "RGB+ED", "rasterize_mode": rasterize_mode, "sh_degree": 3}
    gradients, centres = [], []
    weights = None
    for function, dtype in ((rendering._rasterization, torch.float64), (ours.rasterization, torch.float32)):
        *shape, sh, viewmats, bg = leaves = [t.to(dtype).requires_grad_() for t in values]
        extra = {} if function is rendering._rasterization else {"packed": False}
        colors, alphas, meta = function(
            *shape, sh, viewmats, raw.Ks.to(dtype), raw.width, raw.height, backgrounds=bg, **request, **extra
        )
        if weights is None:
            clear = away_from_thresholds(meta, raw)[..., None]
            rng = torch.Generator().manual_seed(5)
            weights = [clear * torch.rand(t.shape, generator=rng, dtype=torch.float64) for t in (colors, alphas)]
        meta["means2d"].retain_grad()
        loss = sum((t * w.to(dtype)).sum() for t, w in zip((colors, alphas), weights, strict=True))
        loss.backward()
        gradients.append([leaf.grad for leaf in leaves])
        centres.append(meta["means2d"].grad)
    for name, expected, got in zip(names, *gradients, strict=True):
        assert (got - expected).abs().max() <= 1e-3 * expected.abs().max(), name
        error = torch.linalg.norm(got.double() - expected) / torch.linalg.norm(expected)
        assert error <= 1e-4, name
    assert (centres[1] - centres[0]).abs().max() <= 1e-3 * centres[0].abs().max()


@pytest.mark.usefixtures("without_cuda")
def test_stages_compose_like_gsplats(raw):
    """Projection, intersection and compositing called one by one give the image of gsplat's reference."""
    radii, means2d, depths, conics, _ = ours.fully_fused_projection(
        raw.means, None, raw.quats, raw.scales, *raw.camera, opacities=raw.opacities
    )
    _, keys, listed = ours.isect_tiles(means2d, radii, depths, 16, 3, 3)
    offsets = ours.isect_offset_encode(keys, 2, 3, 3)
    colors, opacities = raw.colors.expand(2, -1, -1), raw.opacities.expand(2, -1)
    common = (raw.width, raw.height, 16, offsets, listed)
    got = ours.rasterize_to_pixels(means2d, conics, colors, opacities, *common)
    expected = reference._rasterize_to_pixels(means2d, conics, colors, opacities, *common, batch_per_iter=1)
    meta = {"means2d": means2d, "conics": conics, "opacities": opacities, "radii": radii}
    clear = away_from_thresholds(meta, raw)
    for a, b in zip(got, expected, strict=True):
        torch.testing.assert_close(a[clear], b[clear], rtol=0, atol=IMAGE_TOLERANCE)


@pytest.mark.slow
@pytest.mark.parametrize("absgrad", [False, True])
@pytest.mark.parametrize("packed", [False, True])
def test_densification_strategy_runs_on_our_meta(raw, packed, absgrad):
    """gsplat's own DefaultStrategy reads our `meta`, its gradients and radii, and grows and prunes the scene."""
    fields = {
        "means": raw.means,
        "quats": raw.quats,
        "scales": raw.scales.log(),
        "opacities": raw.opacities.logit(),
        "colors": raw.colors,
    }
    params = torch.nn.ParameterDict({name: torch.nn.Parameter(value.clone()) for name, value in fields.items()})
    optimizers = {name: torch.optim.Adam([value], lr=1e-3) for name, value in params.items()}
    strategy = theirs.DefaultStrategy(
        refine_start_iter=1,
        refine_every=3,
        grow_grad2d=1e-5,
        prune_opa=0.15,
        pause_refine_after_reset=0,
        absgrad=absgrad,
    )
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state(scene_scale=1.0)
    target = torch.rand(2, raw.height, raw.width, 3, generator=torch.Generator().manual_seed(2))
    counts = []
    torch.manual_seed(0)
    for step in range(8):
        colors, _, info = ours.rasterization(
            params["means"],
            params["quats"],
            params["scales"].exp(),
            params["opacities"].sigmoid(),
            params["colors"],
            *raw.camera,
            packed=packed,
            absgrad=absgrad,
        )
        strategy.step_pre_backward(params, optimizers, state, step, info)
        loss = (colors - target).square().mean()
        loss.backward()
        strategy.step_post_backward(params, optimizers, state, step, info, packed=packed)
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad()
        counts.append(len(params["means"]))
    assert all(torch.isfinite(value).all() for value in params.values())
    assert max(counts) > 60
