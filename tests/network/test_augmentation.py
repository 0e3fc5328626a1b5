"""The random changes of a training scene, one by one, and the field that bends it against its closed form."""

import math
from dataclasses import replace

import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.network import augmentation
from sgwarp.network.augmentation import Augmentation, bend, transformed
from sgwarp.ops.planar.harmonics import harmonics_basis
from sgwarp.scene import Gaussians

STILL = Augmentation(up=1, tilt=0.0, turn=0.0, scale=(1.0, 1.0), mirror=False, elastic=(), shift=0.0)
VOXEL = 0.05


@pytest.fixture
def gaussians() -> Gaussians:
    g = torch.Generator().manual_seed(0)
    return Gaussians(
        means=torch.randn(40, 3, generator=g),
        quats=torch.randn(40, 4, generator=g),
        scales=torch.exp(torch.randn(40, 3, generator=g) - 3),
        opacities=torch.rand(40, generator=g),
        sh=0.3 * torch.randn(40, 16, 3, generator=g),
    )


def changes(gaussians: Gaussians, augment: Augmentation, count: int = 60) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Matrix and shift of each change, by least squares over the centres."""
    found = []
    known = torch.cat([gaussians.means.double(), torch.ones(len(gaussians), 1)], dim=1)
    for seed in range(count):
        changed = augment(gaussians, VOXEL, torch.Generator().manual_seed(seed))
        solved = torch.linalg.lstsq(known, changed.means.double()).solution
        found.append((solved[:3].T, solved[3]))
    return found


def test_a_change_without_any_part_changes_nothing(gaussians):
    for matrix, shift in changes(gaussians, STILL, 5):
        torch.testing.assert_close(matrix, torch.eye(3).double(), rtol=0, atol=1e-5)
        assert float(shift.abs().max()) < 1e-5


def test_shifts_are_up_to_so_many_voxels_along_each_axis(gaussians):
    shifts = torch.stack([shift for _, shift in changes(gaussians, replace(STILL, shift=40.0))])
    most = 40 * VOXEL
    assert float(shifts.min()) >= -1e-5
    assert float(shifts.max()) <= most + 1e-5
    assert bool((shifts.amin(dim=0) < 0.15 * most).all())
    assert bool((shifts.amax(dim=0) > 0.85 * most).all())
    assert float((shifts[:, 0] - shifts[:, 1]).abs().max()) > 0.3 * most, "each axis by itself"


@pytest.mark.parametrize("up", [0, 1, 2])
def test_tilts_go_around_both_horizontal_axes(gaussians, up):
    """The direction up leans both ways along each of the others, and nothing turns around it."""
    matrices = [matrix for matrix, _ in changes(gaussians, replace(STILL, up=up, tilt=0.2))]
    others = [axis for axis in range(3) if axis != up]
    for axis in others:
        lean = torch.stack([matrix[axis, up] for matrix in matrices])
        assert float(lean.max()) > 0.15
        assert float(lean.min()) < -0.15
        assert float(lean.abs().max()) <= math.sin(0.2) + 1e-5
    turned = torch.stack([(matrix[others[1], others[0]] - matrix[others[0], others[1]]) / 2 for matrix in matrices])
    assert float(turned.abs().max()) < 0.05, "two small tilts make next to no turn"


@pytest.mark.parametrize("up", [0, 1, 2])
def test_turns_go_all_the_way_around_the_axis_up(gaussians, up):
    matrices = [matrix for matrix, _ in changes(gaussians, replace(STILL, up=up, turn=math.pi))]
    a, b = ((up + k) % 3 for k in (1, 2))
    angles = torch.tensor([math.atan2(matrix[b, a], matrix[a, a]) for matrix in matrices])
    assert float(angles.min()) < -0.85 * math.pi
    assert float(angles.max()) > 0.85 * math.pi
    for matrix in matrices:
        torch.testing.assert_close(matrix[up], torch.eye(3).double()[up], rtol=0, atol=1e-5)


@pytest.mark.parametrize("up", [0, 1, 2])
def test_each_horizontal_axis_is_mirrored_in_half_of_the_cases(gaussians, up):
    signs = torch.stack([m.diagonal().sign() for m, _ in changes(gaussians, replace(STILL, up=up, mirror=True), 100)])
    share = (signs < 0).double().mean(dim=0)
    assert share[up] == 0
    others = [axis for axis in range(3) if axis != up]
    assert all(0.35 < float(share[axis]) < 0.65 for axis in others)
    assert 0.15 < float((signs[:, others] < 0).all(dim=1).double().mean()) < 0.35, "one says nothing about the other"


def test_scenes_are_bent_in_nineteen_of_twenty_cases_by_every_field(gaussians, monkeypatch):
    few, asked = gaussians.subset(torch.arange(3)), []

    def noted(points, granularity, magnitude, generator):
        asked.append((granularity, magnitude))
        return torch.full_like(points, 0.5), points.new_zeros(len(points), 3, 3)

    monkeypatch.setattr(augmentation, "bend", noted)
    augment = replace(STILL, elastic=((0.2, 0.4), (0.8, 1.6)))
    bent = 0
    for seed in range(300):
        before = len(asked)
        changed = augment(few, VOXEL, torch.Generator().manual_seed(seed))
        calls = asked[before:]
        assert calls in ([], [(0.2, 0.4), (0.8, 1.6)])
        moved = 1.0 if calls else 0.0  # half a metre by each
        torch.testing.assert_close(changed.means, few.means + moved, rtol=0, atol=1e-5)
        bent += bool(calls)
    assert 0.91 < bent / 300 < 0.99


def test_bending_stretches_the_gaussians(gaussians, monkeypatch):
    """A field whose displacement grows by its distance along x doubles what lies along x."""
    gradient = torch.diag(torch.tensor([1.0, 0.0, 0.0]))
    calls = []

    def stretch(points, *rest):
        calls.append(points)
        return torch.zeros_like(points), gradient.expand(len(points), 3, 3)

    monkeypatch.setattr(augmentation, "bend", stretch)
    few = gaussians.subset(torch.arange(3))
    few = replace(few, quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(3, 1), scales=torch.full((3, 3), 0.1))
    for seed in range(9):  # a scene in twenty is not bent
        bent = replace(STILL, elastic=((0.2, 0.4),))(few, VOXEL, torch.Generator().manual_seed(seed))
        if calls:
            break
    expected = torch.tensor([0.1, 0.1, 0.2]).expand(3, 3)
    torch.testing.assert_close(bent.scales.sort(dim=1).values, expected, rtol=1e-4, atol=0)


def nodes(count: int = 40) -> torch.Tensor:
    """Places of the lattice's nodes, a little inside of the cells that begin there."""
    line = torch.arange(count, dtype=torch.float64)
    return torch.cartesian_prod(line, line, line) + 1e-9


