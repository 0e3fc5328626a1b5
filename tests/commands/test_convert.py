"""`sgwarp convert`: what it writes, read by GaussForge and plyfile, and what those write, read by it."""

import dataclasses
import struct

import numpy as np
import pytest
import torch
from plyfile import PlyData

from sgwarp.cli import main
from sgwarp.io.scenes import load_gaussians, save_gaussians
from sgwarp.scene import Gaussians

STEP = 1 / 255  # of a value of 8 bits
C0 = 0.28209479177387814  # color of the constant harmonic
# Largest errors of center [of the scene's unit], log scale, opacity and constant harmonic that a format may make.
LOSSES = {
    "spz": (3e-4, 0.04, 0.003, 0.04),
    "splat": (1e-6, 1e-4, 0.51 * STEP, 0.51 * STEP / C0),
    "compressed.ply": (8e-3, 0.02, 3e-3, 0.02),
}
THEIRS = LOSSES | {"splat": (1e-6, 1e-4, STEP, STEP / C0)}  # GaussForge cuts off where sgwarp rounds


def cloud(count: int = 64) -> Gaussians:
    random = torch.Generator().manual_seed(3)
    return Gaussians(
        torch.randn(count, 3, generator=random),
        torch.nn.functional.normalize(torch.randn(count, 4, generator=random), dim=1),
        torch.exp(0.5 * torch.randn(count, 3, generator=random) - 3),
        torch.rand(count, generator=random) * 0.9 + 0.05,
        0.3 * torch.randn(count, 4, 3, generator=random),
        extras={"label": np.arange(count, dtype=np.int32)},
    )


@pytest.fixture
def scene(tmp_path):
    save_gaussians(cloud(), tmp_path / "a.ply")
    return tmp_path / "a.ply"


def converts(*arguments) -> None:
    assert main(["convert", *map(str, arguments)]) == 0


def columns(path) -> dict[str, np.ndarray]:
    """Columns of a PLY by plyfile, float64."""
    rows = PlyData.read(str(path))["vertex"].data
    return {name: rows[name].astype(np.float64) for name in rows.dtype.names}


def assert_close(found, wanted, losses) -> None:
    """Rows are paired by the nearest center: a format may sort them."""
    center, scale, opacity, color = losses
    places = [np.stack([rows[name] for name in "xyz"], axis=1) for rows in (found, wanted)]
    nearest = np.linalg.norm(places[1][:, None] - places[0][None], axis=2).argmin(axis=1)
    assert sorted(nearest) == list(range(len(nearest)))
    found = {name: column[nearest] for name, column in found.items()}
    for name in ("x", "y", "z"):
        np.testing.assert_allclose(found[name], wanted[name], atol=center)
    for axis in range(3):
        np.testing.assert_allclose(found[f"scale_{axis}"], wanted[f"scale_{axis}"], atol=scale)
        np.testing.assert_allclose(found[f"f_dc_{axis}"], wanted[f"f_dc_{axis}"], atol=color)
    shown = [1 / (1 + np.exp(-rows["opacity"])) for rows in (found, wanted)]
    np.testing.assert_allclose(*shown, atol=opacity)


@pytest.fixture(scope="module")
def forge():
    return pytest.importorskip("gaussforge").GaussForge()


@pytest.mark.parametrize("form", LOSSES)
def test_gaussforge_reads_what_is_written(scene, tmp_path, forge, form):
    out, back = tmp_path / f"b.{form}", tmp_path / "back.ply"
    converts(scene, out, "--out-axes", "rdf")  # GaussForge does not turn axes
    back.write_bytes(forge.convert(out.read_bytes(), form, "ply")["data"])
    assert_close(columns(back), columns(scene), LOSSES[form])


@pytest.mark.parametrize("form", LOSSES)
def test_what_gaussforge_writes_is_read(scene, tmp_path, forge, form):
    theirs, back, bare = tmp_path / f"theirs.{form}", tmp_path / "back.ply", tmp_path / "bare.ply"
    save_gaussians(dataclasses.replace(cloud(), extras=None), bare)  # GaussForge knows no other columns
    theirs.write_bytes(forge.convert(bare.read_bytes(), "ply", form)["data"])
    converts(theirs, back, "--axes", "rdf")
    assert_close(columns(back), columns(scene), THEIRS[form])


@pytest.mark.parametrize("version", [2, 3])
def test_the_version_of_spz(scene, tmp_path, version):
    import gzip

    converts(scene, tmp_path / "b.spz", "--spz-version", version)
    assert struct.unpack("<II", gzip.decompress((tmp_path / "b.spz").read_bytes())[:8]) == (0x5053474E, version)


def test_axes_turn_centers(scene, tmp_path):
    """From right, down, forward to right, up, back: y and z change sign, the volume of no Gaussian does."""
    converts(scene, tmp_path / "b.ply", "--out-axes", "rub")
    found, wanted = (PlyData.read(str(path))["vertex"].data for path in (tmp_path / "b.ply", scene))
    for name, sign in (("x", 1), ("y", -1), ("z", -1)):
        np.testing.assert_array_equal(found[name], sign * wanted[name])
    np.testing.assert_allclose(*[sum(rows[f"scale_{k}"] for k in range(3)) for rows in (found, wanted)], rtol=1e-6)
    converts(tmp_path / "b.ply", tmp_path / "c.ply", "--axes", "rub")
    back, before = load_gaussians(tmp_path / "c.ply"), load_gaussians(scene)
    for field in ("means", "scales", "opacities", "sh"):
        torch.testing.assert_close(getattr(back, field), getattr(before, field), atol=1e-6, rtol=1e-5)


def test_other_columns_stay_unless_plain(scene, tmp_path, capsys):
    converts(scene, tmp_path / "b.ply")
    assert PlyData.read(str(tmp_path / "b.ply"))["vertex"]["label"].tolist() == list(range(64))
    assert "64 Gaussians" in capsys.readouterr().out
    converts(scene, tmp_path / "b.ply", "--plain")
    assert "label" not in PlyData.read(str(tmp_path / "b.ply"))["vertex"].data.dtype.names


@pytest.mark.parametrize(
    ("out", "more", "message"),
    [
        ("a.ply", (), "is read by this command; choose another name"),
        ("b.obj", (), "b.obj: scenes are written as"),
        ("b.spz", ("--spz-version", 9), "version"),
        ("b.ply", ("--out-axes", "rrr"), "axes"),
        ("b.ply", ("--axes", "xyz"), "axes"),
        ("a.ply/b.ply", (), "is not a folder that can be written to"),
    ],
)
def test_bad_input_writes_nothing(scene, tmp_path, capsys, out, more, message):
    before = scene.read_bytes()
    assert main(["convert", str(scene), str(tmp_path / out), *map(str, more)]) == 2
    *notices, line = capsys.readouterr().err.strip().splitlines()
    assert message in line
    assert [notice for notice in notices if "columns kept as they are" not in notice] == []
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]
    assert scene.read_bytes() == before
