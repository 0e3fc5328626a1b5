"""What a splat's rows of sums become: colour and projection of 16 Gaussians at a time, apart and in one kernel."""

import pytest
import torch
import warp as wp

from sgwarp.kernels.compositing import lanes_sums
from sgwarp.kernels.compositing.lanes_backward import MOMENTS
from sgwarp.kernels.harmonics import backward as harmonics_backward
from sgwarp.kernels.harmonics import lanes as harmonics_lanes
from sgwarp.kernels.native import GROUP
from sgwarp.kernels.projection import lanes_backward
from sgwarp.kernels.transmittance import Lanes
from sgwarp.ops.arguments import view
from sgwarp.ops.launcher import launch
from sgwarp.ops.reference import rasterizer as reference
from sgwarp.ops.splatting import tiles
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.scene import Camera, Gaussians

CPU = torch.device("cpu")
SEEN = 15


def camera() -> Camera:
    K = torch.tensor([[300.0, 0, 170], [0, 310, 110], [0, 0, 1]], dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([0.1, -0.2, 4.0])
    return Camera(K=K, world_to_camera=pose, width=320, height=240)


def cloud(n: int, coefficients: int) -> Gaussians:
    g = torch.Generator().manual_seed(n + coefficients)
    means, quats = torch.randn(n, 3, generator=g), torch.randn(n, 4, generator=g)
    scales, opacities = 0.1 * torch.rand(n, 3, generator=g) + 0.01, torch.rand(n, generator=g)
    return Gaussians.unchecked(means, quats, scales, opacities, torch.randn(n, coefficients, 3, generator=g))


def rows_of_sums(n: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Ranges [N + 1, 2], used [R] and rows [R, 16]; no, one, two or more rows each, and garbage in those not used."""
    g = torch.Generator().manual_seed(n)
    counts = torch.randint(0, 6, (n,), generator=g)
    starts = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
    ranges = torch.stack([starts, torch.cat([counts, counts.new_zeros(1)])], dim=1).to(torch.int32)
    total = int(starts[-1])
    used = torch.randint(0, 2, (total,), generator=g).to(torch.uint8)
    rows = torch.randn(total, 16, generator=g)
    rows[:, 12:] = 0  # no column of the rows
    rows[used == 0] = torch.nan
    return ranges, used, rows


def sums_of(ranges: torch.Tensor, used: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
    """By hand: the used rows of each Gaussian in float64, with the mark of who was seen, [N, 16]."""
    n = len(ranges) - 1
    sums = torch.zeros(n, 16, dtype=torch.float64)
    owner = torch.repeat_interleave(torch.arange(n), ranges[:n, 1].long())[used != 0]
    sums.index_add_(0, owner, rows[used != 0].double())
    sums[owner, SEEN] = 1.0
    return sums


def shade_backward(kernel, count, scene, degree, sums, start, offsets):
    v_sh, v_means = torch.full_like(scene.sh, 7.0), start.clone()
    v_offsets = torch.full((len(scene) if offsets else 0, 3), 7.0)
    inputs = [view(scene.means, wp.vec3), view(scene.sh, wp.vec3), degree, tiles.pinhole(camera())]
    inputs += [view(sums, wp.float32), MOMENTS]
    outputs = [view(v_sh, wp.vec3), view(v_means, wp.vec3), view(v_offsets, wp.float32)]
    launch(kernel, count, inputs, outputs, device=CPU)
    return v_sh, v_means, v_offsets


@pytest.mark.parametrize("n", [1, 15, 16, 333])
@pytest.mark.parametrize(("coefficients", "degree"), [(1, 0), (4, 1), (9, 2), (9, 1), (16, 3), (16, 2), (16, 0)])
def test_colour_of_16_is_that_of_one_at_a_time(n, coefficients, degree):
    scene, sums = cloud(n, coefficients), torch.randn(n, 16, generator=torch.Generator().manual_seed(1))
    sums[:, SEEN] = (torch.arange(n) % 3 > 0).float() if n < 300 else (torch.arange(n) % 64 > 20).float()
    scene.means[sums[:, SEEN] == 0] = torch.nan  # nobody looks there
    start = torch.randn(n, 3, generator=torch.Generator().manual_seed(2))
    one = shade_backward(harmonics_backward.harmonics_backward, n, scene, degree, sums, start, True)
    groups = -(-n // GROUP)
    many = shade_backward(harmonics_lanes.shade_groups_backward, groups, scene, degree, sums, start, True)
    for expected, got in zip(one, many, strict=True):
        torch.testing.assert_close(got, expected, rtol=2e-5, atol=2e-5)
    assert not many[0][sums[:, SEEN] == 0].any()
    assert not many[0][:, (degree + 1) ** 2 :].any()


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gradient_of_colours_is_that_of_the_oracle(degree):
    n = 200
    scene, sums = cloud(n, 16), torch.randn(n, 16, generator=torch.Generator().manual_seed(1))
    sums[:, SEEN] = 1.0
    leaves = [t.double().requires_grad_() for t in (scene.means, scene.sh)]
    used = leaves[1][:, : (degree + 1) ** 2]
    colors = reference.spherical_harmonics(leaves[0], used, camera().world_to_camera)
    colors.backward(sums[:, MOMENTS : MOMENTS + 3].double())
    groups = -(-n // GROUP)
    kernel = harmonics_lanes.shade_groups_backward
    v_sh, v_means, v_offsets = shade_backward(kernel, groups, scene, degree, sums, torch.zeros(n, 3), True)
    torch.testing.assert_close(v_sh.double(), leaves[1].grad, rtol=1e-5, atol=1e-5)
    v_expected = torch.zeros(n, 3, dtype=torch.float64) if leaves[0].grad is None else leaves[0].grad
    torch.testing.assert_close(v_means.double(), v_expected, rtol=1e-4, atol=1e-4)
    assert torch.equal(v_means, v_offsets)


@pytest.mark.parametrize("n", [1, 17, 500])
def test_sums_leave_out_rows_that_nobody_wrote(n):
    ranges, used, rows = rows_of_sums(n)
    sums, features = torch.full((n, 16), 7.0), torch.full((n, 1, 16), 7.0)
    arrays = [view(ranges, wp.int32), view(used, wp.uint8)]
    launch(lanes_sums.sum_used_rows, n, [*arrays, view(rows, Lanes)], [view(sums, Lanes)], device=CPU)
    inputs = [*arrays, view(rows.unsqueeze(1), Lanes)]
    launch(lanes_sums.sum_used_features, n, inputs, [view(features, Lanes)], device=CPU)
    expected = sums_of(ranges, used, rows)
    torch.testing.assert_close(sums.double(), expected, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(features[:, 0, :12].double(), expected[:, :12], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(("asked", "at_depth"), [(False, -1), (True, 9)])
@pytest.mark.parametrize("shift", [0, 1])
@pytest.mark.parametrize(("n", "coefficients", "degree"), [(1, 16, 3), (77, 4, 1), (400, 16, 3), (400, 16, 1)])
def test_one_kernel_does_what_three_do(n, coefficients, degree, shift, asked, at_depth):
    scene, settings = cloud(n, coefficients), RasterSettings()
    ranges, used, rows = rows_of_sums(n)
    sums = torch.empty(n, 16)
    arrays = [view(ranges, wp.int32), view(used, wp.uint8), view(rows, Lanes)]
    launch(lanes_sums.sum_used_rows, n, arrays, [view(sums, Lanes)], device=CPU)
    unseen = sums[:, SEEN] == 0
    assert n == 1 or 0 < int(unseen.sum()) < n

    shapes = ((n, 3), (n, 4), (n, 3), (n,), (n if asked else 0, 2), (n if asked else 0, 12))
    types = (wp.vec3, wp.vec4, wp.vec3, wp.float32, wp.vec2, wp.float32)
    shape = [view(scene.means, wp.vec3), view(scene.quats, wp.vec4), view(scene.scales, wp.vec3)]
    shape += [view(scene.opacities, wp.float32)]
    seen_by = [tiles.pinhole(camera()), tiles.knobs(settings)]

    def outputs(shapes=shapes):
        tensors = [torch.full(shape, 7.0) for shape in shapes]
        return tensors, [view(tensor, dtype) for tensor, dtype in zip(tensors, types, strict=True)]

    apart, into = outputs(((n, 3), (n, 4), (n, 3), (n,), (n, 2), shapes[5]))
    groups = -(-n // GROUP)
    inputs = [*shape, *seen_by, view(sums, wp.float32), at_depth]
    launch(lanes_backward.project_groups_backward, groups, inputs, into, device=CPU)
    kernel = harmonics_lanes.shade_groups_backward
    v_sh, v_means, v_offsets = shade_backward(kernel, groups, scene, degree, sums, apart[0], asked)

    together, into = outputs()
    # Wherever the gradient of the coefficients starts: at a line of the cache or not.
    room = torch.full((scene.sh.numel() + 17,), 7.0)
    start = -room.data_ptr() // 4 % 16 + shift
    spread = room[start : start + scene.sh.numel()].view_as(scene.sh)
    offsets = torch.full_like(v_offsets, 7.0)
    more = [view(spread, wp.vec3), *into[4:], view(offsets, wp.float32)]
    inputs = [*shape, view(scene.sh, wp.vec3), degree, *seen_by, *arrays, MOMENTS, at_depth]
    launch(lanes_backward.differentiate_groups, groups, inputs, [*into[:4], *more], device=CPU)
    expected = [v_means, *apart[1:4], v_sh, v_offsets] + ([apart[4], apart[5]] if asked else [])
    got = [*together[:4], spread, offsets] + ([together[4], together[5]] if asked else [])
    for one, other in zip(expected, got, strict=True):
        torch.testing.assert_close(other, one, rtol=1e-4, atol=1e-4 * float(one.abs().max()) if one.numel() else 0)
        assert not len(other) or not other[unseen].any()
    assert (room[:start] == 7.0).all()
    assert (room[start + scene.sh.numel() :] == 7.0).all()
