import base64
import json
import math
import struct

import numpy as np
import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.io.formats.gltf import read_gltf, write_gltf
from sgwarp.io.formats.spz import write_spz

NAME = "KHR_gaussian_splatting"


def document(tmp_path, attributes, form="uri", nodes=None, change=None, extension=None):
    """A file written by hand; attributes: name -> (component type, type, struct format, rows)."""
    body, accessors, views = b"", [], []
    for component, kind, code, rows, *more in attributes.values():
        data = b"".join(struct.pack(f"<{len(row)}{code}", *row) for row in rows)
        views.append({"buffer": 0, "byteOffset": len(body), "byteLength": len(data)})
        accessors.append({"bufferView": len(views) - 1, "componentType": component, "type": kind, "count": len(rows)})
        accessors[-1].update(*more)
        body += data + bytes(-len(data) % 4)
    primitive = {
        "mode": 0,
        "attributes": {name: index for index, name in enumerate(attributes)},
        "extensions": {NAME: extension or {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    meta = {
        "asset": {"version": "2.0"},
        "meshes": [{"primitives": [primitive]}],
        "nodes": nodes or [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [
            {"byteLength": len(body), "uri": "data:application/octet-stream;base64," + base64.b64encode(body).decode()}
        ],
    }
    if form == "file":
        (tmp_path / "a b.bin").write_bytes(body)
        meta["buffers"][0]["uri"] = "a%20b.bin"
    if change:
        change(meta)
    path = tmp_path / "a.gltf"
    path.write_text(json.dumps(meta))
    return path


def two_gaussians(**more):
    return {
        "POSITION": (5126, "VEC3", "f", [(1.0, 2.0, 3.0), (4.0, 5.0, 6.0)]),
        f"{NAME}:ROTATION": (5126, "VEC4", "f", [(0.0, 0.6, 0.0, 0.8), (0.0, 0.0, 0.0, 1.0)]),
        f"{NAME}:SCALE": (5126, "VEC3", "f", [(0.1, 0.2, 0.3), (0.0, 1.0, 2.0)]),
        f"{NAME}:OPACITY": (5126, "SCALAR", "f", [(0.25,), (1.0,)]),
        f"{NAME}:SH_DEGREE_0_COEF_0": (5126, "VEC3", "f", [(0.5, -0.5, 1.5), (0.0, 0.1, 0.2)]),
        **more,
    }


@pytest.mark.parametrize("form", ["uri", "file"])
def test_attributes_mean_what_the_extension_says(tmp_path, form):
    scene = read_gltf(document(tmp_path, two_gaussians(), form), axes="rdf")
    assert scene.means.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert scene.quats[0].tolist() == pytest.approx([0.8, 0.0, 0.6, 0.0])
    assert scene.scales[1].tolist() == [0, 1, 2]
    assert scene.opacities.tolist() == [0.25, 1]
    assert scene.sh[0].tolist() == [[0.5, -0.5, 1.5]]
    turned = read_gltf(tmp_path / "a.gltf")  # glTF: x left, y up, z forward
    assert turned.means[0].tolist() == [-1, -2, 3]


def test_normalized_integers(tmp_path):
    attributes = two_gaussians()
    attributes[f"{NAME}:OPACITY"] = (5121, "SCALAR", "B", [(51,), (255,)], {"normalized": True})
    attributes[f"{NAME}:ROTATION"] = (5122, "VEC4", "h", [(0, 0, 0, 32767), (-32768, 0, 0, 0)], {"normalized": True})
    scene = read_gltf(document(tmp_path, attributes), axes="rdf")
    assert scene.opacities.tolist() == pytest.approx([0.2, 1.0])
    assert scene.quats.tolist() == [[1, 0, 0, 0], [0, -1, 0, 0]]


def test_nodes_move_the_scene(tmp_path, covariances):
    half = math.sqrt(0.5)
    inner = {"mesh": 0, "rotation": [0, half, 0, half], "scale": [2, 2, 2], "translation": [1, 0, 0]}
    outer = {"children": [1], "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 10, 20, 30, 1]}
    path = document(tmp_path, two_gaussians(), nodes=[outer, inner])
    scene = read_gltf(path, axes="rdf")
    # A quarter turn about y takes (x, y, z) to (z, y, -x).
    assert scene.means[0].tolist() == pytest.approx([2 * 3 + 11, 2 * 2 + 20, -2 * 1 + 30], abs=1e-5)
    assert torch.diagonal(covariances(scene)[1]).tolist() == pytest.approx([16, 4, 0], abs=1e-4)


def test_spz_inside(tmp_path, scene):
    before = scene(20)
    write_spz(before, tmp_path / "a.spz", axes="luf")
    packed = (tmp_path / "a.spz").read_bytes()

    def put(meta):
        meta["bufferViews"] = [{"buffer": 0, "byteLength": len(packed)}]
        meta["buffers"] = [{"byteLength": len(packed), "uri": "a.spz"}]

    inner = {"extensions": {f"{NAME}_compression_spz_2": {"bufferView": 0}}}
    after = read_gltf(document(tmp_path, two_gaussians(), change=put, extension=inner))
    assert (after.means - before.means).abs().max() < 2e-4


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
def test_round_trip(tmp_path, scene, rotations, coefficients):
    before = scene(50, coefficients)
    write_gltf(before, tmp_path / "a.glb")
    after = read_gltf(tmp_path / "a.glb")
    for name in ("means", "scales", "opacities", "sh"):
        assert torch.equal(getattr(after, name), getattr(before, name))
    assert (rotations(after.quats) - rotations(before.quats)).abs().max() < 1e-6
    data = (tmp_path / "a.glb").read_bytes()
    assert struct.unpack_from("<4sII", data) == (b"glTF", 2, len(data))
    size = struct.unpack_from("<I", data, 12)[0]
    meta = json.loads(data[20 : 20 + size])
    assert meta["extensionsUsed"] == [NAME]
    assert meta["accessors"][0]["min"] == pytest.approx((before.means * torch.tensor([-1, -1, 1])).amin(dim=0).tolist())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m["meshes"][0]["primitives"][0].pop("extensions"), "it is a mesh or a point cloud"),
        (lambda m: m["meshes"][0]["primitives"][0]["attributes"].pop("POSITION"), "lacks the attribute POSITION"),
        (lambda m: m["accessors"][0].update(count=10**9), r"attribute POSITION \(1000000000 rows\) lies outside"),
        (lambda m: m["accessors"][0].update(type="VEC2"), "attribute POSITION must hold 3 numbers"),
        (lambda m: m["accessors"][0].update(bufferView=77), r"bufferViews\[77\], which it does not hold"),
        (lambda m: m["bufferViews"][0].update(byteLength=10**9), "lies outside its buffer"),
        (lambda m: m["buffers"][0].update(uri="../secret"), "lies outside its folder"),
        (lambda m: m["buffers"][0].update(uri="gone.bin"), "no such file"),
        (lambda m: m["buffers"][0].update(uri="data:x;base64,?"), "data are damaged"),
        (lambda m: m["nodes"][0].update(children=[0]), "its nodes are no tree"),
        (lambda m: m["nodes"][0].update(scale=[1, 2, 1]), "not a rotation with one positive scale"),
        (lambda m: m["nodes"][0].update(rotation="x"), "'rotation' of a node must be 4 numbers"),
        (lambda m: m.pop("asset"), "is not a glTF file"),
    ],
)
def test_damaged(tmp_path, change, message):
    path = document(tmp_path, two_gaussians(), change=change)
    with pytest.raises(InputError, match=message):
        read_gltf(path)


def test_numbers_of_rows_must_agree(tmp_path):
    attributes = two_gaussians()
    attributes["POSITION"] = (5126, "VEC3", "f", [(1.0, 2.0, 3.0)])
    with pytest.raises(InputError, match=r"hold \[1, 2\] Gaussians"):
        read_gltf(document(tmp_path, attributes))
    attributes = two_gaussians()
    attributes[f"{NAME}:OPACITY"] = (5126, "SCALAR", "f", [(0.25,), (1.5,)])
    with pytest.raises(InputError, match="an opacity outside 0 to 1"):
        read_gltf(document(tmp_path, attributes))


def test_mutated_files(tmp_path, scene, survives):
    write_gltf(scene(20), tmp_path / "a.glb")
    survives(tmp_path / "a.glb", read_gltf)
    survives(document(tmp_path, two_gaussians()), read_gltf)


def test_only_binary_is_written(tmp_path, scene):
    with pytest.raises(InputError, match=r"written as \.glb"):
        write_gltf(scene(), tmp_path / "a.gltf")
    assert np.array_equal(list(tmp_path.iterdir()), [])


def test_a_draft_of_the_extension_is_named(tmp_path):
    attributes = {key.replace(f"{NAME}:", "_"): value for key, value in two_gaussians().items()}
    with pytest.raises(InputError, match=r"lacks the attribute .*:ROTATION; it follows a draft of the extension"):
        read_gltf(document(tmp_path, attributes))


def test_the_scene_to_show_is_read(tmp_path):
    def two_scenes(meta):
        meta["nodes"] = [{"mesh": 0, "translation": [100, 0, 0]}, {"mesh": 0, "translation": [0, 10, 0]}]
        meta.update(scenes=[{"nodes": [0]}, {"nodes": [1]}], scene=1)

    scene = read_gltf(document(tmp_path, two_gaussians(), change=two_scenes), axes="RDF")
    assert scene.means.tolist() == [[1, 12, 3], [4, 15, 6]]
    path = document(tmp_path, two_gaussians(), change=lambda m: m.update(scene=7))
    with pytest.raises(InputError, match=r"refers to scenes\[7\]"):
        read_gltf(path)


def test_meshes_beside_are_left_alone(tmp_path):
    def mesh(meta):
        meta["meshes"].insert(0, {"primitives": [{"attributes": {"POSITION": 0}, "mode": 4}]})
        meta["meshes"][1]["primitives"].insert(0, {"attributes": {"POSITION": 0}})
        meta["nodes"] = [{"mesh": 0, "children": [1]}, {"mesh": 1}]

    scene = read_gltf(document(tmp_path, two_gaussians(), form="file", change=mesh), axes="RDF")
    assert scene.means.tolist() == [[1, 2, 3], [4, 5, 6]]


def test_packed_numbers_are_refused(tmp_path):
    def meshopt(meta):
        meta["extensionsRequired"] = ["KHR_mesh_quantization", "EXT_meshopt_compression"]
        meta["buffers"].append({"byteLength": 9, "extensions": {"EXT_meshopt_compression": {"fallback": True}}})

    with pytest.raises(
        InputError, match=r"a\.gltf: its data are packed \(EXT_meshopt_compression\), which is not read"
    ):
        read_gltf(document(tmp_path, two_gaussians(), change=meshopt))


def test_a_sheared_scene_names_its_file(tmp_path):
    path = document(tmp_path, two_gaussians(), change=lambda m: m["nodes"][0].update(scale=[1, 2, 1]))
    with pytest.raises(InputError, match=r"a\.gltf: one of its nodes moves the scene: the transform is not a rotation"):
        read_gltf(path)


def test_another_kernel_is_said(tmp_path, caplog):
    read_gltf(document(tmp_path, two_gaussians(), extension={"kernel": "box", "colorSpace": "srgb_rec709_display"}))
    assert "its kernel is box, taken for ellipse" in caplog.text
