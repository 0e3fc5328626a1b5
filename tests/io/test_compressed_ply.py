import logging
import math
import os
import random
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sgwarp.errors import InputError
from sgwarp.io.compressed_ply import morton_codes, read_compressed_ply, write_compressed_ply
from sgwarp.io.scenes import load_gaussians
from sgwarp.scene import Gaussians

AXES = ["min_x", "min_y", "min_z", "max_x", "max_y", "max_z"]
CHUNK = AXES + [n.replace("_", "_scale_") for n in AXES]
COLOURS = ["min_r", "min_g", "min_b", "max_r", "max_g", "max_b"]
PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
C0 = 0.28209479177387814


def bits(word, high, count):
    """`count` bits of a 32-bit word, the highest of them at place `high`, as a string of binary digits."""
    return int(f"{word:032b}"[31 - high : 31 - high + count], 2)


def decode(chunk, words, sh=None):
    """One Gaussian, bit by bit: position, quaternion w x y z, scale, opacity, SH coefficients [K][3]."""
    position, rotation, scale, colour = words

    def between(low, high, t):
        return chunk[low] * (1 - t) + chunk[high] * t

    t = (bits(position, 31, 11) / 2047, bits(position, 20, 10) / 1023, bits(position, 10, 11) / 2047)
    mean = [between(f"min_{a}", f"max_{a}", v) for a, v in zip("xyz", t, strict=True)]
    t = (bits(scale, 31, 11) / 2047, bits(scale, 20, 10) / 1023, bits(scale, 10, 11) / 2047)
    scales = [math.exp(between(f"min_scale_{a}", f"max_scale_{a}", v)) for a, v in zip("xyz", t, strict=True)]
    smaller = [(bits(rotation, high, 10) / 1023 - 0.5) * math.sqrt(2) for high in (29, 19, 9)]
    quat = list(smaller)
    quat.insert(bits(rotation, 31, 2), math.sqrt(max(0.0, 1 - sum(v * v for v in smaller))))
    rgb = [bits(colour, high, 8) / 255 for high in (31, 23, 15)]
    if "min_r" in chunk:
        rgb = [between(f"min_{c}", f"max_{c}", v) for c, v in zip("rgb", rgb, strict=True)]
    coefficients = [[(v - 0.5) / C0 for v in rgb]]
    values = [-4.0 if b == 0 else 4.0 if b == 255 else (b + 0.5) / 256 * 8 - 4 for b in sh or ()]
    per_channel = len(values) // 3
    coefficients += [[values[c * per_channel + k] for c in range(3)] for k in range(per_channel)]
    return mean, quat, scales, bits(colour, 7, 8) / 255, coefficients


