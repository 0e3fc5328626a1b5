"""The rasterizer's gradients against float64 autograd of the oracle, and against themselves in the other schedule."""

import math
from dataclasses import dataclass, field

import pytest
import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.evaluation.report.extremes import EXTREMES
from sgwarp.ops import launcher
from sgwarp.ops.reference import rasterizer as reference
from sgwarp.ops.splatting.autograd import rasterize as rasterize_differentiable
from sgwarp.ops.splatting.forward import Rendering, rasterize
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.scene import Camera, Gaussians

pytestmark = pytest.mark.slow

# Pixels nearer than this to a threshold, or to a change of the depth order, may flip in float32; no loss looks at them.
BOUNDARY_BAND = 1e-4
ORDER_BAND = 1e-6
# Error of a row over its norm; rows below a tenth of the median row are held to that.
RELATIVE_TOLERANCE = 1e-3
SETTINGS = RasterSettings()
GEOMETRY = ("means", "quats", "scales", "opacities")


@dataclass(eq=False)
class Leaves:
    """Everything that a gradient can flow to, as leaves of one dtype."""

    tensors: dict[str, Tensor] = field(default_factory=dict)

    @classmethod
    def of(
        cls, gaussians: Gaussians, camera: Camera, features: Tensor | None, background: Tensor, dtype: torch.dtype
    ) -> "Leaves":
        named = {name: getattr(gaussians, name) for name in GEOMETRY}
        named |= {"sh": gaussians.sh} if features is None else {"features": features}
        named |= {"background": background, "world_to_camera": camera.world_to_camera}
        named["means2d"] = torch.zeros(len(gaussians), 2)
        leaves = cls({name: tensor.detach().to(dtype).clone().requires_grad_() for name, tensor in named.items()})
        # The pose is float64 on both sides: at 1e5 m its float32 is another camera.
        leaves.tensors["world_to_camera"] = camera.world_to_camera.clone().requires_grad_()
        return leaves

    def gradients(self) -> dict[str, Tensor]:
        return {name: tensor.grad for name, tensor in self.tensors.items()}


@dataclass(eq=False)
class Loss:
    """A random linear functional of everything a rendering holds, zero where a pixel may flip."""

    features: Tensor
    alpha: Tensor
    expected_depth: Tensor
    depth: Tensor

    @classmethod
    def random(cls, raster: reference.Raster, seed: int = 0) -> "Loss":
        rng = torch.Generator().manual_seed(seed)
        clear = (raster.margin > BOUNDARY_BAND) & (raster.order_margin > ORDER_BAND)
        clear &= raster.surface_margin > BOUNDARY_BAND
        assert clear.double().mean() > 0.8

        def weights(like: Tensor) -> Tensor:
            values = torch.randn(like.shape, generator=rng, dtype=torch.float64)
            return values * (clear if like.ndim == 2 else clear[..., None])

        return cls(*(weights(t) for t in (raster.features, raster.alpha, raster.expected_depth, raster.depth)))

    def __call__(self, image: Rendering | reference.Raster) -> Tensor:
        parts = ((getattr(image, n), getattr(self, n)) for n in ("features", "alpha", "expected_depth", "depth"))
        return sum((values * weights.to(values)).sum() for values, weights in parts if values is not None)


def mirrored(settings: RasterSettings) -> reference.ReferenceSettings:
    names = ("alpha_min", "alpha_max", "transmittance_min", "surface_opacity", "antialiased")
    return reference.ReferenceSettings(**{n: getattr(settings, n) for n in names}, eps2d=settings.dilation)


def oracle(leaves: Leaves, camera: Camera, settings: RasterSettings) -> reference.Raster:
    t = leaves.tensors
    projection = reference.project(
        *(t[name] for name in GEOMETRY),
        t["world_to_camera"],
        camera.K,
        camera.width,
        camera.height,
        camera.near,
        camera.far,
        mirrored(settings),
    )
    projection.mean2d.add_(t["means2d"][projection.index])
    features = t.get("features")
    if features is None:
        features = reference.spherical_harmonics(t["means"], t["sh"], t["world_to_camera"], settings.sh_degree)
    return reference.composite(projection, features, camera.width, camera.height, t["background"], mirrored(settings))


