"""Input channels, voxels of a scene, and augmentation in which everything follows the centres."""

import math
from dataclasses import replace

import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.network.augmentation import Augmentation, bend, transformed
from sgwarp.network.inputs import INPUT_CHANNELS, input_features, voxelize
from sgwarp.ops.deformation import deformed
from sgwarp.ops.planar.harmonics import harmonics_basis
from sgwarp.ops.reference import rasterizer as reference
from sgwarp.rendering.renderer import render
from sgwarp.scene import Camera, Gaussians


def scene(count: int = 200, degree: int = 3, seed: int = 0) -> Gaussians:
    g = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.randn(count, 3, generator=g) * torch.tensor([1.0, 0.8, 0.6]),
        quats=torch.randn(count, 4, generator=g),
        scales=torch.exp(torch.randn(count, 3, generator=g) - 3),
        opacities=torch.rand(count, generator=g),
        sh=0.3 * torch.randn(count, (degree + 1) ** 2, 3, generator=g),
    )


def covariances(gaussians: Gaussians) -> torch.Tensor:
    R = reference.rotation_matrices(gaussians.quats.double())
    M = R * gaussians.scales.double()[:, None, :]
    return M @ M.transpose(1, 2)


def similarity(seed: int, mirrored: bool, factor: float = 1.3) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    Q = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=g)).Q
    return Q * (torch.linalg.det(Q).sign() * (-1 if mirrored else 1)) * factor


CASES = [(0, False), (1, False), (2, True), (3, True)]


@pytest.mark.parametrize(("seed", "mirrored"), CASES)
def test_covariances_are_transformed_with_the_centres(seed, mirrored):
    before, A = scene(), similarity(seed, mirrored)
    after = transformed(before, A)
    torch.testing.assert_close(after.means.double(), before.means.double() @ A.T, rtol=1e-6, atol=1e-6)
    expected = A @ covariances(before) @ A.T
    torch.testing.assert_close(covariances(after), expected, rtol=1e-4, atol=1e-6 * float(expected.abs().max()))


@pytest.mark.parametrize(("seed", "mirrored"), CASES)
def test_colours_are_transformed_with_the_centres(seed, mirrored):
    """The colour seen along a turned direction is that seen along the direction before."""
    before, A = scene(), similarity(seed, mirrored, factor=1.0)
    after = transformed(before, A)
    d = torch.nn.functional.normalize(torch.randn(50, 3, dtype=torch.float64), dim=1)
    old = torch.einsum("dk,nkc->ndc", harmonics_basis(d, 3), before.sh.double())
    new = torch.einsum("dk,nkc->ndc", harmonics_basis(d @ A.T, 3), after.sh.double())
    torch.testing.assert_close(new, old, rtol=0, atol=1e-5)


