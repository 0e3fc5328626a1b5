"""Scenes of other programs, moving scenes, instances, edit scripts and lists: more of what the fuzzer starts from."""

import base64
import itertools
import json
import struct
import zipfile
from pathlib import Path

import cv2
import numpy as np
import torch
from fuzz_readers import Reader, camera, folder_of, gaussians

from sgwarp.apps.editing.script import load_script
from sgwarp.apps.tracking.fusion import Evidence, Fusion, FusionSettings
from sgwarp.apps.tracking.sources import LabelFrames
from sgwarp.apps.tracking.state import load_state, read_features, save_state
from sgwarp.apps.tracking.tracker import Tracker
from sgwarp.cluster.listing import list_scenes
from sgwarp.datasets import scannet, scenesplat
from sgwarp.datasets.base import read_class_names
from sgwarp.datasets.lerf_ovs import read_annotation
from sgwarp.datasets.scannet_classes import read_label_table
from sgwarp.evaluation.results import SceneResult, read_result, write_result
from sgwarp.files.atomic import atomic_path
from sgwarp.io.formats.dot_splat import write_splat
from sgwarp.io.formats.gltf import write_gltf
from sgwarp.io.formats.spz import write_spz
from sgwarp.io.instances import load_instances, save_instances
from sgwarp.io.moving_views import load_moving_views
from sgwarp.io.scenes import load_gaussians
from sgwarp.io.sequence_files import write_meta, write_params
from sgwarp.io.sequences import load_sequence
from sgwarp.io.world_transforms import read_world_transform
from sgwarp.scene import Instance, InstanceMap, View


def more_readers(root: Path) -> list[Reader]:
    """All pairs of this file, with their files in folders below `root`."""
    made: list[Reader] = []
    for make in (_foreign_scenes, _sog_folder, _moving, _tracking, _apps, _labeled, _scenesplat):
        made += make(root / make.__name__)
    return made


def _foreign_scenes(root: Path) -> list[Reader]:
    scene = gaussians()
    folder = folder_of(root, "scenes")
    for version in (2, 3, 4):
        write_spz(scene, folder / f"v{version}.spz", version)
    write_splat(scene, folder / "a.splat")
    write_gltf(scene, folder / "a.glb")
    _unpack_glb(folder / "a.glb", folder / "a.gltf")
    with zipfile.ZipFile(folder / "a.sog", "w") as archive:
        for name, data in _sog_members().items():
            archive.writestr(name, data)
    return [
        Reader(f"scene {file.name}", file, lambda file=file: load_gaussians(file)) for file in sorted(folder.iterdir())
    ]