def ours(leaves: Leaves, camera: Camera, settings: RasterSettings, *, depths: bool = True, **options) -> Rendering:
    t = leaves.tensors
    return rasterize_differentiable(
        *(t[name] for name in GEOMETRY),
        t["world_to_camera"],
        camera.K,
        camera.width,
        camera.height,
        sh=t.get("sh"),
        features=t.get("features"),
        background=t["background"],
        means2d=t["means2d"],
        expected_depth=depths,
        depth=depths,
        near=camera.near,
        far=camera.far,
        settings=settings,
        **options,
    )


def both(
    gaussians: Gaussians,
    camera: Camera,
    settings: RasterSettings = SETTINGS,
    channels: int | None = None,
    schedule: str | None = None,
) -> tuple[dict[str, Tensor], dict[str, Tensor], Loss]:
    """Our gradients and the oracle's of one loss over image, alpha and both depths."""
    rng = torch.Generator().manual_seed(channels or 0)
    features = None if channels is None else torch.rand(len(gaussians), channels, generator=rng)
    background = torch.rand(channels or 3, generator=rng)
    exact = Leaves.of(gaussians, camera, features, background, torch.float64)
    raster = oracle(exact, camera, settings)
    loss = Loss.random(raster)
    loss(raster).backward()
    single = Leaves.of(gaussians, camera, features, background, torch.float32)
    loss(ours(single, camera, settings, schedule=schedule)).backward()
    return single.gradients(), exact.gradients(), loss


def assert_rows_close(got: dict[str, Tensor], expected: dict[str, Tensor], tolerance: float = RELATIVE_TOLERANCE):
    for name, exact in expected.items():
        rows = 1 if name in ("world_to_camera", "background") else len(exact)
        want = exact.double().reshape(rows, -1)
        error = (got[name].double().reshape(rows, -1) - want).norm(dim=1)
        size = want.norm(dim=1)
        assert size.max() > 0, f"{name}: nothing to compare"
        bound = tolerance * size.clamp(min=0.1 * size[size > 0].median())
        worst = int((error / bound).argmax())
        assert (error <= bound).all(), f"{name}[{worst}]: off by {error[worst]:.2e} of {size[worst]:.2e}"


@pytest.mark.parametrize("schedule", ["lanes", "block"])
@pytest.mark.parametrize("antialiased", [False, True])
def test_every_gradient_matches_the_oracle(scene, antialiased, schedule):
    """Means, quaternions, scales, opacities, SH of degree 0 to 3, background, pose, projected means; three losses."""
    _, gaussians, camera = scene
    got, expected, _ = both(gaussians, camera, RasterSettings(antialiased=antialiased), schedule=schedule)
    assert_rows_close(got, expected)


@pytest.mark.parametrize("channels", [1, 2, 3, 7, 20])
@pytest.mark.parametrize("name", ["odd_size", "needles", "opaque_stack"])
@pytest.mark.parametrize("schedule", ["lanes", "block"])
def test_any_number_of_channels_matches_the_oracle(make_scene, name, channels, schedule):
    _, gaussians, camera = make_scene(name)
    got, expected, _ = both(gaussians, camera, channels=channels, schedule=schedule)
    assert_rows_close(got, expected)


def test_more_channels_than_are_staged_at_a_time_match_the_oracle(make_scene):
    _, gaussians, camera = make_scene("needles")
    got, expected, _ = both(gaussians, camera, channels=140, schedule="block")
    assert_rows_close(got, expected)


@pytest.mark.parametrize(
    "settings",
    [
        RasterSettings(alpha_min=0.05),
        RasterSettings(transmittance_min=0.1),
        RasterSettings(transmittance_min=0.0),
        RasterSettings(dilation=0.05),
        RasterSettings(alpha_max=0.7),
        RasterSettings(surface_opacity=0.8),
        RasterSettings(sh_degree=1),
    ],
)
def test_every_setting_matches_the_oracle(make_scene, settings):
    _, gaussians, camera = make_scene("sh3")
    got, expected, _ = both(gaussians, camera, settings)
    assert_rows_close(got, expected)


