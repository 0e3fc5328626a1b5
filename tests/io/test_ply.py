import logging
import math
import random
import struct

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sgwarp.errors import InputError
from sgwarp.io.ply import read_elements, read_ply, write_ply
from sgwarp.io.scenes import load_gaussians, save_gaussians
from sgwarp.scene import Gaussians

CORE = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
CORE += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
REST = {0: 0, 1: 9, 2: 24, 3: 45}


def names_of(degree):
    return CORE + [f"f_rest_{i}" for i in range(REST[degree])]


def raw_rows(names, count=5, seed=0):
    """Random raw values, exactly representable as float32, one dict per row."""
    rng = random.Random(seed)
    return [{n: struct.unpack("f", struct.pack("f", rng.uniform(-3, 3)))[0] for n in names} for _ in range(count)]


def scene_file(ply_bytes, path, rows, names=None, kinds=None, form="binary_little_endian", newline="\n"):
    names = names or list(rows[0])
    kinds = kinds or ["float"] * len(names)
    table = [[row[n] for n in names] for row in rows]
    path.write_bytes(ply_bytes([("vertex", list(zip(kinds, names, strict=True)), table)], form, newline))
    return path


def assert_scene(gaussians, rows, degree):
    """Compare with the definition of each column, row by row in Python floats."""
    assert len(gaussians) == len(rows)
    assert gaussians.sh.shape == (len(rows), (degree + 1) ** 2, 3)
    per_channel = (degree + 1) ** 2 - 1
    for i, row in enumerate(rows):
        assert gaussians.means[i].tolist() == [row[n] for n in "xyz"]
        assert gaussians.quats[i].tolist() == [row[f"rot_{k}"] for k in range(4)]
        scales = [math.exp(row[f"scale_{k}"]) for k in range(3)]
        assert gaussians.scales[i].tolist() == pytest.approx(scales, rel=1e-6)
        assert gaussians.opacities[i].item() == pytest.approx(1 / (1 + math.exp(-row["opacity"])), rel=1e-6)
        for c in range(3):
            assert gaussians.sh[i, 0, c].item() == row[f"f_dc_{c}"]
            for k in range(per_channel):
                assert gaussians.sh[i, 1 + k, c].item() == row[f"f_rest_{c * per_channel + k}"]


def some_gaussians(count=40, coefficients=16, seed=0):
    gen = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.randn(count, 3, generator=gen) * 10,
        quats=torch.randn(count, 4, generator=gen),
        scales=torch.rand(count, 3, generator=gen) + 1e-4,
        opacities=torch.rand(count, generator=gen),
        sh=torch.randn(count, coefficients, 3, generator=gen),
    )


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("form", ["binary_little_endian", "binary_big_endian", "ascii"])
def test_reads_every_degree_and_form(tmp_path, ply_bytes, degree, form):
    rows = raw_rows(names_of(degree))
    assert_scene(read_ply(scene_file(ply_bytes, tmp_path / "a.ply", rows, form=form)), rows, degree)


def test_header_lines_may_end_in_crlf(tmp_path, ply_bytes):
    rows = raw_rows(CORE)
    assert_scene(read_ply(scene_file(ply_bytes, tmp_path / "a.ply", rows, newline="\r\n")), rows, 0)


@pytest.mark.slow
@settings(deadline=None, max_examples=40)
@given(data=st.data(), degree=st.sampled_from([0, 1, 2, 3]), count=st.integers(1, 6))
def test_any_order_type_and_extra_columns(tmp_path_factory, ply_bytes, data, degree, count):
    extra = data.draw(st.lists(st.sampled_from(["nx", "segment", "uncertainty", "f_extra_0", "scale"]), unique=True))
    names = data.draw(st.permutations(names_of(degree) + extra))
    rows = raw_rows(names, count, seed=data.draw(st.integers(0, 99)))
    kinds = [data.draw(st.sampled_from(["float", "double"])) for _ in names]
    form = data.draw(st.sampled_from(["binary_little_endian", "binary_big_endian", "ascii"]))
    path = scene_file(ply_bytes, tmp_path_factory.getbasetemp() / "any.ply", rows, names, kinds, form)
    assert_scene(read_ply(path), rows, degree)


