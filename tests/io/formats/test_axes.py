import numpy as np
import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.io.formats.axes import change_axes, harmonic_basis, move_gaussians, parse_axes, signs_between
from sgwarp.ops.reference.rasterizer import harmonics


def test_names():
    assert parse_axes("rdf") == "RDF"
    assert signs_between("rdf", "rub") == (1, -1, -1)
    assert signs_between("RDF", "luf") == (-1, -1, 1)
    for bad in ("", "rd", "rdff", "xyz", "drf"):
        with pytest.raises(InputError, match=f"axes '{bad}': expected R or L"):
            parse_axes(bad)


def test_basis_is_the_renderer_s():
    directions = torch.nn.functional.normalize(torch.randn(50, 3, dtype=torch.float64), dim=1)
    assert np.abs(harmonic_basis(directions) - harmonics(directions, 3).numpy()).max() < 1e-14


@pytest.mark.parametrize("target", ["rub", "luf", "lub", "ruf", "ldb"])
def test_every_gaussian_looks_the_same_from_the_moved_eye(scene, covariances, target):
    """Positions, covariances, and the color along every direction, change with the axes; mirrored frames too."""
    before = scene(40, 16)
    after = change_axes(before, "rdf", target)
    signs = torch.tensor(signs_between("rdf", target), dtype=torch.float64)
    assert torch.equal(after.means.double(), before.means.double() * signs)
    mirror = torch.diag(signs)
    assert (covariances(after) - mirror @ covariances(before) @ mirror).abs().max() < 1e-6
    directions = torch.nn.functional.normalize(torch.randn(20, 3, dtype=torch.float64), dim=1)
    seen = torch.einsum("dk,nkc->dnc", torch.from_numpy(harmonic_basis(directions)), before.sh.double())
    moved = torch.einsum("dk,nkc->dnc", torch.from_numpy(harmonic_basis(directions * signs)), after.sh.double())
    assert (seen - moved).abs().max() < 1e-6
    back = change_axes(after, target, "rdf")
    for name in ("means", "quats", "sh"):
        assert torch.equal(getattr(back, name), getattr(before, name))


def test_moved_scene(scene, covariances, rotations):
    before = scene(40, 16)
    R = rotations(torch.tensor([[0.3, -0.5, 0.7, 0.2]]))[0].numpy()
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = 2.5 * R, [1.0, -2.0, 3.0]
    after = move_gaussians(before, matrix)
    linear = torch.from_numpy(matrix[:3, :3])
    expected = before.means.double() @ linear.T + torch.tensor([1.0, -2.0, 3.0])
    assert (after.means - expected).abs().max() < 1e-5
    moved = linear @ covariances(before) @ linear.T
    assert ((covariances(after) - moved).abs() / moved.abs().amax(dim=(1, 2), keepdim=True)).max() < 1e-5
    directions = torch.nn.functional.normalize(torch.randn(20, 3, dtype=torch.float64), dim=1).numpy()
    seen = np.einsum("dk,nkc->dnc", harmonic_basis(directions), before.sh.double())
    turned = np.einsum("dk,nkc->dnc", harmonic_basis(directions @ R.T), after.sh.double())
    assert np.abs(seen - turned).max() < 1e-5


@pytest.mark.parametrize(
    "linear", [np.diag([1.0, 1, -1]), np.diag([1.0, 2, 1]), np.zeros((3, 3)), np.full((3, 3), np.nan)]
)
def test_no_similarity(scene, linear):
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    with pytest.raises(InputError, match="not a rotation with one positive scale"):
        move_gaussians(scene(), matrix)
