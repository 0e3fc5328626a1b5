"""Which projection matrices Inria's facade takes for a pinhole camera, and where it finds the principal point."""

import math

import pytest
import torch

from sgwarp.compat.inria import GaussianRasterizationSettings, _intrinsics
from sgwarp.errors import InputError

WIDTH, HEIGHT, FX, FY = 45, 37, 50.0, 40.0


def settings(change=(), tangents=(WIDTH / (2 * FX), HEIGHT / (2 * FY)), center=(WIDTH / 2, HEIGHT / 2)):
    """A turned and moved camera; `change` is (row, column, value) of the projection before it is transposed."""
    view = torch.eye(4, dtype=torch.float64)
    c, s = math.cos(0.4), math.sin(0.4)
    view[:3, :3] = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    view[:3, 3] = torch.tensor([0.3, -0.2, 1.5])
    P = torch.zeros(4, 4, dtype=torch.float64)
    P[0, 0], P[1, 1] = 2 * FX / WIDTH, 2 * FY / HEIGHT
    P[0, 2], P[1, 2] = 2 * center[0] / WIDTH - 1, 2 * center[1] / HEIGHT - 1
    P[2, 2], P[2, 3], P[3, 2] = 1.0001, -0.010001, 1.0
    if change:
        P[change[0], change[1]] = change[2]
    return GaussianRasterizationSettings(
        *(HEIGHT, WIDTH, *tangents, torch.zeros(3), 1.0, view.T.float(), (view.T @ P.T).float(), 0, torch.zeros(3))
    )


@pytest.mark.parametrize("center", [(22.5, 18.5), (20.0, 25.0)])
def test_intrinsics_are_found_again(center):
    expected = torch.tensor([[FX, 0, center[0]], [0, FY, center[1]], [0, 0, 1]], dtype=torch.float64)
    torch.testing.assert_close(_intrinsics(settings(center=center)), expected, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("place", [(0, 1), (1, 0), (0, 3), (1, 3), (3, 0), (3, 1), (3, 3)])
@pytest.mark.parametrize("value", [0.2, -0.2])
def test_what_is_skewed_or_shifted_is_no_pinhole(place, value):
    """Skew, a shift that does not shrink with depth, and a depth that is not along the axis."""
    with pytest.raises(InputError, match="projmatrix: expected viewmatrix times a perspective projection"):
        _intrinsics(settings((*place, value)))


def test_what_looks_backwards_is_no_pinhole():
    with pytest.raises(InputError, match="projmatrix"):
        _intrinsics(settings((3, 2, -1.0)))


@pytest.mark.parametrize(("axis", "name"), [(0, "tanfovx"), (1, "tanfovy")])
@pytest.mark.parametrize(("factor", "fine"), [(1.0005, True), (1.01, False), (0.99, False)])
def test_fields_of_view_agree_with_the_matrix(axis, name, factor, fine):
    tangents = [WIDTH / (2 * FX), HEIGHT / (2 * FY)]
    tangents[axis] *= factor
    if fine:
        assert _intrinsics(settings(tangents=tangents))[axis, axis] > 0
        return
    with pytest.raises(InputError, match=name):
        _intrinsics(settings(tangents=tangents))


def test_cameras_far_from_the_origin_are_taken():
    """Where float32 holds the product of both matrices to a few meters only."""
    near = settings()
    view = near.viewmatrix.double().clone()
    P = torch.linalg.inv(near.viewmatrix.double()) @ near.projmatrix.double()
    view[3, :3] = torch.tensor([5e5, -3e3, 4e6])
    K = _intrinsics(near._replace(viewmatrix=view.float(), projmatrix=(view @ P).float()))
    torch.testing.assert_close(K[0, 0], torch.tensor(FX, dtype=torch.float64), rtol=1e-3, atol=0)
