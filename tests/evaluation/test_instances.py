"""Objects without classes end to end, against average precision from maps that the test renders and matches itself."""

import json
import shutil

import numpy as np
import pytest
import torch

import sgwarp as sg
from sgwarp.apps.instances.maps import render_ids
from sgwarp.cli import main
from sgwarp.evaluation.profiles.instances import add_objects
from sgwarp.files.images import read_ids
from sgwarp.metrics.detection import Detections


def run(profile, data, out, *options):
    assert main(["evaluate", profile, "--data", str(data), "--out", str(out), "--sheets", "1", *options]) == 0
    return json.loads((out / "results.json").read_text())


def precision(images, threshold, smallest=50):
    """Average precision of (ids, confidence, truth) by loops; every pixel belongs to an object, small ones do not."""
    rows, total = [], 0
    for number, (ids, sure, truth) in enumerate(images):
        objects = {k: truth == k for k in np.unique(truth) if k and (truth == k).sum() >= smallest}
        total += len(objects)
        outside = ~np.any([*objects.values()], axis=0)
        for k in np.unique(ids):
            mask = ids == k
            if k and mask.sum() >= smallest:
                rows.append((-float(sure[mask].mean()), number, mask, objects, outside))
    found, kept = set(), []
    for _, number, mask, objects, outside in sorted(rows, key=lambda row: row[:2]):
        best = max(
            (((mask & o).sum() / (mask | o).sum(), k) for k, o in objects.items() if (number, k) not in found),
            default=(0.0, 0),
        )
        if best[0] > threshold:
            found.add((number, best[1]))
            kept.append(True)
        elif (mask & outside).sum() / mask.sum() <= threshold:
            kept.append(False)
    hits = np.cumsum(kept)
    points = [(hit / (k + 1), hit) for k, hit in enumerate(hits)]
    return sum(max((p for p, hit in points if hit >= k), default=0.0) for k in range(1, total + 1)) / total


def test_objects_in_held_out_views(rooms, tmp_path):
    found = run("room-instances", rooms, tmp_path / "out", "--scenes", "one", "--hold-out", "4")
    room = rooms / "one"
    scene = found["scenes"]["one"]
    assert scene["views"] == {"lifted": 6, "scored": 3}
    views, gaussians = sg.load_views(room), sg.load_gaussians(room / "scene.ply")
    # The same masks by a name of files, and the test's own matching.
    names = {view.stem: view for index, view in enumerate(views) if index % 4}
    instances = sg.instances(gaussians, list(names.values()), f"files:{room}/instances")
    images = []
    for view in views[::4]:
        ids, sure = render_ids(gaussians, instances, view.camera)
        images.append((ids.numpy(), sure.numpy(), read_ids(room / "instances" / f"{view.stem}.png")))
    assert scene["figures"]["ap50"] == pytest.approx(precision(images, 0.5), abs=1e-6)
    assert scene["figures"]["ap25"] == pytest.approx(precision(images, 0.25), abs=1e-6)
    assert 0.2 < scene["figures"]["ap50"] <= scene["figures"]["ap25"] <= 1
    assert scene["bytes_per_gaussian"] == 3 * (4 + 2) + 2  # three candidates
    assert (tmp_path / "out" / scene["sheets"][0]).is_file()