def _unpack_glb(packed: Path, file: Path) -> None:
    """The same document as text, its buffer as a data URI."""
    data = packed.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    document = json.loads(data[20 : 20 + length])
    (size,) = struct.unpack_from("<I", data, 20 + length)
    content = data[28 + length : 28 + length + size]
    document["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(content).decode()
    file.write_text(json.dumps(document))


def _sog_members() -> dict[str, bytes]:
    random = np.random.default_rng(0)
    book = np.linspace(-3, 3, 256).tolist()
    names = {
        "means": ["means_l.webp", "means_u.webp"],
        "scales": ["scales.webp"],
        "quats": ["quats.webp"],
        "sh0": ["sh0.webp"],
        "shN": ["centroids.webp", "labels.webp"],
    }
    meta = {"version": 2, "count": 7} | {name: {"files": files} for name, files in names.items()}
    meta["means"] |= {"mins": [-1, -2, -3], "maxs": [1, 2, 3]}
    for name in ("scales", "sh0", "shN"):
        meta[name]["codebook"] = book
    meta["shN"] |= {"count": 70, "bands": 1}
    members = {"meta.json": json.dumps(meta).encode()}
    for name in itertools.chain(*names.values()):
        shape = (2, 64 * 3, 4) if name.startswith("centroids") else (2, 4, 4)
        pixels = random.integers(1, 255, shape).astype(np.uint8)
        if name.startswith("labels"):
            pixels[..., 1:3] = 0  # the low byte is OpenCV's third channel
            pixels[..., 2] %= 70
        pixels[..., 3] = 253 if name.startswith("quats") else 255
        members[name] = cv2.imencode(".webp", pixels, [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes()
    return members


def _sog_folder(root: Path) -> list[Reader]:
    folder = folder_of(root, "sog")
    for name, data in _sog_members().items():
        (folder / name).write_bytes(data)
    return [
        Reader(f"SOG {name}", folder / name, lambda: load_gaussians(folder)) for name in ("meta.json", "means_l.webp")
    ]


def _moving(root: Path) -> list[Reader]:
    folder = folder_of(root, "dynamic")
    write_params(folder / "params.npz", [gaussians(0), gaussians(0)], torch.arange(5) > 2)
    write_meta(folder / "train_meta.json", [View("0", camera()), View("1", camera())], 2)

    def frames() -> None:
        found = load_sequence(folder / "params.npz")
        for index in range(min(len(found), 3)):
            found.frame(index)

    def views() -> None:
        found = load_moving_views(folder, photographs=False)
        for index in range(min(found.frames or 0, 3)):
            found.at(index)

    return [
        Reader("params.npz", folder / "params.npz", frames),
        Reader("train_meta.json", folder / "train_meta.json", views),
    ]


def _tracking(root: Path) -> list[Reader]:
    features = folder_of(root, "features")
    rows = np.arange(5, dtype=np.int32)
    with atomic_path(features / "00000.npz") as file:
        values = np.ones((5, 4), np.float16)
        np.savez(file, shape=np.array([5, 4]), whole=np.array(True), rows=rows, features=values)
    state = folder_of(root, "state")

    def tracker() -> Tracker:
        made = Tracker(LabelFrames(state))
        made.fusion = Fusion(FusionSettings(), True)
        return made

    saved = tracker()
    saved.labels = ("chair",)
    saved.fusion.evidence = Evidence(torch.ones(5, 2), torch.ones(5), torch.ones(5), torch.zeros(5))
    save_state(state, saved, 3, {"steps": 3}, torch.zeros(5))
    return [
        Reader("tracked features", features / "00000.npz", lambda: read_features(features, 0)),
        Reader("tracking state", state / "state.pt", lambda: load_state(state, tracker(), {"steps": 3})),
    ]


def _apps(root: Path) -> list[Reader]:
    folder = folder_of(root, "apps")
    row = Instance(1, "default", 0, 3, 2, 2, 0.9, (0, 0, 1), (1, 0, 0, 0), (1, 1, 1), "chair", 0.5, (2,))
    other = Instance(2, "default", 0, 2, 1, 1, 0.8, (0, 1, 1), (1, 0, 0, 0), (1, 2, 1))
    candidates = torch.tensor([[[1, -1], [1, 2], [2, 0], [1, 2], [2, -1]]])
    shares = torch.tensor([[[1.0, 0], [0.7, 0.3], [0.9, 0.1], [0.6, 0.4], [1, 0]]])
    found = InstanceMap(candidates, shares, torch.ones(5), (row, other), ("default",), gaussians().fingerprint)
    save_instances(found, folder / "instances.safetensors", {"masks": "mine"})
    steps = [
        {"select": ["instance:1"], "do": "move", "by": [0.1, 0.0, 0.5]},
        {"select": ["box:0,0,0,1,1,1"], "do": "remove"},
    ]
    content = {"format": "sgwarp-edit", "version": 1, "scene": "x", "steps": steps}
    (folder / "script.json").write_text(json.dumps(content))
    (folder / "scenes.csv").write_text("path,steps\nnone/a,5\n" + f"{folder / 'none'},\n")
    (folder / "scenes.txt").write_text("# scenes\nnone/a steps=5\n\nnone/b\n")
    (folder / "dataparser_transforms.json").write_text(json.dumps({"transform": np.eye(4)[:3].tolist(), "scale": 2.0}))
    (folder / "matrix.txt").write_text("1 0 0 5\n0 1 0 6\n0 0 1 7\n")
    np.save(folder / "matrix.npy", np.eye(4))
    return [
        Reader("instances", folder / "instances.safetensors", lambda: load_instances(folder / "instances.safetensors")),
        Reader("edit script", folder / "script.json", lambda: load_script(folder / "script.json")),
        *(
            Reader(f"list {name}", folder / name, lambda name=name: list_scenes(str(folder / name)))
            for name in ("scenes.csv", "scenes.txt")
        ),
        *(
            Reader(f"transform {name}", folder / name, lambda name=name: read_world_transform(folder / name))
            for name in ("dataparser_transforms.json", "matrix.txt", "matrix.npy")
        ),
    ]


def _labeled(root: Path) -> list[Reader]:
    import plyfile

    folder = folder_of(root, "scene0000_00")
    entry = {"category": "cup", "segmentation": [[1, 1], [9, 1], [9, 8.5]], "bbox": [1, 1, 9, 8]}
    annotation = {"info": {"height": 12, "width": 16, "name": "frame_1.jpg"}, "objects": [entry]}
    (folder / "frame_1.json").write_text(json.dumps(annotation))
    (folder / "labels.tsv").write_text("id\traw_category\tnyu40id\n1\twall\t1\n2\tchair\t5\n7\tcup\t\n")
    (folder / "pose.txt").write_text("1 0 0 0.5\n0 1 0 1\n0 0 1 2\n0 0 0 1\n")
    (folder / "classes.json").write_text(json.dumps({"1": "couch", "2": "lamp"}))
    rows = np.array([(0, 1, 2, 5)] * 3, dtype=[*((axis, "f4") for axis in "xyz"), ("label", "u2")])
    mesh = folder / "scene0000_00_vh_clean_2.labels.ply"
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")]).write(str(mesh))
    write_result(folder / "record.json", SceneResult("a", figures={"miou": 0.5}), {"version": 1})

    def annotations() -> None:
        for query in read_annotation(folder / "frame_1.json"):
            query.mask()

    return [
        Reader("LERF-OVS annotation", folder / "frame_1.json", annotations),
        Reader("ScanNet labels.tsv", folder / "labels.tsv", lambda: read_label_table(folder / "labels.tsv")),
        Reader("ScanNet pose.txt", folder / "pose.txt", lambda: scannet.read_matrix(folder / "pose.txt")),
        Reader("ScanNet mesh", mesh, lambda: scannet.read_mesh(folder)),
        Reader("class names", folder / "classes.json", lambda: read_class_names(folder / "classes.json")),
        Reader(
            "evaluation record", folder / "record.json", lambda: read_result(folder / "record.json", {"version": 1})
        ),
    ]


def _scenesplat(root: Path) -> list[Reader]:
    folder = folder_of(root, "splat")
    random = np.random.default_rng(0)
    fields = {"coord": 3, "scale": 3, "quat": 4, "opacity": 1, "lang_feat": 6}
    arrays = {name: random.random((5, width)).astype(np.float32) for name, width in fields.items()}
    arrays["color"] = random.integers(0, 255, (5, 3)).astype(np.uint8)
    arrays["valid_feat_mask"], arrays["segment"] = np.ones(5, bool), np.arange(5) - 1
    for name, values in arrays.items():
        np.save(folder / f"{name}.npy", values)

    def read() -> None:
        scene = scenesplat.read_gaussians(folder)
        scenesplat.read_semantics(folder, scene)
        scenesplat.read_points(folder)

    return [
        Reader(f"SceneSplat {name}.npy", folder / f"{name}.npy", read) for name in ("coord", "opacity", "lang_feat")
    ]