@pytest.mark.parametrize(("granularity", "magnitude"), [(1.0, 1.0), (0.25, 3.0)])
def test_bending_is_noise_blurred_twice_along_every_axis(granularity, magnitude):
    """Twice the mean of three is the kernel (1, 2, 3, 2, 1) / 9, whose squares add up to 19/81; those of its difference
    with its neighbour to 6/81. So the standard deviation of a node, and of a step to the next node, are known."""
    points = nodes() * granularity
    moved, gradient = bend(points, granularity, magnitude, torch.Generator().manual_seed(1))
    at_node = magnitude * (19 / 81) ** 1.5
    assert moved.std(dim=0).tolist() == pytest.approx([at_node] * 3, rel=0.06)
    step = magnitude / granularity * math.sqrt(6 / 81) * 19 / 81
    for axis in range(3):
        assert gradient[:, :, axis].std(dim=0).tolist() == pytest.approx([step] * 3, rel=0.06)


def test_neighbours_six_nodes_apart_know_nothing_of_each_other():
    moved = bend(nodes(), 1.0, 1.0, torch.Generator().manual_seed(2))[0][:, 0].view(40, 40, 40)

    def alike(distance: int, axis: int) -> float:
        one, other = moved.narrow(axis, 0, 40 - distance), moved.narrow(axis, distance, 40 - distance)
        return float((one * other).mean() / moved.square().mean())

    for axis in range(3):
        # Scalar products of the kernel with itself, moved: 16, 10, 4 and 1 of 19; beyond it there is nothing.
        for distance, expected in ((1, 16 / 19), (2, 10 / 19), (3, 4 / 19), (4, 1 / 19), (6, 0.0)):
            assert alike(distance, axis) == pytest.approx(expected, abs=0.05)


def test_the_field_repeats_after_64_nodes():
    points = 5 * torch.rand(100, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    here, there, halfway = (
        bend(points + 0.5 * turns, 0.5, 1.0, torch.Generator().manual_seed(3))[0] for turns in (0, -64, 32)
    )
    torch.testing.assert_close(there, here, rtol=0, atol=1e-5)
    assert float((halfway - here).abs().mean()) > 0.05


def test_displacements_between_nodes_are_interpolated_linearly():
    """Each corner's share of a point is the volume across from it."""
    g = torch.Generator().manual_seed(4)
    inside = torch.rand(50, 3, generator=g, dtype=torch.float64)
    corners = torch.cartesian_prod(*[torch.tensor([0.0, 1.0], dtype=torch.float64)] * 3)
    at = bend(torch.cat([corners + 7, inside + 7]), 1.0, 1.0, torch.Generator().manual_seed(5))[0]
    shares = (corners[None] * inside[:, None] + (1 - corners[None]) * (1 - inside[:, None])).prod(dim=2)
    torch.testing.assert_close(at[8:], shares @ at[:8], rtol=0, atol=1e-6)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("factor", [0.5, 1.3])
def test_colours_turn_alike_in_scenes_of_another_size(gaussians, mirrored, factor):
    Q = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(6))).Q
    Q = Q * torch.linalg.det(Q).sign() * (-1 if mirrored else 1)
    turned, larger = transformed(gaussians, Q), transformed(gaussians, factor * Q)
    torch.testing.assert_close(larger.sh, turned.sh, rtol=0, atol=1e-6)
    d = torch.nn.functional.normalize(torch.randn(30, 3, dtype=torch.float64), dim=1)
    old = torch.einsum("dk,nkc->ndc", harmonics_basis(d, 3), gaussians.sh.double())
    new = torch.einsum("dk,nkc->ndc", harmonics_basis(d @ Q.T, 3), larger.sh.double())
    torch.testing.assert_close(new, old, rtol=0, atol=1e-5)


@pytest.mark.parametrize("off", [1e-6, 1e-4])
def test_a_rotation_may_be_off_by_rounding_alone(gaussians, off):
    matrix = torch.eye(3, dtype=torch.float64)
    matrix[0, 1] = off
    if off < 1e-5:
        torch.testing.assert_close(transformed(gaussians, matrix).means, gaussians.means, rtol=0, atol=1e-4)
        return
    with pytest.raises(InputError, match="rotation or mirroring"):
        transformed(gaussians, matrix)
