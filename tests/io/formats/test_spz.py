import gzip
import logging
import math
import struct

import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.io.formats.spz import read_spz, write_spz
from sgwarp.io.ply import read_ply, write_ply
from sgwarp.scene import Gaussians

HEAD = struct.pack("<II", 0x5053474E, 3)


def fixed(value, bits=12):
    return round(value * 2**bits).to_bytes(3, "little", signed=True)


def one_gaussian(version, degree=1):
    """The bytes of one Gaussian, packed by hand after the layout of the README, and what they say."""
    position = [1.5, -2.25, 0.125]
    body = struct.pack("<3e", *position) if version == 1 else b"".join(map(fixed, position))
    body += bytes([51, 200, 100, 27, 160, 128, 96])  # opacity, color, scales
    if version < 3:
        body += bytes([255 - 51, 51, 128])  # x, y, z of (value + 1) * 127.5
        x, y, z = ((b / 127.5 - 1) for b in (204, 51, 128))
        quat = [math.sqrt(max(0, 1 - x * x - y * y - z * z)), x, y, z]
    else:
        # w is the largest; x = 100, y = -200, z = 300 of 511 / sqrt(1/2)
        body += (3 << 30 | 100 << 20 | (512 + 200) << 10 | 300).to_bytes(4, "little")
        x, y, z = (value / 511 * math.sqrt(0.5) for value in (100, -200, 300))
        quat = [math.sqrt(1 - x * x - y * y - z * z), x, y, z]
    body += bytes(range(120, 129)) if degree else b""
    colors = [(b / 255 - 0.5) / 0.15 for b in (200, 100, 27)]
    scales = [math.exp(b / 16 - 10) for b in (160, 128, 96)]
    rest = [[(b - 128) / 128 for b in range(start, start + 3)] for start in (120, 123, 126)]
    return body, (position, quat, scales, 51 / 255, [colors, *(rest if degree else [])])


@pytest.mark.parametrize("degree", [0, 1])
@pytest.mark.parametrize("version", [1, 2, 3])
def test_bytes_mean_what_the_format_says(tmp_path, version, degree):
    body, (position, quat, scales, opacity, sh) = one_gaussian(version, degree)
    header = struct.pack("<IIIBBBB", 0x5053474E, version, 1, degree, 12, 0, 0)
    (tmp_path / "a.spz").write_bytes(gzip.compress(header + body))
    scene = read_spz(tmp_path / "a.spz", axes="rdf")
    assert scene.means[0].tolist() == pytest.approx(position)
    assert scene.quats[0].tolist() == pytest.approx(quat, abs=1e-6)
    assert scene.scales[0].tolist() == pytest.approx(scales, rel=1e-6)
    assert scene.opacities[0].item() == pytest.approx(opacity)
    assert [row for row in scene.sh[0].tolist()] == [pytest.approx(row, abs=1e-6) for row in sh]
    turned = read_spz(tmp_path / "a.spz")  # y up, z back, which the specification says
    assert turned.means[0].tolist() == pytest.approx([position[0], -position[1], -position[2]])


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
@pytest.mark.parametrize("version", [2, 3, 4])
def test_round_trip(tmp_path, scene, rotations, version, coefficients):
    """Losses are the steps of the format: 2^-12, 1/16 of a logarithm, 1/255, 8 and 16 of 128 for harmonics."""
    before = scene(200, coefficients)
    assert write_spz(before, tmp_path / "a.spz", version).tolist() == list(range(200))
    after = read_spz(tmp_path / "a.spz")
    assert (after.means - before.means).abs().max() <= 2**-13 + 1e-6
    assert (after.scales.log() - before.scales.log()).abs().max() <= 1 / 32 + 1e-6
    assert (after.opacities - before.opacities).abs().max() <= 0.5 / 255 + 1e-6
    assert (after.sh[:, 0] - before.sh[:, 0].clamp(-0.5 / 0.15, 0.5 / 0.15)).abs().max() <= 0.5 / 255 / 0.15 + 1e-6
    low, high = -128 / 128, 127 / 128
    lost = (after.sh[:, 1:] - before.sh[:, 1:].clamp(low, high)).abs()
    assert not lost[:, :3].numel() or lost[:, :3].max() <= 4.5 / 128
    assert not lost[:, 3:].numel() or lost[:, 3:].max() <= 8.5 / 128
    cosine = torch.einsum("nij,nij->n", rotations(after.quats), rotations(before.quats))
    degrees = torch.rad2deg(torch.arccos(((cosine - 1) / 2).clamp(-1, 1)))
    assert degrees.max() < (15 if version == 2 else 0.3)


