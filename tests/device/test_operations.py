"""Every public operation on a pretended CUDA device: same results as on the CPU, waits and launches counted."""

import math
from dataclasses import replace

import pytest
import torch

import sgwarp as sg
from sgwarp.compat import gsplat, inria
from sgwarp.ops.neighbors import mean_squared_neighbor_distance
from sgwarp.ops.photometric import photometric_loss
from sgwarp.ops.reference import rasterizer as reference
from sgwarp.ops.splatting.lifting import LiftSums, lift_view

COUNT = "ops/splatting/tiles.py"  # where the host waits for the number of intersections


def leaves(gaussians, *more):
    fields = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, *more)
    return [t.detach().clone().requires_grad_() for t in fields]


def places(record):
    return [place.split(":")[0] for _, place in record]


def assert_same(there, here, tolerance=1e-4):
    assert there.is_cuda
    torch.testing.assert_close(there.cpu(), here, rtol=tolerance, atol=tolerance)


@pytest.fixture
def sh3(make_scene):
    return make_scene("sh3")


@pytest.mark.parametrize("mode", ["rgb", "depth", "expected_depth", "alpha"])
def test_a_rendering_waits_once_and_uploads_nothing(mode, sh3, pretended_cuda):
    expected = sg.render(sh3.gaussians, sh3.camera, mode)
    there = sh3.gaussians.to("cuda")
    sg.render(there, sh3.camera, mode)  # looks once which harmonics the scene uses
    pretended_cuda.reset()
    image = sg.render(there, sh3.camera, mode)
    assert_same(image, expected)
    assert places(pretended_cuda.waits) == [COUNT]
    assert pretended_cuda.uploads == []
    assert len(pretended_cuda.launches) <= 8


@pytest.mark.parametrize("channels", [2, 20])
def test_rendering_features_waits_once(channels, sh3, pretended_cuda):
    features = torch.rand(len(sh3.gaussians), channels)
    background = torch.rand(channels)
    expected = sg.render(sh3.gaussians, sh3.camera, "features", features, background=background)
    there, features, background = sh3.gaussians.to("cuda"), features.to("cuda"), background.to("cuda")
    pretended_cuda.reset()
    assert_same(sg.render(there, sh3.camera, "features", features, background=background), expected)
    assert places(pretended_cuda.waits) == [COUNT]


def rasterized(leaves, camera, *, channels=None, depths=False, pose=None, **options):
    values = {"sh": leaves[4]} if channels is None else {"features": leaves[4]}
    pose = camera.world_to_camera if pose is None else pose
    options |= {"expected_depth": depths, "depth": depths}
    return sg.rasterize(*leaves[:4], pose, camera.K, camera.width, camera.height, **values, **options)


def backward_of(rendering):
    loss = rendering.features.square().mean() + rendering.alpha.mean()
    if rendering.depth is not None:
        loss = loss + rendering.expected_depth.mean() + rendering.depth.mean()
    loss.backward()


@pytest.mark.parametrize("deterministic", [None, True])
@pytest.mark.parametrize("channels", [None, 2, 20])
@pytest.mark.parametrize("depths", [False, True])
def test_gradients_wait_once(channels, depths, deterministic, sh3, pretended_cuda):
    values = sh3.gaussians.sh if channels is None else torch.rand(len(sh3.gaussians), channels)
    here = leaves(sh3.gaussians, values)
    backward_of(rasterized(here, sh3.camera, channels=channels, depths=depths))
    there = leaves(sh3.gaussians.to("cuda"), values.to("cuda"))
    pretended_cuda.reset()
    rendering = rasterized(there, sh3.camera, channels=channels, depths=depths, deterministic=deterministic)
    backward_of(rendering)
    assert places(pretended_cuda.waits) == [COUNT]
    assert pretended_cuda.uploads == []
    assert len(pretended_cuda.launches) <= (15 if channels == 20 else 12)
    for mine, exact in zip(there, here, strict=True):
        error = (mine.grad.cpu() - exact.grad).norm() / exact.grad.norm()
        assert error < 5e-3, error


