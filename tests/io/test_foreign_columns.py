"""PLY files whose header is spelled unusually, written byte by byte."""

import numpy as np
import pytest

from sgwarp.errors import InputError
from sgwarp.io.points import load_points
from sgwarp.io.scenes import load_gaussians

NAMES = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
NAMES += ["rot_0", "rot_1", "rot_2", "rot_3"]


def ply(path, names, values, kind="float"):
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(values)}"]
    header += [f"property {kind} {name}" for name in names]
    path.write_bytes("\n".join([*header, "end_header", ""]).encode() + np.asarray(values, "<f4").tobytes())
    return path


@pytest.fixture
def values():
    return np.random.default_rng(0).normal(-1, 0.5, (4, len(NAMES)))


@pytest.mark.parametrize("spelling", [str.upper, str.title])
def test_capital_column_names_are_those_of_a_scene(tmp_path, values, spelling):
    usual = load_gaussians(ply(tmp_path / "a.ply", NAMES, values))
    capital = load_gaussians(ply(tmp_path / "b.ply", [spelling(name) for name in NAMES], values))
    for name in ("means", "quats", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(capital, name), getattr(usual, name))
    np.testing.assert_allclose(capital.means, values[:, :3], rtol=1e-6)


def test_a_second_column_of_the_name_in_capitals_is_another_one(tmp_path, values):
    given = np.column_stack([values, np.arange(4)])
    found = load_gaussians(ply(tmp_path / "a.ply", [*NAMES, "X"], given))
    np.testing.assert_allclose(found.means, values[:, :3], rtol=1e-6)
    np.testing.assert_array_equal(found.extras["X"], np.arange(4))


def test_points_with_capital_names_are_points(tmp_path):
    places = np.arange(12.0).reshape(4, 3)
    np.testing.assert_array_equal(load_points(ply(tmp_path / "a.ply", ["X", "Y", "Z"], places))[0], places)


@pytest.mark.parametrize("kind", ["half", "float16", "bfloat16"])
def test_a_type_that_ply_does_not_have_is_named_in_short(tmp_path, values, kind):
    path = ply(tmp_path / "a.ply", NAMES, values, kind)
    with pytest.raises(InputError) as caught:
        load_gaussians(path)
    assert str(caught.value) == (
        f"{path}: is not a valid PLY file (line 4: PLY has no type '{kind}'); write these numbers as float"
    )