def random_elements(count, rest, colours, seed):
    rng = random.Random(seed)
    names = CHUNK + (COLOURS if colours else [])
    chunks = []
    for _ in range(-(-count // 256)):
        low = {n: rng.uniform(-3, 1) for n in names}
        row = {n: low[n] if n.startswith("min") else low[n.replace("max", "min")] + rng.uniform(0, 3) for n in names}
        chunks.append([struct.unpack("f", struct.pack("f", row[n]))[0] for n in names])
    words = [[rng.getrandbits(32) for _ in PACKED] for _ in range(count)]
    elements = [
        ("chunk", [("float", n) for n in names], chunks),
        ("vertex", [("uint", n) for n in PACKED], words),
    ]
    if rest:
        columns = [("uchar", f"f_rest_{i}") for i in range(rest)]
        elements.append(
            ("sh", columns, [[rng.choice([0, 255, rng.getrandbits(8)]) for _ in range(rest)] for _ in words])
        )
    return elements


def assert_decoded(gaussians, elements):
    (_, names, chunks), (_, _, words), *sh = elements
    assert len(gaussians) == len(words)
    for i in range(len(words)):
        chunk = dict(zip((n for _, n in names), chunks[i // 256], strict=True))
        mean, quat, scales, opacity, coefficients = decode(chunk, words[i], sh[0][2][i] if sh else None)
        assert gaussians.means[i].tolist() == pytest.approx(mean, rel=1e-6, abs=1e-6)
        assert gaussians.quats[i].tolist() == pytest.approx(quat, abs=1e-6)
        assert gaussians.scales[i].tolist() == pytest.approx(scales, rel=1e-6)
        assert gaussians.opacities[i].item() == pytest.approx(opacity, abs=1e-7)
        assert gaussians.sh[i].tolist() == [pytest.approx(row, abs=1e-5) for row in coefficients]


@pytest.mark.parametrize("rest", [0, 9, 24, 45])
@pytest.mark.parametrize("colours", [False, True])
def test_decodes_as_bit_by_bit(tmp_path, ply_bytes, rest, colours):
    elements = random_elements(300, rest, colours, seed=rest)
    (tmp_path / "a.ply").write_bytes(ply_bytes(elements))
    assert_decoded(load_gaussians(tmp_path / "a.ply"), elements)


def test_format_is_told_by_the_header_not_the_name(tmp_path, ply_bytes):
    elements = random_elements(2, 0, True, seed=1)
    (tmp_path / "plain.ply").write_bytes(ply_bytes(elements))
    assert_decoded(load_gaussians(tmp_path / "plain.ply"), elements)
    columns = [*"xyz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
    columns += ["rot_0", "rot_1", "rot_2", "rot_3"]
    plain = ply_bytes([("vertex", [("float", n) for n in columns], [[0.5] * 14])])
    (tmp_path / "a.compressed.ply").write_bytes(plain)
    assert load_gaussians(tmp_path / "a.compressed.ply").means.tolist() == [[0.5, 0.5, 0.5]]
    with pytest.raises(InputError, match="is not a compressed PLY"):
        read_compressed_ply(tmp_path / "a.compressed.ply")


def some_gaussians(count=700, coefficients=4, seed=0):
    gen = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.randn(count, 3, generator=gen) * torch.tensor([1.0, 5.0, 0.1]),
        quats=torch.randn(count, 4, generator=gen) * 3,
        scales=torch.exp(torch.randn(count, 3, generator=gen) - 4),
        opacities=torch.rand(count, generator=gen),
        sh=torch.rand(count, coefficients, 3, generator=gen) * 2 - 1,
    )


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
def test_written_file_holds_the_scene(tmp_path, coefficients):
    """Read back with the bit-level decoder of this file; every error is within half a quantum of its chunk."""
    g = some_gaussians(coefficients=coefficients)
    order = write_compressed_ply(g, tmp_path / "a.compressed.ply")
    assert sorted(order.tolist()) == list(range(700))
    header, body = (tmp_path / "a.compressed.ply").read_bytes().split(b"end_header\n", 1)
    assert b"element chunk 3\n" in header
    assert b"element vertex 700\n" in header
    rest = 3 * (coefficients - 1)
    assert header.count(b"property uchar f_rest_") == rest
    assert len(body) == 3 * 18 * 4 + 700 * 16 + 700 * rest
    names = CHUNK + COLOURS
    chunks = [dict(zip(names, struct.unpack_from("<18f", body, 72 * i), strict=True)) for i in range(3)]
    for i in range(0, 700, 3):
        chunk = chunks[i // 256]
        words = struct.unpack_from("<4I", body, 216 + 16 * i)
        sh = struct.unpack_from(f"<{rest}B", body, 216 + 11200 + rest * i)
        mean, quat, scales, opacity, coefficients_read = decode(chunk, words, sh)
        j = int(order[i])
        for axis, levels in zip(range(3), (2047, 1023, 2047), strict=True):
            letter = "xyz"[axis]
            quantum = (chunk[f"max_{letter}"] - chunk[f"min_{letter}"]) / levels
            assert abs(mean[axis] - g.means[j, axis].item()) <= 0.501 * quantum + 1e-6
            quantum = (chunk[f"max_scale_{letter}"] - chunk[f"min_scale_{letter}"]) / levels
            assert abs(math.log(scales[axis]) - math.log(g.scales[j, axis])) <= 0.501 * quantum + 1e-5
        unit = g.quats[j].double() / g.quats[j].double().norm()
        assert abs(float(unit @ torch.tensor(quat, dtype=torch.float64))) > 1 - 1e-5
        assert abs(opacity - g.opacities[j].item()) <= 0.501 / 255
        for c, letter in enumerate("rgb"):
            quantum = (chunk[f"max_{letter}"] - chunk[f"min_{letter}"]) / 255 / C0
            assert abs(coefficients_read[0][c] - g.sh[j, 0, c].item()) <= 0.501 * quantum + 1e-5
        for k in range(1, coefficients):
            assert coefficients_read[k] == pytest.approx(g.sh[j, k].tolist(), abs=0.5 / 32 + 1e-6)


def test_order_returned_is_the_order_read(tmp_path):
    g = some_gaussians()
    order = write_compressed_ply(g, tmp_path / "a.compressed.ply")
    h = read_compressed_ply(tmp_path / "a.compressed.ply")
    assert (h.means - g.means[order]).abs().max() < 0.05
    assert (h.opacities - g.opacities[order]).abs().max() < 0.01


def test_sorting_keeps_chunks_small(tmp_path):
    """Neighbours share a chunk: positions are far finer than the whole scene over 2047."""
    g = some_gaussians(20_000, 1)
    order = write_compressed_ply(g, tmp_path / "a.compressed.ply")
    h = read_compressed_ply(tmp_path / "a.compressed.ply")
    extent = g.means.max(dim=0).values - g.means.min(dim=0).values
    # In any order a chunk spans nearly the whole scene, where half a quantum of x is extent / 2047 / 2.
    assert ((h.means - g.means[order]).abs().mean(dim=0) < 0.1 * extent / torch.tensor([2047, 1023, 2047])).all()


def test_morton_codes_interleave_bits():
    points = np.random.default_rng(0).integers(0, 2**21, (50, 3)).astype(np.float32)
    points[0], points[1] = 0, 2**21 - 1  # the bounding box, so that cells are the coordinates themselves
    for point, code in zip(points.astype(int), morton_codes(points), strict=True):
        x, y, z = (f"{int(v):021b}" for v in point)
        assert int(code) == int("".join(a + b + c for a, b, c in zip(x, y, z, strict=True)), 2)
    assert morton_codes(np.ones((3, 3), np.float32)).tolist() == [0, 0, 0]


def test_constant_chunk_and_extremes(tmp_path):
    sh = torch.zeros(3, 4, 3)
    sh[0, 1, 0], sh[1, 1, 0] = 100.0, -100.0
    g = Gaussians(
        means=torch.tensor([[1.5, -2.0, 3.0]]).repeat(3, 1),
        quats=torch.tensor([[-1.0, 0, 0, 0], [0, 0, 0, 2.0], [0.5, 0.5, 0.5, 0.5]]),
        scales=torch.tensor([[0.0, 1.0, 1e30]]).repeat(3, 1),
        opacities=torch.tensor([0.0, 1.0, 0.5]),
        sh=sh,
    )
    order = write_compressed_ply(g, tmp_path / "a.compressed.ply")
    h = read_compressed_ply(tmp_path / "a.compressed.ply")
    assert order.tolist() == [0, 1, 2]
    assert torch.equal(h.means, g.means)
    assert h.opacities[:2].tolist() == [0, 1]
    assert torch.allclose(h.scales[0].log(), torch.tensor([-20.0, 0.0, 20.0]))
    expected = torch.tensor([[1.0, 0, 0, 0], [0, 0, 0, 1.0], [0.5, 0.5, 0.5, 0.5]])
    torch.testing.assert_close(h.quats, expected, atol=1e-3, rtol=0)
    assert h.sh[:2, 1, 0].tolist() == [4.0, -4.0]


def test_no_higher_coefficients_no_element(tmp_path):
    g = some_gaussians(5)
    g = Gaussians(g.means, g.quats, g.scales, g.opacities, torch.cat([g.sh[:, :1], torch.zeros(5, 15, 3)], dim=1))
    write_compressed_ply(g, tmp_path / "a.compressed.ply")
    assert read_compressed_ply(tmp_path / "a.compressed.ply").sh_degree == 0


def test_rows_that_do_not_fit_are_left_out(tmp_path, caplog):
    g = some_gaussians(6)
    means, quats, scales = g.means.clone(), g.quats.clone(), g.scales.clone()
    means[1, 0], quats[2], scales[4, 2] = math.nan, 0.0, math.inf
    g = Gaussians(means, quats, scales, g.opacities, g.sh)
    with caplog.at_level(logging.WARNING, logger="sgwarp"):
        order = write_compressed_ply(g, tmp_path / "a.compressed.ply")
    assert sorted(order.tolist()) == [0, 3, 5]
    assert "left out 3 of 6 Gaussians" in caplog.text
    assert read_compressed_ply(tmp_path / "a.compressed.ply").non_finite == 0
    nothing = Gaussians(means[1:2], quats[1:2], scales[1:2], g.opacities[1:2], g.sh[1:2])
    with pytest.raises(InputError, match="no Gaussians"):
        write_compressed_ply(nothing, tmp_path / "b.compressed.ply")


def test_nan_bounds_are_kept_and_counted(tmp_path, ply_bytes, caplog):
    elements = random_elements(300, 0, True, seed=3)
    elements[0][2][1][0] = math.nan  # min_x of the second chunk
    (tmp_path / "a.ply").write_bytes(ply_bytes(elements))
    gaussians = load_gaussians(tmp_path / "a.ply")
    assert gaussians.finite.tolist() == [True] * 256 + [False] * 44
    assert "44 of 300 Gaussians hold NaN" in caplog.text


def damaged(elements, change):
    elements = [list(element) for element in elements]
    change(elements)
    return elements


def drop_column(e):
    e[1][1], e[1][2] = e[1][1][:3], [row[:3] for row in e[1][2]]


def drop_bound(e):
    e[0][1], e[0][2] = e[0][1][1:], [row[1:] for row in e[0][2]]


def float_words(e):
    e[1][1] = [("float", n) for n in PACKED]


def one_chunk(e):
    e[0][2] = e[0][2][:1]


def seven_coefficients(e):
    e[2][1], e[2][2] = e[2][1][:7], [row[:7] for row in e[2][2]]


def wide_coefficients(e):
    e[2][1] = [("int", n) for _, n in e[2][1]]


def fewer_coefficient_rows(e):
    e[2][2] = e[2][2][:-1]


def no_rows(e):
    e[0][2], e[1][2], e[2][2] = [], [], []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (drop_column, r"lacks the columns packed_color of a compressed scene"),
        (drop_bound, r"lacks the columns min_x of a compressed scene"),
        (float_words, r"column packed_position must be uint \(32 bits\), is float32"),
        (one_chunk, r"300 Gaussians need 2 chunks, element 'chunk' has 1"),
        (seven_coefficients, r"element 'sh' has 7 columns and 300 rows, expected .* 300 rows"),
        (fewer_coefficient_rows, r"element 'sh' has 9 columns and 299 rows, expected .* 300 rows"),
        (wide_coefficients, r"column f_rest_0 of element 'sh' must be uchar, is int32"),
        (no_rows, r"has no Gaussians"),
    ],
)
def test_bad_files(tmp_path, ply_bytes, change, message):
    elements = damaged(random_elements(300, 9, True, seed=4), change)
    (tmp_path / "a.ply").write_bytes(ply_bytes(elements))
    with pytest.raises(InputError, match=r"a\.ply: " + message):
        load_gaussians(tmp_path / "a.ply")


def test_cut_short(tmp_path, ply_bytes):
    data = ply_bytes(random_elements(300, 9, True, seed=5))
    body = data.index(b"end_header\n") + 11
    for length, element in ((body, "chunk"), (body + 143, "chunk"), (body + 144, "vertex"), (len(data) - 1, "sh")):
        (tmp_path / "a.ply").write_bytes(data[:length])
        with pytest.raises(InputError, match=rf"a\.ply: is cut short: element '{element}'"):
            load_gaussians(tmp_path / "a.ply")


@settings(deadline=None, max_examples=100)
@given(body=st.binary(min_size=60, max_size=300))
def test_random_bytes_after_the_header(tmp_path_factory, ply_bytes, allow_input_error, body):
    data = ply_bytes(random_elements(3, 9, True, seed=6))
    path = tmp_path_factory.getbasetemp() / "random.ply"
    path.write_bytes(data[: data.index(b"end_header\n") + 11] + body)
    with allow_input_error(path):
        assert len(load_gaussians(path)) == 3


@pytest.mark.skipif("SGWARP_DATA" not in os.environ, reason="SGWARP_DATA names no folder of scenes")
def test_file_of_supersplat():
    """A file that SuperSplat wrote: the first, a middle and the last Gaussian, decoded here from its bytes."""
    path = Path(os.environ["SGWARP_DATA"]) / "biker" / "biker.compressed.ply"
    gaussians = load_gaussians(path)
    header, body = path.read_bytes().split(b"end_header\n", 1)
    chunks = int(header.split(b"element chunk ")[1].split()[0])
    for i in (0, 70_000, len(gaussians) - 1):
        values = struct.unpack_from("<18f", body, 72 * (i // 256))
        words = struct.unpack_from("<4I", body, 72 * chunks + 16 * i)
        mean, quat, scales, opacity, coefficients = decode(dict(zip(CHUNK + COLOURS, values, strict=True)), words)
        assert gaussians.means[i].tolist() == pytest.approx(mean, abs=1e-6)
        assert gaussians.quats[i].tolist() == pytest.approx(quat, abs=1e-6)
        assert gaussians.scales[i].tolist() == pytest.approx(scales, rel=1e-5)
        assert gaussians.opacities[i].item() == pytest.approx(opacity)
        assert gaussians.sh[i, 0].tolist() == pytest.approx(coefficients[0], abs=1e-5)
