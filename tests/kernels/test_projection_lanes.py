"""Projection of 16 Gaussians at a time is that of one at a time, forward and backward, whatever the input."""

import pytest
import torch
import warp as wp

from sgwarp.kernels.native import GROUP
from sgwarp.kernels.projection import backward as projection_backward
from sgwarp.kernels.projection import forward as projection
from sgwarp.kernels.projection import lanes as projection_lanes
from sgwarp.kernels.projection import lanes_backward as projection_lanes_backward
from sgwarp.ops.arguments import view
from sgwarp.ops.launcher import launch
from sgwarp.ops.splatting import tiles
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.scene import Camera, Gaussians

CPU = torch.device("cpu")
FIELDS = ("x", "y", "a", "b", "c", "level", "depth", "half width", "half height", "reach", "summit", "1 / bc")


def cloud(count: int, scale: float, spread: float, broken: bool, seed: int = 0) -> Gaussians:
    g = torch.Generator().manual_seed(seed)
    scene = Gaussians.unchecked(
        means=spread * torch.randn(count, 3, generator=g) + torch.tensor([0.0, 0.0, 2.0]),
        quats=torch.randn(count, 4, generator=g) * torch.exp(torch.randn(count, 1, generator=g)),
        scales=scale * torch.exp(2 * torch.randn(count, 3, generator=g)),
        opacities=torch.rand(count, generator=g) ** 2,
        sh=torch.zeros(count, 1, 3),
    )
    if broken:
        bad = [float("nan"), float("inf"), -float("inf"), 1e38, 0.0, -1.0, 3e38, 1e-38]
        for tensor in (scene.means, scene.quats, scene.scales, scene.opacities):
            rows = torch.randint(count, (count // 12,), generator=g)
            flat = tensor.view(count, -1)
            columns = torch.randint(flat.shape[1], rows.shape, generator=g)
            flat[rows, columns] = torch.tensor(bad)[torch.randint(len(bad), rows.shape, generator=g)]
        scene.quats[5] = 0.0
    return scene


def camera() -> Camera:
    K = torch.tensor([[300.0, 0, 170], [0, 310, 110], [0, 0, 1]], dtype=torch.float64)
    return Camera(K=K, world_to_camera=torch.eye(4, dtype=torch.float64), width=320, height=240)


CASES = [
    (1, 0.05, 1.0, False),
    (15, 0.05, 1.0, False),
    (33, 0.05, 1.0, True),
    (4000, 0.02, 1.0, True),
    (4000, 1.0, 30.0, True),
    (4000, 1e-4, 1.0, False),
]


def inputs(scene: Gaussians, settings: RasterSettings, degree: int | None = None) -> list:
    arrays = [view(scene.means, wp.vec3), view(scene.quats, wp.vec4), view(scene.scales, wp.vec3)]
    arrays += [view(scene.opacities, wp.float32)] + ([] if degree is None else [view(scene.sh, wp.vec3), degree])
    return [*arrays, tiles.pinhole(camera()), tiles.knobs(settings)]


def project(scene: Gaussians, settings: RasterSettings, kernel: wp.Kernel, count: int, degree: int | None = None):
    n = len(scene)
    memory, status = torch.zeros(16 * n, dtype=torch.int32), torch.zeros(n, dtype=torch.uint8)
    depths = torch.zeros(n)
    outputs = [tiles.view_splats(memory), view(status, wp.uint8), view(depths, wp.float32)]
    if degree is not None:
        outputs.append(view(torch.zeros(1, dtype=torch.int32), wp.int32))
    launch(kernel, count, inputs(scene, settings, degree), outputs, device=CPU)
    return memory.view(torch.float32).view(n, 16)[:, : len(FIELDS)], status, depths


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("case", CASES, ids=str)
def test_splats(case, antialiased):
    scene, settings = cloud(*case), RasterSettings(antialiased=antialiased)
    n = len(scene)
    one, status, depths = project(scene, settings, projection.project_gaussians, n)
    groups = -(-n // GROUP)
    many, status_16, depths_16 = project(scene, settings, projection_lanes.project_groups, groups, -1)
    # At a threshold rounding may decide; it does not here.
    assert torch.equal(status, status_16)
    if n > 1000:
        assert len(status.unique()) >= 3
    seen = status == int(projection.VISIBLE)
    torch.testing.assert_close(depths_16[seen], depths[seen], rtol=1e-6, atol=0)
    for field, name in enumerate(FIELDS):
        # A shear or a summit is a difference: measured against what it is the difference of.
        size = one[:, [2, 4]].abs().amax(dim=1) if name == "b" else one[:, field].abs()
        size = one[:, 8] if name == "summit" else size
        error = (many[:, field] - one[:, field]).abs() / (size + 1e-3)
        assert float(error[seen].amax() if bool(seen.any()) else 0.0) < 1e-5, name


@pytest.mark.parametrize(("antialiased", "pose", "at_depth"), [(False, False, -1), (True, True, 9)])
@pytest.mark.parametrize("case", CASES, ids=str)
def test_gradients(case, antialiased, pose, at_depth):
    scene, settings = cloud(*case), RasterSettings(antialiased=antialiased)
    n = len(scene)
    _, status, _ = project(scene, settings, projection.project_gaussians, n)
    sums = torch.randn(n, 16, generator=torch.Generator().manual_seed(1))
    sums[:, 15] = (status == int(projection.VISIBLE)).float()
    results = []
    kernels = [
        (projection_backward.project_backward, n),
        (projection_lanes_backward.project_groups_backward, -(-n // GROUP)),
    ]
    for kernel, count in kernels:
        shapes = ((n, 3), (n, 4), (n, 3), (n,), (n, 2), (n if pose else 0, projection_backward.POSE_COLUMNS))
        outputs = [torch.full(shape, 7.0) for shape in shapes]
        types = (wp.vec3, wp.vec4, wp.vec3, wp.float32, wp.vec2, wp.float32)
        arrays = [view(tensor, dtype) for tensor, dtype in zip(outputs, types, strict=True)]
        launch(kernel, count, [*inputs(scene, settings), view(sums, wp.float32), at_depth], arrays, device=CPU)
        results.append(outputs)
    left_out = sums[:, 15] == 0
    for one, many in zip(*results, strict=True):
        if not len(one):  # no pose was asked for
            continue
        assert bool((many[left_out] == 0).all())
        assert bool(torch.isfinite(many).all())
        one, many = one.view(n, -1), many.view(n, -1)
        error = (many - one).abs().amax(dim=1) / one.abs().amax(dim=1).clamp(min=1e-6)
        assert float(error.max()) < 2e-3


@pytest.mark.parametrize(("coefficients", "degree"), [(1, 0), (4, 1), (9, 2), (16, 3), (16, 1)])
@pytest.mark.parametrize("case", CASES, ids=str)
def test_colors_on_the_way(case, coefficients, degree):
    """Those of `evaluate_harmonics` for what is visible; a coefficient in use that is not finite hides its Gaussian."""
    scene, settings = cloud(*case), RasterSettings()
    n, g = len(scene), torch.Generator().manual_seed(2)
    sh = torch.randn(n, coefficients, 3, generator=g)
    broken = torch.rand(n, generator=g) < 0.1
    spots = torch.randint(3 * coefficients, (n,), generator=g)
    bad = torch.tensor([torch.nan, torch.inf, -torch.inf])[torch.arange(n) % 3]
    sh.view(n, -1)[broken, spots[broken]] = bad[broken]
    sh[torch.arange(n) % 7 == 0] *= 3e38  # large, where not infinite
    scene = Gaussians.unchecked(scene.means, scene.quats, scene.scales, scene.opacities, sh)
    groups = -(-n // GROUP)
    _, status, _ = project(scene, settings, projection_lanes.project_groups, groups, -1)
    memory, status_out = torch.zeros(16 * n, dtype=torch.int32), torch.zeros(n, dtype=torch.uint8)
    outputs = [tiles.view_splats(memory), view(status_out, wp.uint8), view(torch.zeros(n), wp.float32)]
    outputs.append(view(torch.zeros(1, dtype=torch.int32), wp.int32))
    launch(projection_lanes.project_groups, groups, inputs(scene, settings, degree), outputs, device=CPU)
    usable = torch.isfinite(sh[:, : (degree + 1) ** 2]).flatten(1).all(dim=1)
    seen = status == int(projection.VISIBLE)
    hidden = torch.full_like(status, int(projection.NON_FINITE))
    assert torch.equal(status_out, torch.where(seen & ~usable, hidden, status))
    order = (seen & usable).nonzero().flatten().to(torch.int32)
    colors = memory.view(torch.float32).view(n, 16)[order.long(), 13:]
    torch.testing.assert_close(colors, tiles.shade(scene, camera(), order, degree), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("field", ["scales", "opacities"])
@pytest.mark.parametrize("value", [-1e-6, 1.0, 1.001, float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("at", [0, 15, 16, 32])
def test_what_no_scene_may_hold_is_noticed(field, value, at):
    """A negative scale, an opacity outside [0, 1], wherever it is; NaN is not taken for one."""
    scene = cloud(33, 0.05, 1.0, False)
    values = getattr(scene, field).clone()
    values.view(33, -1)[at, -1] = value
    fields = {name: getattr(scene, name) for name in ("means", "quats", "scales", "opacities", "sh")} | {field: values}
    projected = tiles.project(Gaussians.unchecked(**fields), camera(), RasterSettings())
    assert bool(projected.invalid[0]) == (value < 0 or (field == "opacities" and value > 1))


@pytest.mark.parametrize("place", range(3))
@pytest.mark.parametrize("other", range(4))
def test_a_negative_scale_beside_nan_is_noticed(place, other):
    """NaN in another scale or in the opacity of the same Gaussian does not hide it."""
    scene = cloud(33, 0.05, 1.0, False)
    scales, opacities = scene.scales.clone(), scene.opacities.clone()
    scales[20, place] = -1.0
    if other == 3:
        opacities[20] = torch.nan
    elif other != place:
        scales[20, other] = torch.nan
    scene = Gaussians.unchecked(scene.means, scene.quats, scales, opacities, scene.sh)
    assert tiles.project(scene, camera(), RasterSettings()).invalid[0]


@pytest.mark.parametrize("n", [0, 1, 5000])
def test_depth_order(n):
    """By depth, those at the same depth by index; whatever sign, however near."""
    g = torch.Generator().manual_seed(3)
    depths = torch.randn(n, generator=g) * 10.0 ** torch.randint(-30, 30, (n,), generator=g)
    depths[: n // 2] = depths[: n // 2].sign() * torch.randint(1, 9, (n // 2,), generator=g)
    status = torch.randint(0, 3, (n,), generator=g).to(torch.uint8)
    counted = torch.full((len(projection.STATUS_NAMES),), -1)
    projected = tiles.Projected(tiles.view_splats(torch.zeros(16 * n, dtype=torch.int32)), status, depths, counted)
    order = tiles.depth_order(projected).clone()
    assert projected.counts().tolist() == [int((status == k).sum()) for k in range(len(counted))]
    expected = sorted((depth, i) for i, depth in enumerate(depths.tolist()) if status[i] == int(projection.VISIBLE))
    assert order.tolist() == [i for _, i in expected]