def test_integer_columns_are_numbers(tmp_path, ply_bytes):
    rows = [{**row, "f_dc_0": 200, "rot_0": -3, "x": 70000} for row in raw_rows(CORE, 3)]
    kinds = [{"f_dc_0": "uchar", "rot_0": "short", "x": "uint"}.get(n, "float") for n in CORE]
    assert_scene(read_ply(scene_file(ply_bytes, tmp_path / "a.ply", rows, CORE, kinds)), rows, 0)


def test_other_columns_are_kept_and_written_back(tmp_path, ply_bytes, caplog):
    rows = raw_rows([*CORE, "nx", "ny", "nz", "confidence"])
    for i, row in enumerate(rows):
        row["instance"] = 70000 + i
    kinds = ["float"] * (len(CORE) + 3) + ["double", "int"]
    with caplog.at_level(logging.WARNING, logger="sgwarp"):
        scene = read_ply(scene_file(ply_bytes, tmp_path / "a.ply", rows, kinds=kinds))
    assert not caplog.records
    assert {name: column.dtype.kind for name, column in scene.extras.items()} == {"confidence": "f", "instance": "i"}
    write_ply(scene.subset(torch.tensor([3, 1])), tmp_path / "b.ply")
    written = read_elements(tmp_path / "b.ply")["vertex"]
    assert written["instance"].tolist() == [70003, 70001]
    assert written["confidence"].tolist() == [rows[3]["confidence"], rows[1]["confidence"]]
    assert written.dtype["confidence"] == "<f8"
    assert read_ply(tmp_path / "b.ply").means.tolist() == scene.means[[3, 1]].tolist()


def test_two_scales_are_flat_gaussians(tmp_path, ply_bytes, caplog):
    """2D Gaussian Splatting writes no scale_2; the third axis is the normal."""
    rows = raw_rows(CORE)
    names = [name for name in CORE if name != "scale_2"]
    with caplog.at_level(logging.WARNING, logger="sgwarp"):
        scene = load_gaussians(scene_file(ply_bytes, tmp_path / "a.ply", rows, names))
    assert "has two scales a Gaussian (2DGS)" in caplog.text
    assert scene.scales[:, 2].tolist() == [0.0] * len(rows)
    assert scene.scales[:, 1].tolist() == pytest.approx([math.exp(row["scale_1"]) for row in rows])
    assert scene.quats.tolist() == [[row[f"rot_{k}"] for k in range(4)] for row in rows]
    save_gaussians(scene, tmp_path / "b.ply")
    assert load_gaussians(tmp_path / "b.ply").scales.tolist() == scene.scales.tolist()


@pytest.mark.parametrize(
    ("kind", "values", "white"),
    [
        ("uchar", [0, 51, 255], 255),
        ("ushort", [0, 13107, 65535], 65535),
        ("ushort", [0, 51, 255], 255),
        ("int", [0, 51, 255], 255),
        ("float", [0.0, 0.25, 1.0], 1),
        ("float", [0.0, 63.75, 255.0], 255),
        ("double", [0.0, 16383.75, 65535.0], 65535),
    ],
)
@pytest.mark.parametrize("names", [("red", "green", "blue"), ("R", "G", "B")])
def test_plain_colors(tmp_path, ply_bytes, kind, values, white, names):
    rows = [row | dict(zip(names, values, strict=True)) for row in raw_rows(CORE)]
    columns = [name for name in CORE if not name.startswith("f_dc")] + list(names)
    kinds = ["float"] * (len(columns) - 3) + [kind] * 3
    scene = load_gaussians(scene_file(ply_bytes, tmp_path / "a.ply", rows, columns, kinds))
    assert scene.sh.shape == (len(rows), 1, 3)
    assert scene.extras is None
    colors = scene.sh[0, 0] * 0.28209479177387814 + 0.5
    assert colors.tolist() == pytest.approx([value / white for value in values], abs=1e-6)