def compare_with_differences(compare, gaussians: Gaussians, camera: Camera, settings: RasterSettings, groups: int):
    """No autograd on the other side: the float64 oracle is only evaluated."""
    got, _, loss = both(gaussians, camera, settings)
    background = torch.rand(3, generator=torch.Generator().manual_seed(0))
    point = Leaves.of(gaussians, camera, None, background, torch.float64).tensors
    point = {name: tensor.detach() for name, tensor in point.items()}
    depths = point["means"] @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3]
    if len(depths.unique()) < len(depths):
        del got["means"], got["world_to_camera"]  # what breaks a tie in depth makes the image jump
    compare(lambda moved: loss(oracle(Leaves(moved), camera, settings)), point, got, groups)


@pytest.mark.parametrize("antialiased", [False, True])
def test_gradients_match_central_differences_of_the_oracle(scene, assert_central_differences, antialiased):
    _, gaussians, camera = scene
    compare_with_differences(assert_central_differences, gaussians, camera, RasterSettings(antialiased=antialiased), 1)


SMALL_EXTREMES = [e for e in EXTREMES.values() if 0 < len(e.build()[0]) < 1000]  # the oracle runs fourteen times
TOO_THIN = {"needles", "scales 1e-7", "focal 1e-2"}  # antialiasing leaves nothing of them


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("extreme", SMALL_EXTREMES, ids=lambda extreme: extreme.name)
def test_gradients_match_central_differences_at_the_extremes(extreme, assert_central_differences, antialiased):
    """Of the rows that are finite; the others' gradients are exactly zero, which is tested below."""
    gaussians, camera = extreme.build()
    gaussians, settings = gaussians.subset(gaussians.finite), RasterSettings(antialiased=antialiased)
    if antialiased and extreme.name in TOO_THIN:
        got, expected, _ = both(gaussians, camera, settings)
        assert not any((gradients[name] != 0).any() for gradients in (got, expected) for name in GEOMETRY)
        return
    compare_with_differences(assert_central_differences, gaussians, camera, settings, 1)


@pytest.mark.parametrize("deterministic", [True, False])
def test_block_schedule_equals_lane_schedule(scene, deterministic):
    _, gaussians, camera = scene
    for channels, settings in ((None, RasterSettings(antialiased=True)), (20, SETTINGS)):
        results = []
        for options in ({"schedule": "lanes"}, {"schedule": "block", "deterministic": deterministic}):
            rng = torch.Generator().manual_seed(1)
            features = None if channels is None else torch.rand(len(gaussians), channels, generator=rng)
            leaves = Leaves.of(gaussians, camera, features, torch.rand(channels or 3, generator=rng), torch.float32)
            raster = oracle(
                Leaves.of(gaussians, camera, features, leaves.tensors["background"], torch.float64), camera, settings
            )
            loss = Loss.random(raster)
            loss(ours(leaves, camera, settings, absgrad=True, **options)).backward()
            results.append({**leaves.gradients(), "absgrad": leaves.tensors["means2d"].absgrad})
        assert_rows_close(results[1], results[0])


def test_same_bits_for_any_number_of_threads(make_scene, monkeypatch):
    _, gaussians, camera = make_scene("random_cloud")
    camera = camera.resized(300, 410)
    monkeypatch.setattr(launcher, "SMALL", 1)
    before = launcher.get_threads()
    results = []
    try:
        for count in (1, 2, 5):
            launcher.set_threads(count)
            for channels in (None, 20):
                rng = torch.Generator().manual_seed(0)
                features = None if channels is None else torch.rand(len(gaussians), channels, generator=rng)
                leaves = Leaves.of(gaussians, camera, features, torch.rand(channels or 3, generator=rng), torch.float32)
                image = ours(leaves, camera, SETTINGS, absgrad=True)
                ((image.features**2).sum() + image.expected_depth.sum() + image.depth.sum()).backward()
                results.append({**leaves.gradients(), "absgrad": leaves.tensors["means2d"].absgrad})
    finally:
        launcher.set_threads(before)
    for i in (0, 1):
        for other in results[i::2]:
            for name, gradient in results[i].items():
                assert torch.equal(gradient, other[name]), name


