import logging
import math
import struct

import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.io.formats.dot_splat import read_splat, write_splat
from sgwarp.io.ply import read_ply

C0 = 0.28209479177387814


def test_bytes_mean_what_the_format_says(tmp_path):
    row = struct.pack("<6f8B", 1.0, -2.0, 3.5, 0.1, 0.2, 0.3, 255, 51, 0, 204, 255, 128, 64, 128)
    (tmp_path / "a.splat").write_bytes(row + struct.pack("<6f8B", *[0.0] * 6, *[128] * 8))
    scene = read_splat(tmp_path / "a.splat")
    assert scene.means[0].tolist() == [1.0, -2.0, 3.5]
    assert scene.scales[0].tolist() == pytest.approx([0.1, 0.2, 0.3])
    assert scene.opacities[0].item() == pytest.approx(0.8)
    assert scene.quats.tolist() == [[127 / 128, 0, -0.5, 0], [1, 0, 0, 0]]
    assert (scene.sh[0, 0] * C0 + 0.5).tolist() == pytest.approx([1.0, 0.2, 0.0], abs=1e-6)


def test_round_trip(tmp_path, scene, rotations, caplog):
    before = scene(100, 4)
    with caplog.at_level(logging.WARNING, logger="sgwarp"):
        write_splat(before, tmp_path / "a.splat")
    assert "holds no view-dependent color" in caplog.text
    assert (tmp_path / "a.splat").stat().st_size == 3200
    after = read_splat(tmp_path / "a.splat")
    assert torch.equal(after.means, before.means)
    assert torch.equal(after.scales, before.scales)
    assert (after.opacities - before.opacities).abs().max() <= 0.5 / 255 + 1e-6
    seen = (before.sh[:, 0] * C0 + 0.5).clamp(0, 1)
    assert (after.sh[:, 0] * C0 + 0.5 - seen).abs().max() <= 0.5 / 255 + 1e-6
    assert (rotations(after.quats) - rotations(before.quats)).abs().max() < 0.03


def test_independent_library_agrees(tmp_path, scene):
    forge = pytest.importorskip("gaussforge").GaussForge()
    write_splat(scene(100, 1), tmp_path / "a.splat")
    (tmp_path / "a.ply").write_bytes(forge.convert((tmp_path / "a.splat").read_bytes(), "splat", "ply")["data"])
    ours, theirs = read_splat(tmp_path / "a.splat"), read_ply(tmp_path / "a.ply")
    assert torch.equal(ours.means, theirs.means)
    assert (ours.scales.log() - theirs.scales.log()).abs().max() < 1e-4
    assert (ours.sh[:, 0] - theirs.sh[:, 0]).abs().max() < 1e-4
    assert (ours.opacities - theirs.opacities).abs().max() < 1e-3


@pytest.mark.parametrize("data", [b"", b"x" * 31, b"x" * 65])
def test_size_is_a_number_of_rows(tmp_path, data):
    (tmp_path / "a.splat").write_bytes(data)
    with pytest.raises(InputError, match=rf"a\.splat: {len(data)} bytes are not a number of rows of 32 bytes"):
        read_splat(tmp_path / "a.splat")


def test_negative_scale(tmp_path):
    rows = struct.pack("<6f8B", *[1.0] * 6, *[128] * 8) + struct.pack("<6f8B", *[1.0] * 5, -1.0, *[128] * 8)
    (tmp_path / "a.splat").write_bytes(rows)
    with pytest.raises(InputError, match=r"a\.splat: row 1 has a negative scale"):
        read_splat(tmp_path / "a.splat")


def test_mutated_files(tmp_path, scene, survives):
    write_splat(scene(20, 1), tmp_path / "a.splat")
    assert survives(tmp_path / "a.splat", read_splat) > 50
    assert math.isfinite(read_splat(tmp_path / "a.splat").means.sum())