def test_filter_of_mip_splatting_is_applied(tmp_path, ply_bytes):
    rows = raw_rows([*CORE, "filter_3D"])
    for row in rows:
        row["filter_3D"] = 0.5
    scene = load_gaussians(scene_file(ply_bytes, tmp_path / "a.ply", rows))
    assert scene.extras is None
    for i, row in enumerate(rows):
        before = [math.exp(row[f"scale_{k}"]) for k in range(3)]
        after = [math.sqrt(scale**2 + 0.25) for scale in before]
        assert scene.scales[i].tolist() == pytest.approx(after, rel=1e-5)
        faded = math.prod(before) / math.prod(after) / (1 + math.exp(-row["opacity"]))
        assert scene.opacities[i].item() == pytest.approx(faded, rel=1e-5)


def test_degree_four_is_cut_to_three(tmp_path, ply_bytes, caplog):
    names = CORE + [f"f_rest_{i}" for i in range(72)]
    rows = raw_rows(names)
    with caplog.at_level(logging.WARNING, logger="sgwarp"):
        scene = load_gaussians(scene_file(ply_bytes, tmp_path / "a.ply", rows))
    assert "harmonics of degree 4; up to 3 are kept" in caplog.text
    assert scene.sh[0, 1:, 1].tolist() == [rows[0][f"f_rest_{24 + i}"] for i in range(15)]


@pytest.mark.parametrize(
    ("names", "what"),
    [
        (["x", "y", "z", "f_offset_0", "f_anchor_feat_0", "opacity", "scale_0", "rot_0"], "Scaffold-GS"),
        ([*CORE, "trbf_center", "motion_0"], "SpacetimeGaussians, which moves"),
        (["x", "y", "z", "sb_params_0", "opacity"], "Deformable Beta Splatting"),
    ],
)
def test_relatives_are_named(tmp_path, ply_bytes, names, what):
    with pytest.raises(InputError, match=rf"a\.ply: is a.* {what}.*, not a 3DGS scene; "):
        load_gaussians(scene_file(ply_bytes, tmp_path / "a.ply", raw_rows(names)))


def test_mesh_is_told_apart(tmp_path, ply_bytes):
    vertex = ("vertex", [("float", n) for n in "xyz"], [[0.0, 1.0, 2.0]])
    (tmp_path / "a.ply").write_bytes(ply_bytes([vertex, ("face", [("int", "a")], [[0]])]))
    with pytest.raises(InputError, match=r"a\.ply: is a mesh, not a 3DGS scene"):
        load_gaussians(tmp_path / "a.ply")


def test_other_elements_are_ignored(tmp_path, ply_bytes):
    rows = raw_rows(CORE)
    table = [[row[n] for n in CORE] for row in rows]
    elements = [("camera", [("float", "fx")], [[1.0]]), ("vertex", [("float", n) for n in CORE], table)]
    (tmp_path / "a.ply").write_bytes(ply_bytes(elements))
    assert_scene(read_ply(tmp_path / "a.ply"), rows, 0)


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
def test_round_trip(tmp_path, coefficients):
    before = some_gaussians(coefficients=coefficients)
    write_ply(before, tmp_path / "a.ply")
    after = read_ply(tmp_path / "a.ply")
    for name in ("means", "quats", "sh"):
        assert torch.equal(getattr(after, name), getattr(before, name))
    for name in ("scales", "opacities"):
        torch.testing.assert_close(getattr(after, name), getattr(before, name), rtol=1e-6, atol=0)