def test_objects_on_the_mesh(rooms, tmp_path):
    """Vertices at Gaussians, most of them decided; what is on walls and floor is not scored."""
    room, name = rooms / "one", "scene0000_00"
    folder = tmp_path / "data" / "scans" / name
    (folder / "pose").mkdir(parents=True)
    shutil.copytree(room / "images", folder / "color")
    shutil.copytree(room / "instances", folder / "instance-filt")
    shutil.copytree(room / "labels", folder / "label-filt")
    (folder / "intrinsic").mkdir()
    (tmp_path / "data" / "scannetv2-labels.combined.tsv").write_text("id\tnyu40id\n1\t1\n")
    views, gaussians = sg.load_views(room), sg.load_gaussians(room / "scene.ply")
    K = np.eye(4)
    K[:3, :3] = views[0].camera.K.numpy()
    np.savetxt(folder / "intrinsic" / "intrinsic_color.txt", K)
    for view in views:
        np.savetxt(folder / "pose" / f"{view.stem}.txt", np.linalg.inv(view.camera.world_to_camera.numpy()))
    shutil.copy(room / "scene.ply", folder / "scene.ply")
    classes = gaussians.extras["label"]  # floor 0, ceiling 1, wall 2
    nyu = np.where(classes == 0, 2, np.where(classes == 2, 1, 5 + classes))
    instances = sg.instances(gaussians, views, f"files:{room}/instances")
    vertices = (instances.instance() > 0) & (gaussians.opacities >= 0.1)
    vertices[::20] = gaussians.opacities[::20] >= 0.1
    classes, nyu = classes[vertices.numpy()], nyu[vertices.numpy()]
    rows = [f"{x} {y} {z} {k}" for (x, y, z), k in zip(gaussians.means[vertices].tolist(), nyu, strict=True)]
    header = f"ply\nformat ascii 1.0\nelement vertex {len(rows)}\n" + "".join(f"property float {a}\n" for a in "xyz")
    mesh = header + "property ushort label\nend_header\n" + "\n".join(rows)
    (folder / f"{name}_vh_clean_2.labels.ply").write_text(mesh)
    options = ["--encoder", f"files:{room}/instances", "--every", "1"]
    refused = ["--out", str(tmp_path / "refused"), *options]
    assert main(["evaluate", "scannet-instances", "--data", str(tmp_path / "data"), *refused]) == 2
    (folder / f"{name}_vh_clean_2.0.010000.segs.json").write_text(json.dumps({"segIndices": classes.tolist()}))
    groups = [{"objectId": int(k), "segments": [int(k)]} for k in np.unique(classes)]
    (folder / f"{name}.aggregation.json").write_text(json.dumps({"segGroups": groups}))
    found = run("scannet-instances", tmp_path / "data", tmp_path / "out", *options)
    figures = found["scenes"][name]["figures"]
    ids, sure = instances.instance()[vertices].clamp(min=0).numpy(), instances.confidence()[vertices].numpy()
    mesh = [(ids, sure, np.where((classes == 0) | (classes == 2), 0, classes + 1))]
    assert figures["ap50"] == pytest.approx(precision(mesh, 0.5, smallest=100), abs=1e-6)
    assert figures["ap25"] == pytest.approx(precision(mesh, 0.25, smallest=100), abs=1e-6)
    assert figures["ap25"] > 0.1
    assert "Instok3D" in (tmp_path / "out" / "results.md").read_text()


def test_walls_count_for_nothing():
    """A prediction on what is not scored is no error; one that is half on an object is."""
    ids = torch.tensor([1] * 6 + [2] * 6 + [3] * 6)
    truth = torch.tensor([9] * 6 + [0] * 6 + [8] * 2 + [0] * 4)
    found = Detections()
    add_objects(found, ids, truth, torch.tensor([0.5] * 6 + [0.9] * 12), smallest=3)
    assert found.average_precision(0.5) == 1.0  # object 8 is too small, and 3 lies on nothing else
    wrong = Detections()
    add_objects(wrong, ids, truth, torch.tensor([0.5] * 6 + [0.9] * 12), smallest=1)
    assert wrong.average_precision(0.7) == pytest.approx(0.25)  # 3 is the surest, on neither


def test_semantics_are_refused(rooms, tmp_path, capsys):
    options = ["--data", str(rooms), "--out", str(tmp_path / "o"), "--semantics", "x.safetensors"]
    assert main(["evaluate", "room-instances", *options]) == 2
    assert "--semantics" in capsys.readouterr().err
    assert not (tmp_path / "o").exists()