@pytest.mark.parametrize("version", [2, 3])
def test_independent_library_agrees(tmp_path, scene, rotations, version):
    """GaussForge does not turn the axes."""
    forge = pytest.importorskip("gaussforge").GaussForge()
    before = scene(100, 16)
    write_ply(before, tmp_path / "a.ply")
    theirs = forge.convert((tmp_path / "a.ply").read_bytes(), "ply", "spz", spz_version=version)["data"]
    (tmp_path / "theirs.spz").write_bytes(theirs)
    read = read_spz(tmp_path / "theirs.spz", axes="rdf")
    assert (read.means - before.means).abs().max() < 1e-3
    write_spz(before, tmp_path / "ours.spz", version, axes="rdf")
    back = forge.convert((tmp_path / "ours.spz").read_bytes(), "spz", "ply")["data"]
    (tmp_path / "back.ply").write_bytes(back)
    ours, decoded = read_spz(tmp_path / "ours.spz", axes="rdf"), read_ply(tmp_path / "back.ply")
    assert (decoded.means - ours.means).abs().max() < 1e-5
    assert (decoded.scales.log() - ours.scales.log()).abs().max() < 1e-4
    assert (decoded.sh - ours.sh).abs().max() < 1e-4
    assert (rotations(decoded.quats) - rotations(ours.quats)).abs().max() < 1e-2


def test_axes_that_the_file_names(tmp_path, scene, caplog):
    before = scene(5)
    write_spz(before, tmp_path / "a.spz", axes="luf")
    data = bytearray((tmp_path / "a.spz").read_bytes())
    records = struct.pack("<III", 0xADBE0003, 4, 7) + struct.pack("<II", 0x1234, 3) + b"abc"
    data[14] |= 2
    data[16:20] = struct.pack("<I", 32 + len(records))
    (tmp_path / "a.spz").write_bytes(bytes(data[:32]) + records + bytes(data[32:]))
    with caplog.at_level(logging.WARNING, logger="sgwarp"):
        after = read_spz(tmp_path / "a.spz")
    assert (after.means - before.means).abs().max() < 2e-4
    assert "1 extension records are left out" in caplog.text


def test_small_scenes_keep_their_positions(tmp_path, scene, caplog):
    """A room in kilometers: with the usual 12 bits of fraction all of it would lie on a few points."""
    before = scene(4)
    small = Gaussians(before.means * 1e-3, before.quats, before.scales * 1e-4, before.opacities, before.sh)
    write_spz(small, tmp_path / "a.spz")
    after = read_spz(tmp_path / "a.spz")
    assert (after.means - small.means).abs().max() <= 2e-4 * small.means.abs().max()
    assert "scales outside 4.5e-05 to 379, which SPZ cannot hold; they are clipped" in caplog.text


def test_a_packed_ply_is_named(tmp_path):
    (tmp_path / "a.ply.gz").write_bytes(gzip.compress(b"ply\nformat binary_little_endian 1.0\n" + bytes(99)))
    with pytest.raises(InputError, match=r"is a PLY file packed with gzip, which is not read; unpack it"):
        read_spz(tmp_path / "a.ply.gz")