def test_round_trip_of_extremes(tmp_path):
    opacities = torch.tensor([0.0, 1.0, 1e-7, 1 - 2**-24, 0.5, 1e-12])
    scales = torch.tensor([0.0, 1e-7, 1e4, 1.0, 1e-30, 1e10])[:, None].repeat(1, 3)
    before = some_gaussians(6)
    before = Gaussians(before.means * 1e5, torch.zeros(6, 4), scales, opacities, before.sh)
    write_ply(before, tmp_path / "a.ply")
    after = read_ply(tmp_path / "a.ply")
    assert torch.equal(after.opacities[:2], opacities[:2])
    torch.testing.assert_close(after.opacities, opacities, rtol=2e-6, atol=0)
    assert after.scales[0].tolist() == [0, 0, 0]
    torch.testing.assert_close(after.scales, scales, rtol=4e-6, atol=0)
    assert torch.equal(after.quats, before.quats)
    logits = read_elements(tmp_path / "a.ply")["vertex"]["opacity"]
    assert np.isfinite(logits).all()


def test_written_columns_are_those_of_the_reference(tmp_path):
    write_ply(some_gaussians(3, 4), tmp_path / "a.ply")
    header = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")[0].decode().splitlines()
    names = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 f_rest_0 f_rest_1 f_rest_2 f_rest_3 f_rest_4 f_rest_5 f_rest_6 "
    names += "f_rest_7 f_rest_8 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
    assert header[:2] == ["ply", "format binary_little_endian 1.0"]
    assert [line for line in header if line.startswith("property")] == [f"property float {n}" for n in names.split()]
    body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)[1]
    assert len(body) == 3 * 4 * len(names.split())
    g = some_gaussians(3, 4)
    row = struct.unpack_from("<26f", body, 26 * 4)  # the second Gaussian
    assert row[:3] == tuple(g.means[1].tolist())
    assert row[9:18] == tuple(g.sh[1, 1:].T.flatten().tolist())
    assert row[18] == pytest.approx(math.log(g.opacities[1] / (1 - g.opacities[1])), rel=1e-5)


def test_rows_beyond_one_block(tmp_path):
    before = some_gaussians(40_000, 1)
    write_ply(before, tmp_path / "a.ply")
    assert torch.equal(read_ply(tmp_path / "a.ply").means, before.means)


def test_non_finite_rows_are_kept_and_counted(tmp_path, ply_bytes, caplog):
    rows = raw_rows(CORE, 6)
    rows[1]["x"], rows[3]["scale_1"], rows[4]["opacity"] = math.nan, math.inf, math.nan
    with caplog.at_level(logging.WARNING, logger="sgwarp"):
        gaussians = read_ply(scene_file(ply_bytes, tmp_path / "a.ply", rows))
    assert len(gaussians) == 6
    assert gaussians.finite.tolist() == [True, False, True, False, False, True]
    assert "3 of 6 Gaussians hold NaN or infinity" in caplog.text
    write_ply(gaussians, tmp_path / "b.ply")
    assert read_ply(tmp_path / "b.ply").finite.tolist() == gaussians.finite.tolist()


def test_logits_beyond_exp_are_opaque_or_clear(tmp_path, ply_bytes):
    rows = raw_rows(CORE, 2)
    rows[0]["opacity"], rows[1]["opacity"] = 1e30, -1e30
    assert read_ply(scene_file(ply_bytes, tmp_path / "a.ply", rows)).opacities.tolist() == [1.0, 0.0]


def test_double_beyond_float_is_non_finite(tmp_path, ply_bytes):
    rows = [{**row, "x": 1e300} for row in raw_rows(CORE, 2)]
    path = scene_file(ply_bytes, tmp_path / "a.ply", rows, CORE, ["double"] * len(CORE))
    assert read_ply(path).non_finite == 2