def test_absgrad_sums_the_magnitudes_of_single_pixels(scenes):
    """Against one backward pass of the oracle for each pixel."""
    gaussians, camera = scenes.cloud(30, seed=3), scenes.pinhole(14, 11, focal=13.0)
    background = torch.zeros(3)
    exact = Leaves.of(gaussians, camera, None, background, torch.float64)
    raster = oracle(exact, camera, SETTINGS)
    loss = Loss.random(raster)
    pixels = (raster.features * loss.features).sum(dim=2) + raster.alpha * loss.alpha
    expected = torch.zeros(len(gaussians), 2, dtype=torch.float64)
    for pixel in pixels.flatten():
        expected += torch.autograd.grad(pixel, exact.tensors["means2d"], retain_graph=True)[0].abs()
    for schedule in ("lanes", "block"):
        single = Leaves.of(gaussians, camera, None, background, torch.float32)
        image = ours(single, camera, SETTINGS, depths=False, absgrad=True, schedule=schedule)
        loss(image).backward()
        means2d = single.tensors["means2d"]
        assert_rows_close({"absgrad": means2d.absgrad}, {"absgrad": expected})
        assert (means2d.absgrad >= means2d.grad.abs() * (1 - 1e-5)).all()


def test_left_out_gaussians_have_gradients_of_exactly_zero(make_scene):
    """Not finite, transparent, behind the camera or off screen; the others' gradients do not change by a bit."""
    _, gaussians, camera = make_scene("random_cloud")
    background = torch.rand(3)
    clean = Leaves.of(gaussians, camera, None, background, torch.float32)
    settings = RasterSettings(antialiased=True)

    def loss(image: Rendering) -> Tensor:
        return (image.features**2).sum() + image.expected_depth.sum() + image.depth.sum()

    loss(ours(clean, camera, settings)).backward()
    bad = gaussians.subset(torch.arange(9))
    fields = {name: getattr(bad, name).clone() for name in (*GEOMETRY, "sh")}
    fields["means"][0, 1] = math.nan
    fields["means"][1, 2] = math.inf
    fields["quats"][2] = 0.0
    fields["quats"][3, 0] = math.nan
    fields["scales"][4, 0] = math.inf
    fields["scales"][5, 2] = math.nan
    fields["opacities"][6] = math.nan
    fields["opacities"][7] = 0.0
    fields["scales"][8] = 0.0  # antialiasing leaves nothing of a point
    spoiled = Gaussians(**{name: torch.cat([fields[name], getattr(gaussians, name)]) for name in fields})
    leaves = Leaves.of(spoiled, camera, None, background, torch.float32)
    loss(ours(leaves, camera, settings)).backward()
    for name, gradient in leaves.gradients().items():
        reference_gradient = clean.tensors[name].grad
        if name in ("background", "world_to_camera"):
            torch.testing.assert_close(gradient, reference_gradient, rtol=1e-9, atol=0)
        else:
            assert (gradient[:9] == 0).all(), name
            assert torch.equal(gradient[9:], reference_gradient), name
            behind = (gaussians.means.double() @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3]) < 0
            assert behind.any()
            assert (gradient[9:][behind] == 0).all(), name


def test_several_renders_before_one_backward(make_scene):
    """What a backward pass needs outlives the next render: gradients of two views add up."""
    _, gaussians, camera = make_scene("random_cloud")
    second = camera.resized(40, 72)
    rng = torch.Generator().manual_seed(5)
    features = torch.rand(len(gaussians), 6, generator=rng)
    apart = []
    for view in (camera, second):
        leaves = Leaves.of(gaussians, view, features, torch.zeros(6), torch.float32)
        (ours(leaves, view, SETTINGS).features ** 2).sum().backward()
        apart.append(leaves.gradients())
    leaves = Leaves.of(gaussians, camera, features, torch.zeros(6), torch.float32)
    images = [ours(leaves, view, SETTINGS) for view in (camera, second)]
    rasterize(gaussians, camera)
    sum((image.features**2).sum() for image in images).backward()
    for name in (*GEOMETRY, "features"):
        torch.testing.assert_close(leaves.tensors[name].grad, apart[0][name] + apart[1][name])