def test_a_turned_scene_looks_the_same_to_a_turned_camera():
    before, A = scene(), similarity(5, False, factor=1.0)
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = 4.0
    K = torch.tensor([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
    turned = pose.clone()
    turned[:3, :3] = pose[:3, :3] @ A.T
    one = render(before, Camera(K, pose, 64, 48))
    other = render(transformed(before, A), Camera(K, turned, 64, 48))
    assert float((one - other).abs().max()) < 1e-3
    assert float(one.std()) > 0.05


@pytest.mark.parametrize(
    "bad", [torch.diag(torch.tensor([1.0, 2.0, 1.0])), torch.zeros(3, 3), torch.full((3, 3), math.nan)]
)
def test_a_matrix_that_shears_is_refused(bad):
    with pytest.raises(InputError, match="rotation or mirroring"):
        transformed(scene(3), bad)


@pytest.mark.parametrize("seed", range(4))
def test_full_inputs_follow_the_covariance(seed):
    """Under a turn the root of the covariance turns; opacity and colour stay."""
    before, A = scene(), similarity(seed, mirrored=seed % 2 == 1, factor=1.0)
    after = transformed(before, A)

    def parts(gaussians):
        x = input_features(gaussians, "full", 0.05)
        upper = torch.zeros(len(x), 3, 3)
        for column, (i, j) in enumerate([(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]):
            upper[:, i, j] = upper[:, j, i] = x[:, 4 + column]
        return x[:, :1], upper.double()

    (opacity, root), (opacity_after, root_after) = parts(before), parts(after)
    torch.testing.assert_close(root_after, A @ root @ A.T, rtol=0, atol=1e-5)
    assert torch.equal(opacity, opacity_after)
    assert float(root.abs().max()) < 1


def test_full_inputs_are_the_root_of_the_covariance():
    gaussians = scene()
    x = input_features(gaussians, "full", 0.05).double()
    root = x[:, [4, 5, 6, 5, 7, 8, 6, 8, 9]].view(-1, 3, 3)
    squared = root @ root
    size = gaussians.scales.double().norm(dim=1)[:, None, None] / 0.05
    torch.testing.assert_close(squared * (1 + size) ** 2 * 0.05**2, covariances(gaussians), rtol=1e-3, atol=1e-7)


def test_raw_inputs_are_what_a_ply_file_stores():
    gaussians = scene(5)
    x = input_features(gaussians, "raw56", 0.02)
    assert torch.allclose(torch.sigmoid(x[:, 0]), gaussians.opacities, atol=1e-5)
    assert torch.equal(x[:, 1:4], gaussians.sh[:, 0])
    assert torch.equal(x[:, 4:19], gaussians.sh[:, 1:, 0])  # f_rest: all of red, then green, then blue
    assert torch.equal(x[:, 34:49], gaussians.sh[:, 1:, 2])
    assert torch.allclose(x[:, 49:52].exp(), gaussians.scales)
    assert torch.equal(x[:, 52:], gaussians.quats)
    plain = input_features(scene(5, degree=0), "raw56", 0.02)
    assert not plain[:, 4:49].any()


def test_raw_inputs_keep_faint_and_opaque_gaussians_apart():
    opacities = torch.tensor([1e-4, 1e-3, 5e-3, 0.995, 0.999])
    logit = input_features(replace(scene(5), opacities=opacities), "raw56", 0.02)[:, 0]
    exact = torch.tensor([math.log(a / (1 - a)) for a in opacities.tolist()])
    torch.testing.assert_close(logit, exact, rtol=0, atol=1e-3)


@pytest.mark.parametrize("mode", list(INPUT_CHANNELS))
def test_inputs_are_finite_for_flat_transparent_and_opaque_gaussians(mode):
    gaussians = scene(4)
    extreme = Gaussians(
        gaussians.means,
        gaussians.quats,
        torch.tensor([[0.0, 0, 0], [1e4, 1e-7, 0], [1e-7] * 3, [1.0] * 3]),
        torch.tensor([0.0, 1.0, 0.5, 1e-30]),
        gaussians.sh,
    )
    x = input_features(extreme, mode, 0.02)
    assert x.shape == (4, INPUT_CHANNELS[mode])
    assert bool(torch.isfinite(x).all())


def test_unknown_inputs_are_refused():
    with pytest.raises(InputError, match="full, xyz-rgb, raw56, ones, signed-rgb"):
        input_features(scene(1), "rgb", 0.02)


def test_voxels_hold_the_mean_of_their_gaussians():
    gaussians = scene(500)
    voxels, rows = voxelize(gaussians, "xyz-rgb", 0.3)
    features = input_features(gaussians, "xyz-rgb", 0.3)
    assert 1 < len(voxels.features) < 500
    for row in range(len(voxels.features)):
        torch.testing.assert_close(voxels.features[row], features[rows == row].mean(dim=0))
    low = voxels.coordinates[rows, 1:].double() * 0.3
    inside = gaussians.means.double() - low - (gaussians.means.double() - low).min(dim=0).values
    assert float(inside.max()) < 0.3 + 1e-6


def test_gaussians_without_a_voxel():
    gaussians = scene(6)
    means, quats = gaussians.means.clone(), gaussians.quats.clone()
    means[0, 0], means[1, 1], means[2, 2] = math.nan, math.inf, 1e9
    quats[3] = 0
    opacities = gaussians.opacities
    broken = Gaussians(means, quats, gaussians.scales, opacities, gaussians.sh)
    voxels, rows = voxelize(broken, "full", 0.02)
    assert (rows == -1).tolist() == [True] * 4 + [False] * 2
    assert bool(torch.isfinite(voxels.features).all())


def test_a_scene_far_from_the_origin_has_the_same_voxels():
    gaussians = scene(300)
    far = Gaussians(gaussians.means + 65536.0, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    near = Gaussians(far.means - 65536.0, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    one, other = voxelize(near, "full", 0.0625), voxelize(far, "full", 0.0625)
    assert torch.equal(one.rows, other.rows)
    assert torch.equal(one.voxels.grid.keys(1), other.voxels.grid.keys(1))


def test_scenes_without_any_voxel_are_refused():
    gaussians = scene(2)
    with pytest.raises(InputError, match="voxel: expected a size"):
        voxelize(gaussians, "full", 0.0)
    nowhere = Gaussians(
        gaussians.means * math.nan, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh
    )
    with pytest.raises(InputError, match="all finite"):
        voxelize(nowhere, "full", 0.02)


def test_augmentation_repeats_with_its_generator_and_keeps_to_its_bounds():
    gaussians = scene(100)
    augment = Augmentation(up=1, elastic=())
    one, two = (augment(gaussians, 0.02, torch.Generator().manual_seed(k)) for k in (1, 1))
    other = augment(gaussians, 0.02, torch.Generator().manual_seed(2))
    assert torch.equal(one.means, two.means)
    assert not torch.equal(one.means, other.means)
    for seed in range(20):
        changed = augment(gaussians, 0.02, torch.Generator().manual_seed(seed))
        factor = (changed.scales / gaussians.scales).mean()
        assert 0.9 <= float(factor) <= 1.1
        spread = changed.means - changed.means.mean(dim=0)
        before = (gaussians.means - gaussians.means.mean(dim=0)) * factor
        # Only the tilt, at most pi/64 around each of two axes, moves points up or down.
        tilt = (spread[:, 1] - before[:, 1]).abs() / before.norm(dim=1)
        assert float(tilt.max()) < 2 * math.pi / 64
        assert float((changed.means.mean(dim=0)).abs().max()) < 2.0 + 2.0 * 1.1


def test_bending_is_smooth_and_has_no_border():
    g = torch.Generator().manual_seed(0)
    line = torch.zeros(4000, 3)
    line[:, 0] = torch.linspace(-40, 40, 4000)
    moved, _ = bend(line, 0.8, 1.6, g)
    assert 0.02 < float(moved.std()) < 1.6
    assert float((moved[1:] - moved[:-1]).norm(dim=1).max()) < 0.05  # over 2 cm
    far = torch.tensor([[math.nan, 0, 0], [1e9, 0, 0], [-1e9, 1, 1]])
    out, _ = bend(far, 0.2, 0.4, g)
    assert torch.isnan(out[0]).all()
    assert torch.isfinite(out[1:]).all()


def test_derivatives_of_the_bending_are_those_of_finite_differences():
    points = 8 * torch.rand(200, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    points = points[((points / 0.8).frac() - 0.5).abs().amax(dim=1) < 0.49]  # not where a cell of the lattice ends

    def moved(p: torch.Tensor) -> torch.Tensor:
        return bend(p, 0.8, 1.6, torch.Generator().manual_seed(5))[0]

    _, gradient = bend(points, 0.8, 1.6, torch.Generator().manual_seed(5))
    for axis in range(3):
        step = 1e-4 * torch.eye(3, dtype=torch.float64)[axis]
        difference = (moved(points + step) - moved(points - step)) / 2e-4
        torch.testing.assert_close(gradient[:, :, axis], difference, rtol=0, atol=1e-7)
    assert float(gradient.abs().max()) > 0.1


@pytest.mark.parametrize("thin", [1.0, 1e-3])
def test_bent_covariances_are_those_of_the_jacobian(thin):
    gaussians = scene(300)
    gaussians = replace(gaussians, scales=gaussians.scales * torch.tensor([1.0, 1.0, thin]))
    jacobians = torch.eye(3) + 0.3 * torch.randn(300, 3, 3, generator=torch.Generator().manual_seed(0))
    bent = deformed(gaussians, gaussians.means, jacobians)

    expected = jacobians.double() @ covariances(gaussians) @ jacobians.double().transpose(1, 2)
    size = expected.diagonal(dim1=1, dim2=2).sum(1)
    error = (covariances(bent) - expected).abs().amax(dim=(1, 2)) / size
    assert float(error.max()) < 1e-5
    # The smallest axis too, of which the covariance says little: its share of the volume.
    volume = torch.linalg.det(jacobians.double()).abs() * gaussians.scales.double().prod(dim=1)
    torch.testing.assert_close(bent.scales.double().prod(dim=1), volume, rtol=5e-3, atol=0)


def test_elastic_augmentation_bends_shapes_with_their_centres():
    gaussians = scene(400)
    plain = Augmentation(up=1, tilt=0, turn=0, scale=(1.0, 1.0), mirror=False, shift=0)
    bent = plain(gaussians, 0.02, torch.Generator().manual_seed(1))
    change = bent.scales.prod(dim=1) / gaussians.scales.prod(dim=1)
    assert float((bent.means - gaussians.means).norm(dim=1).mean()) > 0.01
    assert 0.02 < float(change.log().std()) < 1


def test_deformations_that_do_not_fit_are_refused():
    gaussians = scene(5)
    with pytest.raises(InputError, match=r"expected means \[5, 3\]"):
        deformed(gaussians, gaussians.means[1:], torch.eye(3).expand(5, 3, 3))


def test_a_map_that_changes_nothing_leaves_quaternions_and_scales():
    gaussians = scene(400)
    same = deformed(gaussians, gaussians.means, torch.eye(3).expand(400, 3, 3))
    apart = (gaussians.scales.sort(dim=1).values.diff(dim=1) / gaussians.scales.amax(dim=1, keepdim=True)).amin(dim=1)
    clear = apart > 0.02  # of two equal axes, neither is the first
    assert float(clear.float().mean()) > 0.5
    unit = torch.nn.functional.normalize(gaussians.quats, dim=1)
    torch.testing.assert_close(same.scales, gaussians.scales, rtol=1e-3, atol=0)
    torch.testing.assert_close(same.quats[clear], unit[clear], rtol=0, atol=1e-3)


@pytest.mark.parametrize("mode", INPUT_CHANNELS)
def test_gaussians_with_extreme_values_do_not_drown_their_neighbours(mode):
    gaussians = scene(100)
    plain = input_features(gaussians, mode, 0.02)
    scales, sh = gaussians.scales.clone(), gaussians.sh.clone()
    scales[0, 0], scales[1], sh[2] = 1e38, 1e25, 3e38
    features = input_features(replace(gaussians, scales=scales, sh=sh), mode, 0.02)
    assert bool(torch.isfinite(features).all())
    assert float(features.abs().max()) <= 100
    torch.testing.assert_close(features[3:], plain[3:])


def test_inputs_of_openscene():
    gaussians = scene(50)
    assert bool((input_features(gaussians, "ones", 0.02) == 1).all())
    signed = input_features(gaussians, "signed-rgb", 0.02)
    torch.testing.assert_close(signed, (2 * input_features(gaussians, "xyz-rgb", 0.02) - 1).clamp(-1, 1))