@pytest.mark.parametrize("form", ["binary_little_endian", "binary_big_endian"])
def test_cut_short_at_every_place(tmp_path, ply_bytes, form):
    path = scene_file(ply_bytes, tmp_path / "a.ply", raw_rows(CORE, 4), form=form)
    data = path.read_bytes()
    body = data.index(b"end_header\n") + len(b"end_header\n")
    for length in (body, body + 1, body + 14 * 4, len(data) - 5, len(data) - 1):
        path.write_bytes(data[:length])
        rows = (length - body) // (14 * 4)
        expected = (
            rf"a\.ply: is cut short: .*'vertex' should hold 4 rows \(224 bytes.*ends after {rows} rows \({length} "
        )
        with pytest.raises(InputError, match=expected):
            load_gaussians(path)
    for length in (0, 3, 4, 30, body // 2, body - 1):
        path.write_bytes(data[:length])
        with pytest.raises(InputError, match=r"a\.ply: is not a valid PLY file"):
            load_gaussians(path)


def test_ascii_cut_short_and_malformed(tmp_path, ply_bytes):
    path = scene_file(ply_bytes, tmp_path / "a.ply", raw_rows(CORE, 3), form="ascii")
    text = path.read_text()
    path.write_text(text[: text.rstrip().rindex("\n")])
    with pytest.raises(InputError, match=r"should hold 3 rows.*ends after 2 rows"):
        load_gaussians(path)
    path.write_text(text.rstrip() + " 1.0\n")
    with pytest.raises(InputError, match=r"row 2: expected end-of-line; the file is damaged"):
        load_gaussians(path)
    path.write_text(text.replace("end_header\n", "end_header\nspam "))
    with pytest.raises(InputError, match=r"row 0: property 'x': malformed input"):
        load_gaussians(path)


def test_missing_columns_are_named(tmp_path, ply_bytes):
    names = [n for n in CORE if n not in ("opacity", "rot_2")]
    with pytest.raises(InputError, match=r"a\.ply: lacks the columns opacity, rot_2 of a 3DGS scene"):
        load_gaussians(scene_file(ply_bytes, tmp_path / "a.ply", raw_rows(names)))


def test_point_cloud_is_told_apart(tmp_path, ply_bytes):
    path = scene_file(ply_bytes, tmp_path / "a.ply", raw_rows(["x", "y", "z", "red"]))
    with pytest.raises(InputError, match=r"a\.ply: is a point cloud, not a 3DGS scene; fit a scene"):
        load_gaussians(path)


def test_values_that_were_stored_as_they_are_are_suspected(tmp_path, ply_bytes, caplog):
    """Opacities of 0.95 and scales of 0.05 would be read as 0.72 and 1.05."""
    rows = raw_rows(names_of(0))
    load_gaussians(scene_file(ply_bytes, tmp_path / "usual.ply", rows))
    assert "stored as they are" not in caplog.text
    rows = [row | {"opacity": 0.95} | {f"scale_{axis}": 0.05 for axis in range(3)} for row in rows]
    load_gaussians(scene_file(ply_bytes, tmp_path / "odd.ply", rows))
    assert "odd.ply: its scales are all positive and its opacities all in 0 to 1: were they stored" in caplog.text


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "git lfs pull"),
        (b"\n<!DOCTYPE html><html>", "is a web page, not the file itself"),
    ],
)
@pytest.mark.parametrize("name", ["a.ply", "a.spz", "a.splat"])
def test_what_was_downloaded_in_place_of_a_file_is_named(tmp_path, name, content, expected):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=expected):
        load_gaussians(tmp_path / name)


@pytest.mark.parametrize("count", [1, 3, 8, 10, 44, 48])
def test_wrong_number_of_coefficients(tmp_path, ply_bytes, count):
    path = scene_file(ply_bytes, tmp_path / "a.ply", raw_rows(CORE + [f"f_rest_{i}" for i in range(count)]))
    with pytest.raises(InputError, match=rf"a\.ply: has {count} columns f_rest_\*"):
        load_gaussians(path)