def test_far_coordinates_and_rows_that_are_not_finite(tmp_path, scene, caplog):
    before = scene(4)
    means = before.means.clone()
    means[0], means[2, 1] = torch.tensor([5e5, -5e5, 1.0]), math.nan
    scene = Gaussians(means, before.quats, before.scales, before.opacities, before.sh)
    with caplog.at_level(logging.WARNING, logger="sgwarp"):
        assert write_spz(scene, tmp_path / "a.spz").tolist() == [0, 1, 3]
        after = read_spz(tmp_path / "a.spz")
    assert "coordinates reach 500000, so positions are kept to 0.0625" in caplog.text
    assert "left out 1 of 4 Gaussians with NaN, infinity or a rotation of zero" in caplog.text
    assert (after.means - means[[0, 1, 3]]).abs().max() <= 0.0625 / 2


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "is not an SPZ scene"),
        (b"ply\n", "is not an SPZ scene"),
        (b"NGSP", "is cut short"),
        (struct.pack("<III", 0x5053474E, 9, 1) + bytes(20), "is an SPZ scene of version 9"),
        (struct.pack("<IIIBBBBI12x", 0x5053474E, 4, 0, 0, 12, 0, 5, 32), "has no Gaussians"),
        (struct.pack("<IIIBBBBI12x", 0x5053474E, 4, 1 << 30, 0, 12, 0, 5, 32), "table of 5 streams is damaged"),
        (gzip.compress(HEAD, mtime=0), "is cut short: holds no SPZ header"),
        (gzip.compress(HEAD + struct.pack("<IBBBB", 1 << 31, 3, 12, 0, 0), mtime=0), "claims 2147483648 Gaussians"),
        (gzip.compress(HEAD + struct.pack("<IBBBB", 1, 7, 12, 0, 0), mtime=0), "degree 7 of the harmonics"),
        (gzip.compress(HEAD + struct.pack("<IBBBB", 1, 0, 99, 0, 0), mtime=0), "99 bits of fraction"),
        (
            gzip.compress(HEAD + struct.pack("<IBBBB", 1, 0, 12, 0, 0) + bytes(5), mtime=0),
            "is cut short: holds 5 of 20 bytes",
        ),
        (gzip.compress(b"x" * 40, mtime=0), "is not an SPZ scene of version 1 to 3"),
        (b"\x1f\x8b\x08\0" + b"\xff" * 20, "gzip stream is damaged"),
    ],
)
def test_damaged(tmp_path, data, message):
    (tmp_path / "a.spz").write_bytes(data)
    with pytest.raises(InputError, match=rf"a\.spz: .*{message}"):
        read_spz(tmp_path / "a.spz")


def test_damage_behind_the_last_value_is_found(tmp_path, scene):
    write_spz(scene(5), tmp_path / "a.spz", 3)
    data = bytearray((tmp_path / "a.spz").read_bytes())
    data[-6] ^= 1  # of the checksum
    (tmp_path / "a.spz").write_bytes(bytes(data))
    with pytest.raises(InputError, match="gzip stream is damaged"):
        read_spz(tmp_path / "a.spz")


@pytest.mark.parametrize("version", [2, 3, 4])
def test_mutated_files(tmp_path, scene, survives, version):
    write_spz(scene(50), tmp_path / "a.spz", version)
    survives(tmp_path / "a.spz", read_spz)


def test_what_is_not_written(tmp_path, scene):
    with pytest.raises(InputError, match="version 2, 3 or 4, not 1"):
        write_spz(scene(), tmp_path / "a.spz", 1)
    empty = scene().subset(torch.zeros(60, dtype=torch.bool))
    with pytest.raises(InputError, match="not written, the scene has no Gaussians"):
        write_spz(empty, tmp_path / "a.spz")
    assert not list(tmp_path.iterdir())


def test_a_raw_stream_is_named(tmp_path):
    (tmp_path / "a.spz").write_bytes(struct.pack("<IIIBBBB", 0x5053474E, 2, 1, 0, 12, 0, 0) + bytes(64))
    with pytest.raises(InputError, match="is an SPZ scene of version 2; is not packed with gzip"):
        read_spz(tmp_path / "a.spz")