def test_a_pose_on_the_device_has_its_gradient_there(sh3, pretended_cuda):
    pose = sh3.camera.world_to_camera.clone().requires_grad_()
    here = leaves(sh3.gaussians, sh3.gaussians.sh)
    backward_of(rasterized(here, sh3.camera, pose=pose))
    pose_there = sh3.camera.world_to_camera.to("cuda").requires_grad_()
    backward_of(rasterized(leaves(sh3.gaussians.to("cuda"), sh3.gaussians.sh.to("cuda")), sh3.camera, pose=pose_there))
    assert pose_there.grad.is_cuda
    torch.testing.assert_close(pose_there.grad.cpu(), pose.grad, rtol=5e-3, atol=1e-4)


def test_without_gradients_rasterize_waits_as_a_rendering_does(sh3, pretended_cuda):
    with torch.no_grad():
        expected = rasterized(leaves(sh3.gaussians, sh3.gaussians.sh), sh3.camera, depths=True)
        there = leaves(sh3.gaussians.to("cuda"), sh3.gaussians.sh.to("cuda"))
        pretended_cuda.reset()
        rendering = rasterized(there, sh3.camera, depths=True)
    assert_same(rendering.features, expected.features)
    assert places(pretended_cuda.waits) == [COUNT]


def test_the_lanes_of_the_cpu_are_refused(sh3, pretended_cuda):
    there = leaves(sh3.gaussians.to("cuda"), sh3.gaussians.sh.to("cuda"))
    with pytest.raises(sg.InputError, match="schedule"):
        rasterized(there, sh3.camera, schedule="lanes")


@pytest.mark.parametrize("channels", [2, 20])
@pytest.mark.parametrize("gradients", [False, True])
def test_features_that_are_not_finite_stay_out_of_the_image(channels, gradients, sh3, pretended_cuda):
    """On the CPU they are refused; here looking would mean waiting, so their Gaussians are left out."""
    features = torch.rand(len(sh3.gaussians), channels)
    features[5, 0], features[7, 1] = math.nan, math.inf
    kept = torch.ones(len(features), dtype=torch.bool)
    kept[[5, 7]] = False
    without = sh3.gaussians.subset(kept)
    expected = sg.render(without, sh3.camera, "features", features[kept])
    there = leaves(sh3.gaussians.to("cuda"), features.to("cuda"))
    if gradients:
        rendering = rasterized(there, sh3.camera, channels=channels)
        backward_of(rendering)
        assert all(bool(torch.isfinite(t.grad).all()) for t in there)
        image = rendering.features.detach()
    else:
        image = sg.render(sh3.gaussians.to("cuda"), sh3.camera, "features", features.to("cuda"))
    assert_same(image, expected)