def test_gap_in_the_coefficients(tmp_path, ply_bytes):
    path = scene_file(ply_bytes, tmp_path / "a.ply", raw_rows(CORE + [f"f_rest_{i}" for i in range(1, 10)]))
    with pytest.raises(InputError, match=r"has 9 columns f_rest_\*, expected none, or f_rest_0"):
        load_gaussians(path)


def test_empty_scene(tmp_path, ply_bytes):
    path = tmp_path / "a.ply"
    for form in ("binary_little_endian", "ascii"):
        path.write_bytes(ply_bytes([("vertex", [("float", n) for n in CORE], [])], form))
        with pytest.raises(InputError, match=r"a\.ply: has no Gaussians"):
            load_gaussians(path)
    with pytest.raises(InputError, match="no Gaussians"):
        save_gaussians(some_gaussians(0), tmp_path / "b.ply")
    assert not (tmp_path / "b.ply").exists()


def test_list_column(tmp_path, ply_bytes):
    path = scene_file(ply_bytes, tmp_path / "a.ply", raw_rows(CORE, 1))
    header, body = path.read_bytes().split(b"property float x\n")
    values = body.split(b"end_header\n")[1]
    lists = header + b"property list uchar float x\n" + body.split(b"end_header\n")[0] + b"end_header\n"
    path.write_bytes(lists + b"\x01" + values)
    with pytest.raises(InputError, match=r"a\.ply: column x holds lists"):
        load_gaussians(path)


def test_no_vertex_element(tmp_path, ply_bytes):
    (tmp_path / "a.ply").write_bytes(ply_bytes([("points", [("float", "x")], [[1.0]])]))
    with pytest.raises(InputError, match=r"a\.ply: has no element 'vertex' \(it has: points\)"):
        load_gaussians(tmp_path / "a.ply")


def test_missing_file_folder_and_foreign(tmp_path):
    with pytest.raises(InputError) as caught:
        load_gaussians(tmp_path / "none.ply")
    assert str(caught.value) == f"{tmp_path / 'none.ply'}: no such file; check the path"
    with pytest.raises(InputError, match="is a folder"):
        load_gaussians(tmp_path)
    (tmp_path / "a.ply").write_bytes(b"BM\x02\0\0\0")
    with pytest.raises(InputError, match=r"a\.ply: is not a valid PLY file"):
        load_gaussians(tmp_path / "a.ply")
    for name, message in (
        ("a.zip", "is an archive, which is not read; unpack it"),
        ("a.ksplat", r"is \.ksplat .*; convert it to \.ply or \.spz with splat-transform"),
        ("a.las", r"is a point cloud \(\.las\), which is not read; fit a scene"),
        ("a.usdz", "is USD"),
        ("a.bin", r"nor a scene of another format that is read \(\.compressed\.ply, \.ply, \.spz, \.splat, \.glb"),
        ("a.json", "is no scene of Gaussians"),
    ):
        (tmp_path / name).write_bytes(b"\0\1\2")
        with pytest.raises(InputError, match=rf"{name}: .*{message}"):
            load_gaussians(tmp_path / name)
    (tmp_path / "a.json").write_text('{"frames": []}')
    with pytest.raises(InputError, match=r"a\.json: holds cameras, not a scene; .*--views"):
        load_gaussians(tmp_path / "a.json")


@pytest.mark.parametrize(
    "damage",
    [
        ("element vertex 5", "element vertex -5"),
        ("element vertex 5", "element vertex 99999999999999999999"),
        ("element vertex 5", "element vertex many"),
        ("property float x", "property complex x"),
        ("property float x", "property float y"),
        ("format binary_little_endian 1.0", "format binary_little_endian 2.0"),
        ("end_header", "end_header and more"),
    ],
)
def test_damaged_header(tmp_path, ply_bytes, damage):
    path = scene_file(ply_bytes, tmp_path / "a.ply", raw_rows(CORE))
    path.write_bytes(path.read_bytes().replace(damage[0].encode(), damage[1].encode(), 1))
    with pytest.raises(InputError, match=r"a\.ply: is (not a valid PLY file|cut short)"):
        load_gaussians(path)