def test_image_is_that_of_rasterize(make_scene):
    _, gaussians, camera = make_scene("random_cloud")
    background = torch.rand(3)
    plain = rasterize(gaussians, camera, background=background, expected_depth=True, depth=True)
    leaves = Leaves.of(gaussians, camera, None, background, torch.float32)
    trained = ours(leaves, camera, SETTINGS)
    with torch.no_grad():
        untrained = ours(leaves, camera, SETTINGS)
    for image in (trained, untrained):
        for name in ("features", "alpha", "expected_depth", "depth"):
            torch.testing.assert_close(getattr(image, name), getattr(plain, name), rtol=0, atol=1e-6)
        assert image.culled == plain.culled
    assert trained.features.requires_grad
    assert not untrained.features.requires_grad


def test_only_what_asks_gets_a_gradient_and_in_its_dtype(make_scene):
    _, gaussians, camera = make_scene("odd_size")
    means = gaussians.means.double().requires_grad_()
    inputs = (gaussians.quats, gaussians.scales, gaussians.opacities, camera.world_to_camera, camera.K)
    image = rasterize_differentiable(means, *inputs, camera.width, camera.height, sh=gaussians.sh)
    image.features.sum().backward()
    assert means.grad.dtype == torch.float64
    assert means.grad.abs().sum() > 0
    assert all(tensor.grad is None for tensor in inputs)


def test_empty_scene_has_empty_gradients(make_scene):
    _, gaussians, camera = make_scene("random_cloud")
    nothing = gaussians.subset(torch.zeros(len(gaussians), dtype=torch.bool))
    for features in (None, torch.zeros(0, 5)):
        background = torch.rand(3 if features is None else 5)
        leaves = Leaves.of(nothing, camera, features, background, torch.float32)
        image = ours(leaves, camera, SETTINGS, absgrad=True)
        (image.features.sum() + image.expected_depth.sum()).backward()
        pixels = torch.full_like(background, camera.width * camera.height)
        torch.testing.assert_close(leaves.tensors["background"].grad, pixels)
        assert leaves.tensors["means"].grad.shape == (0, 3)
        assert (leaves.tensors["world_to_camera"].grad == 0).all()


def test_inputs_are_checked(make_scene):
    _, gaussians, camera = make_scene("random_cloud")
    inputs = [getattr(gaussians, name) for name in GEOMETRY]
    inputs += [camera.world_to_camera, camera.K, camera.width, camera.height]
    with pytest.raises(InputError, match="or both"):
        rasterize_differentiable(*inputs)
    with pytest.raises(InputError, match="features"):
        rasterize_differentiable(*inputs, features=torch.zeros(3, 4))
    with pytest.raises(InputError, match="sh: expected"):
        rasterize_differentiable(*inputs, sh=gaussians.sh[:, :2])
    with pytest.raises(InputError, match="background"):
        rasterize_differentiable(*inputs, sh=gaussians.sh, background=torch.zeros(4))
    with pytest.raises(InputError, match="means2d"):
        rasterize_differentiable(*inputs, sh=gaussians.sh, means2d=torch.zeros(3, 2))
    with pytest.raises(InputError, match="absgrad"):
        rasterize_differentiable(*inputs, sh=gaussians.sh, absgrad=True)


def test_the_camera_is_the_renderings_own(make_scene):
    """Writing to K after the forward pass changes no gradient."""
    _, gaussians, camera = make_scene("random_cloud")
    results = []
    for factor in (1.0, 3.0):
        means = gaussians.means.clone().requires_grad_()
        K = camera.K.clone()
        rest = (gaussians.quats, gaussians.scales, gaussians.opacities, camera.world_to_camera, K)
        image = rasterize_differentiable(means, *rest, camera.width, camera.height, sh=gaussians.sh)
        K *= factor
        (image.features**2).sum().backward()
        results.append(means.grad)
    assert torch.equal(*results)


def test_empty_scene_has_a_depth_to_differentiate(make_scene):
    _, gaussians, camera = make_scene("random_cloud")
    names = ("means", "quats", "scales", "opacities")
    leaves = [getattr(gaussians, name)[:0].clone().requires_grad_() for name in names]
    size = (camera.world_to_camera, camera.K, camera.width, camera.height)
    rasterize_differentiable(*leaves, *size, sh=gaussians.sh[:0], depth=True).depth.sum().backward()
    assert leaves[0].grad.shape == (0, 3)