def feature_map(kind, device, size):
    height, width = size
    dice = torch.Generator().manual_seed(4)

    def rand(*shape):
        return torch.rand(*shape, generator=dice)

    def ids(limit, *shape):
        return torch.randint(-1, limit, shape, generator=dice).int().to(device)

    if kind == "dense":
        return sg.FeatureMap("s", dense=rand(height, width, 32).to(device))
    if kind == "half":
        dense = rand(height // 2, width // 2, 20).half().to(device)
        return sg.FeatureMap("s", dense=dense, valid=(rand(height // 2, width // 2) > 0.3).to(device))
    if kind == "ids":
        return sg.FeatureMap("s", ids=ids(5, 2, height // 2, width // 2), vectors=rand(5, 24).to(device))
    return sg.FeatureMap("s", ids=ids(4, height, width), labels=("a", "b", "c", "d"))


@pytest.mark.parametrize("mode", ["weighted", "center"])
@pytest.mark.parametrize("deterministic", [None, True])
@pytest.mark.parametrize("map_on", ["cpu", "cuda"])
@pytest.mark.parametrize("kind", ["dense", "half", "ids", "labels"])
def test_lifting(kind, map_on, deterministic, mode, make_scene, pretended_cuda):
    scene = make_scene("odd_size")
    here = feature_map(kind, "cpu", scene.camera.size)
    sums = LiftSums.zeros(len(scene.gaussians), here.channels, torch.device("cpu"))
    lift_view(scene.gaussians, scene.camera, here, sums, mode=mode)
    there = LiftSums.zeros(len(scene.gaussians), here.channels, torch.device("cuda"))
    maps = feature_map(kind, map_on, scene.camera.size)
    lift_view(scene.gaussians.to("cuda"), scene.camera, maps, there, mode=mode, deterministic=deterministic)
    assert_same(there.features, sums.features, 1e-3)
    assert_same(there.weight, sums.weight, 1e-3)


def test_contributors(sh3, pretended_cuda):
    ids, weights = sg.top_contributors(sh3.gaussians, sh3.camera, k=4)
    there, weights_there = sg.top_contributors(sh3.gaussians.to("cuda"), sh3.camera, k=4)
    assert_same(weights_there, weights)
    assert (there.cpu() == ids).float().mean() > 0.99


def test_the_loss_of_a_fit(pretended_cuda):
    image, truth = torch.rand(40, 50, 3), torch.rand(40, 50, 3)
    here, there = image.clone().requires_grad_(), image.to("cuda").requires_grad_()
    loss = photometric_loss(here, truth)
    loss.backward()
    loss_there = photometric_loss(there, truth.to("cuda"))
    loss_there.backward()
    assert_same(loss_there.detach(), loss.detach())
    assert_same(there.grad, here.grad)


def test_neighbors(pretended_cuda):
    points = torch.rand(300, 3)
    assert_same(mean_squared_neighbor_distance(points.to("cuda")), mean_squared_neighbor_distance(points))
    assert_same(inria.dist2(points.to("cuda")), inria.dist2(points))


def gsplat_call(gaussians, camera, device, **options):
    values = leaves(gaussians, gaussians.sh)
    pose, K = (t.float().to(device)[None] for t in (camera.world_to_camera, camera.K))
    options = {"sh_degree": gaussians.sh_degree} | options
    image, alpha, meta = gsplat.rasterization(*values, pose, K, camera.width, camera.height, **options)
    meta["means2d"].retain_grad()
    (image.square().mean() + alpha.mean()).backward()
    return image.detach(), values


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"packed": False, "render_mode": "RGB+ED", "absgrad": True, "rasterize_mode": "antialiased"},
        {"camera_model": "fisheye"},
        {"camera_model": "ortho"},
    ],
    ids=["packed", "dense", "fisheye", "ortho"],
)
def test_gsplat_rasterization(options, sh3, pretended_cuda):
    image, here = gsplat_call(sh3.gaussians, sh3.camera, "cpu", **options)
    image_there, there = gsplat_call(sh3.gaussians.to("cuda"), sh3.camera, "cuda", **options)
    assert_same(image_there, image, 1e-3)
    for mine, exact in zip(there, here, strict=True):
        assert (mine.grad.cpu() - exact.grad).norm() < 5e-3 * exact.grad.norm() + 1e-6


def test_the_facade_of_gsplat_projects_and_shades_by_kernels(sh3, pretended_cuda):
    """In torch, forward and backward took 819 launches and operations that run something."""
    there = sh3.gaussians.to("cuda")
    pretended_cuda.reset()
    gsplat_call(there, sh3.camera, "cuda")
    assert {"tabulate_splats", "gather_moments", "evaluate_harmonics", "harmonics_backward"} <= set(
        pretended_cuda.launches
    )
    assert pretended_cuda.work < 230
    assert places(pretended_cuda.waits) == ["ops/planar/tables.py", "ops/planar/tables.py", COUNT]


def gsplat_stages(gaussians, camera, device):
    pose, K = (t.float().to(device)[None] for t in (camera.world_to_camera, camera.K))
    radii, means2d, depths, conics, _ = gsplat.fully_fused_projection(
        gaussians.means, None, gaussians.quats, gaussians.scales, pose, K, camera.width, camera.height
    )
    columns, rows = -(-camera.width // 16), -(-camera.height // 16)
    _, ids, listed = gsplat.isect_tiles(means2d, radii, depths, 16, columns, rows)
    offsets = gsplat.isect_offset_encode(ids, 1, columns, rows)
    colors = torch.linspace(0, 1, 3 * len(gaussians)).view(1, -1, 3).to(device)
    opacities = gaussians.opacities[None]
    size = (camera.width, camera.height, 16)
    masks = (torch.arange(columns * rows).view(1, rows, columns) % 3 > 0).to(device)
    image, _ = gsplat.rasterize_to_pixels(means2d, conics, colors, opacities, *size, offsets, listed, masks=masks)
    ones = torch.ones(1, *camera.size).to(device)
    pairs = gsplat.rasterize_to_indices_in_range(0, 2, ones, means2d, conics, opacities, *size, offsets, listed)
    summed, _ = gsplat.accumulate(means2d, conics, opacities, colors, *pairs, *size[:2])
    covariances, _ = gsplat.quat_scale_to_covar_preci(gaussians.quats, gaussians.scales, triu=True)
    directions = gaussians.means[:5]
    shaded = gsplat.spherical_harmonics(1, directions, gaussians.sh[:5, :4], masks=gaussians.opacities[:5] > 0.5)
    return image, summed, covariances, shaded


def test_the_stages_of_gsplat(sh3, pretended_cuda):
    here = gsplat_stages(sh3.gaussians, sh3.camera, "cpu")
    for mine, exact in zip(gsplat_stages(sh3.gaussians.to("cuda"), sh3.camera, "cuda"), here, strict=True):
        assert_same(mine, exact, 1e-3)


def inria_settings(camera, device):
    tangents = [0.5 * camera.width / camera.K[0, 0].item(), 0.5 * camera.height / camera.K[1, 1].item()]
    near, far = 0.01, 100.0
    view = camera.world_to_camera.float().T.contiguous()
    projection = torch.zeros(4, 4)
    projection[0, 0], projection[1, 1] = 1 / tangents[0], 1 / tangents[1]
    projection[3, 2], projection[2, 2], projection[2, 3] = 1.0, far / (far - near), -far * near / (far - near)
    full, zeros = (view @ projection.T).to(device), torch.zeros(3).to(device)
    position = camera.position.float().to(device)
    return inria.GaussianRasterizationSettings(
        camera.height, camera.width, *tangents, zeros, 1.0, view.to(device), full, 3, position
    )


def inria_image(gaussians, settings):
    values = leaves(gaussians, gaussians.sh)
    points = torch.zeros_like(values[0]).requires_grad_()
    rasterizer = inria.GaussianRasterizer(settings)
    image, *_ = rasterizer(values[0], points, values[3][:, None], shs=values[4], scales=values[2], rotations=values[1])
    image.square().mean().backward()
    assert rasterizer.markVisible(values[0].detach()).any()
    return image.detach(), values[0].grad


def test_the_rasterizer_of_inria(make_scene, pretended_cuda):
    scene = make_scene("sh3")
    image, gradient = inria_image(scene.gaussians, inria_settings(scene.camera, "cpu"))
    image_there, gradient_there = inria_image(scene.gaussians.to("cuda"), inria_settings(scene.camera, "cuda"))
    assert_same(image_there, image, 1e-3)
    assert (gradient_there.cpu() - gradient).norm() < 5e-3 * gradient.norm()


@pytest.mark.parametrize("antialiasing", [None, True])
def test_the_facade_of_inria_projects_and_shades_by_kernels(make_scene, pretended_cuda, antialiasing):
    """In torch, forward and backward took 403 launches and operations that run something, without antialiasing."""
    scene = make_scene("sh3")
    there = scene.gaussians.to("cuda")
    settings = inria_settings(scene.camera, "cuda")._replace(antialiasing=antialiasing)
    pretended_cuda.reset()
    inria_image(there, settings)
    assert {"tabulate_splats", "gather_moments", "evaluate_harmonics", "harmonics_backward"} <= set(
        pretended_cuda.launches
    )
    assert pretended_cuda.work < 250


def test_the_antialiasing_of_inria_against_the_oracle(make_scene, pretended_cuda):
    """Image and every gradient, of small Gaussians too, against autograd in float64."""
    scene = make_scene("random_cloud")
    gaussians, camera = scene.gaussians, scene.camera
    scales = gaussians.scales.clone()
    scales[::3] *= 0.05
    gaussians = replace(gaussians, scales=scales)
    options = reference.ReferenceSettings(alpha_max=0.99, antialiased=True)
    exact = [t.detach().double().requires_grad_() for t in leaves(gaussians, gaussians.sh)]
    means, quats, scales, opacities, sh = exact
    pose = camera.world_to_camera.double()
    size = (camera.width, camera.height)
    projection = reference.project(
        means, quats, scales, opacities, pose, camera.K.double(), *size, near=0.2, settings=options
    )
    colors = reference.spherical_harmonics(means, sh, pose)
    wanted = reference.composite(projection, colors, *size, torch.zeros(3).double(), options)
    clear = wanted.margin > 1e-4
    assert clear.double().mean() > 0.9
    noise = torch.randn(*camera.size, 3, generator=torch.Generator().manual_seed(2)) * clear[..., None]
    degree = math.isqrt(gaussians.sh.shape[1]) - 1
    settings = inria_settings(camera, "cuda")._replace(antialiasing=True, sh_degree=degree)
    there = gaussians.to("cuda")
    mine = leaves(there, there.sh)
    image, _, _ = inria.GaussianRasterizer(settings)(
        mine[0], None, mine[3][:, None], shs=mine[4], scales=mine[2], rotations=mine[1]
    )
    image = image.permute(1, 2, 0)
    torch.testing.assert_close(image.detach().cpu().double()[clear], wanted.features.detach()[clear], rtol=0, atol=2e-5)
    (image * noise.to("cuda")).sum().backward()
    (wanted.features * noise.double()).sum().backward()
    for name, got, want in zip(("means", "quats", "scales", "opacities", "sh"), mine, exact, strict=True):
        error = (got.grad.cpu() - want.grad).abs().max()
        assert error <= 1e-3 * want.grad.abs().max(), f"{name}: {error}"


def test_the_gradient_of_campos(make_scene, pretended_cuda):
    """Where it is the camera's centre and where it is not, against autograd in float64."""
    scene = make_scene("sh3")
    camera, there = scene.camera, scene.gaussians.to("cuda")
    noise = torch.randn(3, *camera.size, generator=torch.Generator().manual_seed(4))
    opaque = {"scales": there.scales, "rotations": there.quats}
    for shift in (0.0, 0.4):
        settings = inria_settings(camera, "cuda")
        campos = (settings.campos.cpu() + shift).to("cuda").requires_grad_()
        pretended_cuda.reset()
        image, _ = inria.GaussianRasterizer(settings._replace(campos=campos))(
            there.means, None, there.opacities[:, None], shs=there.sh, **opaque
        )
        (image * noise.to("cuda")).sum().backward()
        assert "harmonics_backward" in pretended_cuda.launches
        # What the image says to the colors is not in question: that of the harmonics to the centre is, in float64.
        exact = campos.detach().cpu().double().requires_grad_()
        directions = torch.nn.functional.normalize(scene.gaussians.means.double() - exact, dim=1)
        basis = reference.harmonics(directions, 3)
        colors = (torch.einsum("nk,nkc->nc", basis, scene.gaussians.sh.double()) + 0.5).clamp(min=0)
        leaf = colors.detach().float().to("cuda").requires_grad_()
        again, _ = inria.GaussianRasterizer(settings)(
            there.means, None, there.opacities[:, None], colors_precomp=leaf, **opaque
        )
        torch.testing.assert_close(image.detach().cpu(), again.detach().cpu(), rtol=0, atol=2e-5)
        (again * noise.to("cuda")).sum().backward()
        colors.backward(leaf.grad.cpu().double())
        assert exact.grad.abs().max() > 0
        assert (campos.grad.cpu() - exact.grad).abs().max() <= 1e-3 * exact.grad.abs().max()


def test_inria_looks_from_campos(make_scene, pretended_cuda):
    """Wherever that is: the colors are those seen from there, and so are the gradients of the centres."""
    scene = make_scene("sh3")
    results = []
    for device in ("cpu", "cuda"):
        settings = inria_settings(scene.camera, device)
        settings = settings._replace(campos=torch.tensor([3.0, -2.0, 1.5]).to(device))
        results.append(inria_image(scene.gaussians.to(device), settings))
    (image, gradient), (image_there, gradient_there) = results
    usual = inria_image(scene.gaussians, inria_settings(scene.camera, "cpu"))[0]
    assert (image - usual).abs().max() > 0.01
    assert_same(image_there, image, 1e-3)
    assert (gradient_there.cpu() - gradient).norm() < 5e-3 * gradient.norm()


def test_a_stream_of_its_own(sh3, pretended_cuda):
    """Every launch, and the sort, goes to the stream that is torch's current one."""
    there = leaves(sh3.gaussians.to("cuda"), sh3.gaussians.sh.to("cuda"))
    with torch.cuda.stream(torch.cuda.Stream()):
        backward_of(rasterized(there, sh3.camera, depths=True))
    assert "radix_sort_pairs" in pretended_cuda.launches


def test_the_default_device_changes_nothing(sh3, stage, pretended_cuda):
    here = leaves(sh3.gaussians, sh3.gaussians.sh)
    backward_of(rasterized(here, sh3.camera, depths=True))
    there = leaves(sh3.gaussians.to("cuda"), sh3.gaussians.sh.to("cuda"))
    views = stage.views[:2]
    maps = {view.stem: stage.one_hot(view) for view in views}
    torch.set_default_device("cuda")
    try:
        backward_of(rasterized(there, sh3.camera, depths=True))
        semantics = sg.lift(stage.gaussians, views, maps)
        assert not semantics.features.is_cuda
    finally:
        torch.set_default_device(None)
    for mine, exact in zip(there, here, strict=True):
        assert (mine.grad.cpu() - exact.grad).norm() < 5e-3 * exact.grad.norm()


@pytest.mark.parametrize("kind", ["gsplat", "inria", "sg"])
def test_autocast_changes_nothing(kind, sh3, pretended_cuda):
    settings = inria_settings(sh3.camera, "cuda")

    def image():
        if kind == "gsplat":
            return gsplat_call(sh3.gaussians.to("cuda"), sh3.camera, "cuda")[0]
        if kind == "inria":
            return inria_image(sh3.gaussians.to("cuda"), settings)[0]
        there = leaves(sh3.gaussians.to("cuda"), sh3.gaussians.sh.to("cuda"))
        return rasterized(there, sh3.camera).features.detach()

    expected = image()
    with torch.autocast("cuda", dtype=torch.bfloat16):
        seen = image()
    torch.testing.assert_close(seen.cpu(), expected.cpu(), rtol=0, atol=0)


def test_inference_mode_changes_nothing(sh3, pretended_cuda):
    expected = sg.render(sh3.gaussians.to("cuda"), sh3.camera)
    with torch.inference_mode():
        seen = sg.render(sh3.gaussians.to("cuda"), sh3.camera)
    torch.testing.assert_close(seen.cpu(), expected.cpu(), rtol=0, atol=0)