def test_name_chooses_the_format(tmp_path):
    before = some_gaussians(10, 1)
    save_gaussians(before, tmp_path / "a.PLY")
    assert torch.equal(load_gaussians(tmp_path / "a.PLY").means, before.means)
    save_gaussians(before, tmp_path / "deep" / "a.compressed.ply")
    assert b"element chunk 1\n" in (tmp_path / "deep" / "a.compressed.ply").read_bytes()
    with pytest.raises(InputError, match=r"a\.sog: scenes are written as .*\.ply, \.spz, \.splat, \.glb; change"):
        save_gaussians(before, tmp_path / "a.sog")
    for name in ("b.spz", "b.splat", "b.glb"):
        save_gaussians(before, tmp_path / name)
        (tmp_path / name).rename(tmp_path / (name if name == "b.splat" else "c.ply"))  # told apart by content
        after = load_gaussians(tmp_path / ("b.splat" if name == "b.splat" else "c.ply"))
        assert (after.means - before.means).abs().max() < 2e-4
        save_gaussians(before, tmp_path / name, axes="luf")
        turned = load_gaussians(tmp_path / name, axes="ldf")  # said wrong: up and down, forward and back differ
        assert (turned.means - before.means * torch.tensor([1.0, -1.0, 1.0])).abs().max() < 2e-4
    with pytest.raises(InputError, match="axes 'xyz': expected R or L"):
        load_gaussians(tmp_path / "a.PLY", axes="xyz")


@settings(deadline=None, max_examples=150)
@given(body=st.binary(max_size=700), degree=st.sampled_from([0, 1]), ascii_form=st.booleans())
def test_random_bytes_after_the_header(tmp_path_factory, ply_bytes, allow_input_error, body, degree, ascii_form):
    form = "ascii" if ascii_form else "binary_little_endian"
    names = names_of(degree)
    header = ply_bytes([("vertex", [("float", n) for n in names], [[0.0] * len(names)] * 3)], form)
    path = tmp_path_factory.getbasetemp() / "random.ply"
    path.write_bytes(header[: header.index(b"end_header\n") + 11] + body)
    with allow_input_error(path):
        assert len(load_gaussians(path)) == 3


@settings(deadline=None, max_examples=150)
@given(position=st.integers(0, 10_000), value=st.binary(min_size=1, max_size=3))
def test_damaged_anywhere(tmp_path_factory, ply_bytes, allow_input_error, position, value):
    path = tmp_path_factory.getbasetemp() / "damaged.ply"
    data = scene_file(ply_bytes, path, raw_rows(CORE, 2)).read_bytes()
    position %= len(data)
    path.write_bytes(data[:position] + value + data[position + len(value) :])
    with allow_input_error(path):
        load_gaussians(path)


def test_a_folder_that_holds_scenes_names_the_last(tmp_path, ply_bytes):
    """What a 3DGS trainer leaves: the iteration of the highest number counts."""
    for number in (7000, 30000):
        folder = tmp_path / f"point_cloud/iteration_{number}"
        folder.mkdir(parents=True)
        (folder / "point_cloud.ply").write_bytes(b"")
    with pytest.raises(InputError, match=r"is a folder; give its scene, .*iteration_30000/point_cloud\.ply"):
        load_gaussians(tmp_path)
    (tmp_path / "alone").mkdir()
    (tmp_path / "alone/a.spz").write_bytes(b"")
    with pytest.raises(InputError, match=r"is a folder; give its scene, .*alone/a\.spz"):
        load_gaussians(tmp_path / "alone")