@pytest.mark.parametrize("channels", [3, 16, 32])
def test_tensors_may_start_anywhere_in_memory(make_scene, channels):
    """Images of whole vectors are read in place, wherever a caller's view of its memory begins."""
    _, gaussians, camera = make_scene("random_cloud")
    camera = camera.resized(48, 64)

    def moved(tensor: Tensor, start: int) -> Tensor:
        flat = torch.empty(tensor.numel() + start)[start:].view(tensor.shape)
        return flat.copy_(tensor)

    rng = torch.Generator().manual_seed(0)
    features = torch.rand(len(gaussians), channels, generator=rng)
    v_image, v_alpha = torch.rand(48, 64, channels, generator=rng), torch.rand(48, 64, generator=rng)
    results = []
    for start in (0, 1, 3):
        leaves = [moved(t, start).requires_grad_() for t in (gaussians.means, features)]
        rest = (gaussians.quats, gaussians.scales, gaussians.opacities, camera.world_to_camera, camera.K, 64, 48)
        image = rasterize_differentiable(leaves[0], *rest, features=leaves[1])
        torch.autograd.backward([image.features, image.alpha], [moved(v_image, start), moved(v_alpha, start)])
        results.append([leaf.grad for leaf in leaves])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_features_that_are_not_finite_are_refused(make_scene, bad):
    _, gaussians, camera = make_scene("random_cloud")
    features = torch.ones(len(gaussians), 3)
    features[7, 1] = bad
    with pytest.raises(InputError, match="features: NaN or infinity in 1 rows, the first is 7"):
        rasterize(gaussians, camera, features)


def test_huge_coefficients_stay_finite_colours(make_scene):
    _, gaussians, camera = make_scene("sh3")
    sh = gaussians.sh.clone()
    sh[7], sh[9] = 3e38, -3e38
    spoiled = Gaussians(gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, sh)
    assert not bool(torch.isnan(rasterize(spoiled, camera).features).any())


def test_colors_and_features_in_one_pass():
    """Harmonics and features together are what they are apart, and so are their gradients."""
    rng = torch.Generator().manual_seed(0)
    means = torch.rand(60, 3, generator=rng) * torch.tensor([3.0, 2.0, 3.0]) + torch.tensor([-1.5, -1.0, 2.0])
    quats = torch.randn(60, 4, generator=rng)
    scales = torch.rand(60, 3, generator=rng) * 0.3 + 0.02
    fields = (means, quats, scales, torch.rand(60, generator=rng) * 0.9 + 0.05, torch.randn(60, 16, 3, generator=rng))
    fields = (*fields, torch.rand(60, 5, generator=rng))
    K = torch.tensor([[50.0, 0, 20], [0, 50.0, 15], [0, 0, 1]])
    shape = (torch.eye(4), K, 40, 30)
    leaves = [t.clone().requires_grad_() for t in fields]
    both = rasterize_differentiable(*leaves[:4], *shape, sh=leaves[4], features=leaves[5]).features
    apart = [t.clone().requires_grad_() for t in fields]
    colors = rasterize_differentiable(*apart[:4], *shape, sh=apart[4]).features
    others = rasterize_differentiable(*apart[:4], *shape, features=apart[5]).features
    assert both.shape[2] == 8
    torch.testing.assert_close(both, torch.cat([colors, others], dim=2), rtol=0, atol=2e-5)
    weights = torch.rand(both.shape, generator=torch.Generator().manual_seed(1))
    (both * weights).sum().backward()
    ((colors * weights[..., :3]).sum() + (others * weights[..., 3:]).sum()).backward()
    for name, one, two in zip(("means", "quats", "scales", "opacities", "sh", "features"), leaves, apart, strict=True):
        scale = two.grad.abs().max().item()
        torch.testing.assert_close(one.grad, two.grad, rtol=1e-3, atol=1e-4 * scale, msg=lambda m, n=name: f"{n}: {m}")