@pytest.mark.parametrize(("shift", "said"), [(0.0, False), (1e3, False), (5.4e6, True)])
def test_positions_that_float32_cannot_hold_are_said(tmp_path, ply_bytes, caplog, shift, said):
    """In UTM coordinates, steps of 0.5 m between Gaussians of 0.14 m, whatever type the columns have."""
    rows = raw_rows(CORE)
    for row in rows:
        row["x"] += shift
        row.update({f"scale_{axis}": -2.0 for axis in range(3)})
    load_gaussians(scene_file(ply_bytes, tmp_path / "a.ply", rows, kinds=["double"] * len(rows[0])))
    assert ("lies so far from the origin" in caplog.text) is said


@pytest.mark.parametrize("form", ["binary_little_endian", "ascii"])
@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("end_header", "comment made by J\xf6rg{0}end_header"),
        ("end_header", "obj_info late{0}end_header"),
        ("element", "{0}element"),
        ("element", "comment end_header comes later{0}element"),
    ],
)
def test_headers_as_other_tools_write_them(tmp_path, ply_bytes, before, after, newline, form):
    rows = raw_rows(names_of(1))
    path = scene_file(ply_bytes, tmp_path / "a.ply", rows, form=form, newline=newline)
    path.write_bytes(path.read_bytes().replace(before.encode(), after.format(newline).encode("latin-1"), 1))
    assert_scene(read_ply(path), rows, 1)


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_blank_lines_between_rows(tmp_path, ply_bytes, newline):
    rows = raw_rows(names_of(0))
    path = scene_file(ply_bytes, tmp_path / "a.ply", rows, form="ascii", newline=newline)
    head, end, body = path.read_bytes().partition(b"end_header" + newline.encode())
    blank = newline.encode() + b" \t" + newline.encode() * 2
    path.write_bytes(head + end + blank + body.replace(newline.encode(), blank))
    assert_scene(read_ply(path), rows, 0)


def test_a_binary_header_that_ends_in_cr_is_not_cut_short(tmp_path, ply_bytes):
    rows = [{name: 1.0 for name in CORE} for _ in range(5)]  # no byte of 1.0 is a newline
    rows[4]["x"] = struct.unpack("<f", b"\n\n\n\n")[0]
    assert_scene(read_ply(scene_file(ply_bytes, tmp_path / "a.ply", rows, newline="\r")), rows, 0)


@pytest.mark.parametrize("name", ["opacity", "scale_1", "rot_0"])
def test_bytes_are_no_logits(tmp_path, ply_bytes, name):
    kinds = ["uchar" if column == name else "float" for column in CORE]
    rows = [{column: 128 if column == name else 0.5 for column in CORE}]
    path = scene_file(ply_bytes, tmp_path / "a.ply", rows, kinds=kinds)
    with pytest.raises(InputError, match=rf"a\.ply: its column {name} holds whole numbers from 0 up, expected logits"):
        read_ply(path)


@pytest.mark.parametrize("ending", [".compressed.ply", ".spz", ".splat", ".glb"])
def test_what_is_not_rendered_does_not_come_to_be_seen(tmp_path, ending, caplog):
    scene = some_gaussians(6, 1)
    scene.quats[0], scene.quats[1, 2], scene.opacities[2] = 0, math.nan, math.nan
    scene.sh[3, 0, 1], scene.means[4, 0] = math.inf, -math.inf
    save_gaussians(scene, tmp_path / f"a{ending}")
    assert "left out 5 of 6 Gaussians with NaN, infinity or a rotation of zero" in caplog.text
    after = load_gaussians(tmp_path / f"a{ending}")
    assert after.means.tolist() == [pytest.approx(scene.means[5].tolist(), abs=1e-3)]
    with pytest.raises(InputError, match="not written, the scene has no Gaussians"):
        save_gaussians(scene.subset(torch.arange(5)), tmp_path / f"b{ending}")
    assert not (tmp_path / f"b{ending}").exists()
