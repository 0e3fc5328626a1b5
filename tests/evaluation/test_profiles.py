"""Published protocols end to end, on a rendered room written in the published formats."""

import json
import shutil

import cv2
import numpy as np
import pytest
import torch

import sgwarp as sg
from sgwarp.cli import main
from sgwarp.datasets.moving import make_moving_scene
from sgwarp.datasets.moving_files import save_moving_scene
from sgwarp.datasets.scannet_classes import NYU40, SETS
from sgwarp.datasets.synthetic import CLASSES
from sgwarp.files.images import read_ids, read_rgb
from sgwarp.querying.segmentation import splat_scores
from sgwarp.scene import FeatureMap

ASKED = ("0002", "0005")  # annotated views


def run(profile, data, out, *options):
    assert main(["evaluate", profile, "--data", str(data), "--out", str(out), "--sheets", "1", *options]) == 0
    return json.loads((out / "results.json").read_text())


def copy_views(room, target):
    """A posed scene: photographs, cameras, Gaussians."""
    target.mkdir(parents=True)
    shutil.copytree(room / "images", target / "images")
    for name in ("transforms.json", "scene.ply"):
        shutil.copy(room / name, target / name)
    return target


def truth_of(room, stem):
    """Class of every pixel from 1 on, 0 for nothing."""
    return read_ids(room / "labels" / f"{stem}.png")


def shown(room, stem, least=12):
    ids = truth_of(room, stem)
    return [k for k in range(1, 11) if (ids == k).sum() >= least]


# --- LERF-OVS ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def lerf(rooms, tmp_path_factory):
    """The room as one of the four scenes; phrases are ids, annotations twice the size of the photographs."""
    root = tmp_path_factory.mktemp("lerf")
    room = rooms / "one"
    copy_views(room, root / "ramen")
    shutil.copytree(room / "labels", root / "maps")
    (root / "label" / "ramen").mkdir(parents=True)
    for stem in ASKED:
        ids = cv2.resize(truth_of(room, stem).astype(np.uint8), None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST)
        objects = []
        for k in shown(room, stem):
            contours, _ = cv2.findContours((ids == k).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
            for contour in contours:  # one object in several pieces
                x, y, w, h = cv2.boundingRect(contour)
                polygon = contour[:, 0].tolist()
                objects.append({"category": str(k), "segmentation": polygon, "bbox": [x, y, x + w - 1, y + h - 1]})
        info = {"name": f"{stem}.jpg", "width": ids.shape[1], "height": ids.shape[0]}
        (root / "label" / "ramen" / f"{stem}.json").write_text(json.dumps({"info": info, "objects": objects}))
    return root


@pytest.fixture(scope="module")
def lifted(rooms):
    """Gaussians, views and label shares of the room, lifted from the views that are not annotated."""
    views, scene = sg.load_views(rooms / "one"), sg.load_gaussians(rooms / "one" / "scene.ply")
    ids = sorted({int(k) for v in views for k in np.unique(truth_of(rooms / "one", v.stem)) if k})
    names = tuple(map(str, ids))
    table = np.full(256, -1)
    table[ids] = np.arange(len(ids))
    maps = {v.stem: FeatureMap("labels", ids=table[truth_of(rooms / "one", v.stem)], labels=names) for v in views}
    semantics = sg.lift(scene, [v for v in views if v.stem not in ASKED], maps)
    return scene, {view.stem: view for view in views}, semantics


def protocol(lerf, lifted):
    """Hits and IoUs of every query, by OpenCV and loops over the JSON files."""
    scene, views, semantics = lifted
    hits, ious = [], []
    for stem in ASKED:
        content = json.loads((lerf / "label" / "ramen" / f"{stem}.json").read_text())
        size = content["info"]["height"], content["info"]["width"]
        mean, known = splat_scores(scene, views[stem].camera.resized(*size), semantics.features, semantics.seen)
        for name in dict.fromkeys(entry["category"] for entry in content["objects"]):
            entries = [entry for entry in content["objects"] if entry["category"] == name]
            score = torch.where(known, mean[..., semantics.labels.index(name)], 0.0).numpy()
            smooth = cv2.filter2D(score, -1, np.ones((30, 30)) / 900)
            ys, xs = np.nonzero(smooth >= smooth.max() - 1e-6)
            boxes = [entry["bbox"] for entry in entries]
            hits.append(
                any(b[0] <= x <= b[2] and b[1] <= y <= b[3] for x, y in zip(xs, ys, strict=True) for b in boxes)
            )
            blend = (score + smooth) / 2
            blend = np.clip(2 * (blend - blend.min()) / (np.ptp(blend) + 1e-9) - 1, 0, 1)
            raw = (blend > 0.4).astype(np.uint8)
            mask = raw.copy()
            for i in range(size[0]):
                for j in range(size[1]):
                    box = raw[max(0, i - 3) : min(i + 4, size[0] - 1), max(0, j - 3) : min(j + 4, size[1] - 1)]
                    mask[i, j] = np.argmax(np.bincount(box.ravel()))
            truth = np.zeros(size, np.uint8)
            for entry in entries:
                cv2.fillPoly(truth, [np.array(entry["segmentation"], np.int32)], 1)
            ious.append((truth & mask).sum() / (truth | mask).sum())
    return hits, ious


def test_lerf_ovs_against_the_published_steps(lerf, lifted, tmp_path):
    hits, ious = protocol(lerf, lifted)
    options = ["--encoder", f"files:{lerf}/maps"]
    found = run("lerf-ovs-seg", lerf, tmp_path / "seg", *options)
    scene = found["scenes"]["ramen"]
    assert scene["values"]["located"] == [float(hit) for hit in hits]
    assert sum(hits) > 0
    assert np.allclose(scene["values"]["iou"], ious, atol=0.02)
    assert found["figures"]["iou"] == pytest.approx(np.mean(scene["values"]["iou"]))
    assert found["figures"]["acc_25"] == pytest.approx(np.mean(np.array(scene["values"]["iou"]) > 0.25))
    assert scene["views"] == {"lifted": 7, "scored": 2}
    assert found["not_in_the_data"] == ["figurines", "teatime", "waldo_kitchen"]
    page = (tmp_path / "seg" / "results.md").read_text()
    assert "LangSplatV2" in page
    assert "second hand" in page
    assert read_rgb(tmp_path / "seg" / scene["sheets"][0]).shape[0] == 2 * 48 + 22


def test_lerf_ovs_released_lifts_what_it_scores(lerf, tmp_path):
    options = ["--encoder", f"files:{lerf}/maps", "--views", "released"]
    found = run("lerf-ovs-loc", lerf, tmp_path / "loc", *options)
    assert found["scenes"]["ramen"]["views"] == {"lifted": 9, "scored": 2}
    assert "LERF (per scene, NeRF)" in (tmp_path / "loc" / "results.md").read_text()


def test_lerf_ovs_3d_renders_the_selection_alone(lerf, lifted, tmp_path):
    found = run("lerf-ovs-3d", lerf, tmp_path, "--encoder", f"files:{lerf}/maps", "--threshold", "0.4")
    scene, views, semantics = lifted
    content = json.loads((lerf / "label" / "ramen" / "0002.json").read_text())
    first = content["objects"][0]["category"]
    size = content["info"]["height"], content["info"]["width"]
    truth = np.zeros(size, np.uint8)
    for entry in content["objects"]:
        if entry["category"] == first:
            cv2.fillPoly(truth, [np.array(entry["segmentation"], np.int32)], 1)
    chosen = semantics.features[:, semantics.labels.index(first)] > 0.4
    alone = sg.render(scene.subset(chosen), views["0002"].camera.resized(*size)).clamp(0, 1).numpy()
    gray = 255 * alone @ np.array([0.299, 0.587, 0.114])
    iou = ((gray > 10) & (truth > 0)).sum() / ((gray > 10) | (truth > 0)).sum()
    assert found["scenes"]["ramen"]["values"]["iou"][0] == pytest.approx(iou, abs=2e-3)


# --- masks ------------------------------------------------------------------------------------------------------------


def test_lerf_mask_means_phrases_first(rooms, lifted, tmp_path):
    room = rooms / "one"
    scene, views, semantics = lifted
    copy_views(room, tmp_path / "data" / "ramen")
    shutil.copytree(room / "labels", tmp_path / "maps")
    ious = {}
    for stem in ASKED:
        mean, known = splat_scores(scene, views[stem].camera, semantics.features, semantics.seen)
        for k in shown(room, stem):
            truth = truth_of(room, stem) == k
            path = tmp_path / "data" / "ramen" / "test_mask" / stem / f"{k}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), 255 * truth.astype(np.uint8))
            ours = ((mean[..., semantics.labels.index(str(k))] > 0.5) & known).numpy()
            ious.setdefault(str(k), []).append((ours & truth).sum() / (ours | truth).sum())
    assert {len(each) for each in ious.values()} == {1, 2}
    found = run("lerf-mask", tmp_path / "data", tmp_path / "out", "--encoder", f"files:{tmp_path}/maps")
    rows = found["scenes"]["ramen"]["per_class"]
    assert {name: row["iou"] for name, row in rows.items()} == pytest.approx(
        {k: np.mean(v) for k, v in ious.items()}, abs=0.01
    )
    by_phrase, by_mask = (
        np.mean([np.mean(each) for each in ious.values()]),
        np.mean([v for each in ious.values() for v in each]),
    )
    assert found["figures"]["iou"] == pytest.approx(by_phrase, abs=0.005)
    assert abs(by_phrase - by_mask) > 0.01
    assert 0 < found["figures"]["boundary_iou"] < found["figures"]["iou"]


def strokes(mask):
    """The middle of a mask."""
    return cv2.erode(mask.astype(np.uint8), np.ones((5, 5), np.uint8))


def test_nvos_finds_the_object_that_was_drawn_on(rooms, tmp_path):
    room = rooms / "one"
    data = tmp_path / "data"
    copy_views(room, data / "scenes" / "fern")
    shutil.copytree(room / "labels", tmp_path / "maps")
    floor = CLASSES.index("floor") + 1
    for name, mask in (
        ("pos_0_fern", truth_of(room, "0002") == floor),
        ("neg_0_fern", truth_of(room, "0002") != floor),
    ):
        path = data / "labels/llff/scribbles/fern" / f"{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), 255 * strokes(mask))
    for place, name in (("reference_image", "0002.JPG"), ("masks", "0005_mask.png")):
        path = data / "labels/llff" / place / "fern" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), 255 * (truth_of(room, "0005") == floor).astype(np.uint8))
    found = run("nvos", data, tmp_path / "out", "--encoder", f"files:{tmp_path}/maps")
    share = (truth_of(room, "0005") == floor).mean()
    assert found["figures"]["iou"] > share + 0.2  # of calling everything the object
    assert found["figures"]["accuracy"] > max(share, 1 - share) + 0.1
    assert found["scenes"]["fern"]["views"] == {"lifted": 8, "scored": 1}


def test_spin_nerf_scores_all_views_but_the_first(rooms, tmp_path):
    room = rooms / "one"
    floor = CLASSES.index("floor") + 1
    folder = copy_views(room, tmp_path / "data" / "room")
    shutil.copytree(room / "labels", tmp_path / "maps")
    (folder / "masks").mkdir()
    for path in sorted((room / "images").iterdir()):
        cv2.imwrite(str(folder / "masks" / path.name), (truth_of(room, path.stem) == floor).astype(np.uint8))
    found = run("spin-nerf", tmp_path / "data", tmp_path / "out", "--encoder", f"files:{tmp_path}/maps")
    assert len(found["scenes"]["room"]["values"]["iou"]) == 8
    assert found["figures"]["iou"] > 0.6


# --- ScanNet ----------------------------------------------------------------------------------------------------------

# nyu40 ids of the room's classes; lamp and bed have none of OpenGaussian's 10, ceiling none of the 19.
AS_NYU40 = {
    "floor": 2,
    "ceiling": 22,
    "wall": 1,
    "table": 14,
    "chair": 5,
    "sofa": 6,
    "cabinet": 3,
    "shelf": 10,
    "lamp": 35,
    "bed": 4,
}


def write_scannet(room, root, name):
    folder = root / "scans" / name
    views, scene = sg.load_views(room), sg.load_gaussians(room / "scene.ply")
    nyu = np.array([0, *(AS_NYU40[c] for c in CLASSES)])
    for place in ("color", "pose", "label-filt", "intrinsic"):
        (folder / place).mkdir(parents=True)
    rows = "\n".join(f"{100 + k}\t{k}" for k in range(1, 41))
    (root / "scannetv2-labels.combined.tsv").write_text(f"id\tnyu40id\n{rows}\n")
    K = np.eye(4)
    K[:3, :3] = views[0].camera.K.numpy()
    np.savetxt(folder / "intrinsic" / "intrinsic_color.txt", K)
    for number, view in enumerate(views):
        picture = read_rgb(view.image_path)
        cv2.imwrite(str(folder / "color" / f"{number}.jpg"), picture[:, :, ::-1])
        np.savetxt(folder / "pose" / f"{number}.txt", np.linalg.inv(view.camera.world_to_camera.numpy()))
        raw = np.where(nyu > 0, nyu + 100, 0)[truth_of(room, view.stem)].astype(np.uint16)
        raw = cv2.resize(raw, None, fx=3, fy=3, interpolation=cv2.INTER_NEAREST)  # labels are larger than photographs
        cv2.imwrite(str(folder / "label-filt" / f"{number}.png"), raw)
    shutil.copy(room / "scene.ply", folder / "scene.ply")
    labels = nyu[1:][scene.extras["label"]]
    lines = [f"{x} {y} {z} {label}" for (x, y, z), label in zip(scene.means.tolist(), labels, strict=True)]
    header = (
        f"ply\nformat ascii 1.0\nelement vertex {len(lines)}\nproperty float x\nproperty float y\nproperty float z\n"
    )
    (folder / f"{name}_vh_clean_2.labels.ply").write_text(
        header + "property ushort label\nend_header\n" + "\n".join(lines)
    )
    return views, scene, labels


def test_scannet_frames_end_to_end(rooms, tmp_path):
    write_scannet(rooms / "one", tmp_path / "data", "scene0050_02")
    found = run("scannet12-2d", tmp_path / "data", tmp_path / "out", "--encoder", "truth", "--every", "3")
    scene = found["scenes"]["scene0050_02"]
    assert scene["views"] == {"lifted": 3, "scored": 9}
    assert found["figures"]["miou"] > 0.3
    assert {"table", "shelves"} >= {
        name for name in scene["per_class"] if name in ("table", "desk", "shelves", "bookshelf")
    }
    assert len(found["not_in_the_data"]) == 11
    strict = run(
        "scannet12-2d",
        tmp_path / "data",
        tmp_path / "strict",
        "--encoder",
        "truth",
        "--every",
        "3",
        "--views",
        "strict",
    )
    assert strict["scenes"]["scene0050_02"]["views"] == {"lifted": 3, "scored": 6}
    tex = (tmp_path / "out" / "results.tex").read_text()
    assert r"Semantic Gaussians 2D+3D (both) & 62.0 & 77.0" in tex


class NameVectors:
    """Phrases of nyu40 as unit vectors."""

    space = "names:40"

    def encode_text(self, texts):
        return torch.eye(40)[[NYU40.index(text) for text in texts]]


def test_scannet_points_end_to_end(rooms, tmp_path, monkeypatch):
    _, scene, labels = write_scannet(rooms / "one", tmp_path / "data", "scene0000_00")
    nyu = np.array([0, *(AS_NYU40[c] for c in CLASSES)])

    class Source:
        space, needs_image = "names:40", False

        def encode(self, view, image=None):
            return FeatureMap(
                self.space, ids=nyu[truth_of(rooms / "one", f"{int(view.stem):04d}")] - 1, vectors=torch.eye(40)
            )

    monkeypatch.setattr("sgwarp.evaluation.cases.make_encoder", lambda *rest: Source())
    monkeypatch.setattr("sgwarp.evaluation.cases.text_encoder_for", lambda *rest: NameVectors())
    found = run("scannet-3d", tmp_path / "data", tmp_path / "out", "--encoder", "conse", "--every", "1")
    views = sg.load_views(rooms / "one")
    maps = {
        v.stem: FeatureMap("names:40", ids=nyu[truth_of(rooms / "one", v.stem)] - 1, vectors=torch.eye(40))
        for v in views
    }
    lifted = sg.lift(scene, views, maps)
    assert found["figures"]["coverage"] == pytest.approx(lifted.coverage)
    assert lifted.coverage > 0.5
    features = lifted.features.numpy()
    for count, ids in SETS.items():
        columns = np.array(ids) - 1
        guess = np.where(features[:, columns].max(1) > 0, np.array(ids)[features[:, columns].argmax(1)], 0)
        guess = np.where(
            features.any(1), np.array(ids)[features[:, columns].argmax(1)], 0
        )  # a softmax never gives none
        scored = np.isin(labels, ids)
        ious = [
            ((guess == k) & (labels == k)).sum() / (((guess == k) & scored) | (labels == k)).sum()
            for k in ids
            if (labels == k).any()
        ]
        assert found["figures"][f"miou_{count}"] == pytest.approx(np.mean(ious), abs=0.01)


# --- parts and moving scenes ------------------------------------------------------------------------------------------


def test_parts_without_truth_compares_views(rooms, tmp_path):
    room = rooms / "one"
    folder = copy_views(room, tmp_path / "data" / "1" / "abc")
    (folder / "sparse").mkdir()
    maps = shutil.copytree(room / "labels", tmp_path / "maps")
    options = ["--encoder", f"files:{maps}", "--classes", *map(str, range(1, 11)), "--hold-out", "2"]
    found = run("parts", tmp_path / "data", tmp_path / "out", *options)
    assert 0.5 < found["figures"]["agreement"] <= 1
    assert "miou" not in found["figures"]
    noisy = maps / "0004.png"  # a view in which the encoder takes everything for one thing
    cv2.imwrite(str(noisy), np.full((48, 64), 7, np.uint8))
    alone = run("parts", tmp_path / "data", tmp_path / "2d", *options, "--method", "2d")
    assert alone["figures"]["agreement"] < found["figures"]["agreement"]


def test_parts_with_truth(rooms, tmp_path):
    room = rooms / "one"
    folder = copy_views(room, tmp_path / "data" / "1" / "abc")
    (folder / "sparse").mkdir()
    (folder / "parts").mkdir()
    (folder / "parts.json").write_text(json.dumps([str(k) for k in range(1, 11)]))
    for stem in ASKED:
        shutil.copy(room / "labels" / f"{stem}.png", folder / "parts" / f"{stem}.png")
    shutil.copytree(room / "labels", tmp_path / "maps")
    found = run("parts", tmp_path / "data", tmp_path / "out", "--encoder", f"files:{tmp_path}/maps")
    assert found["figures"]["miou"] > 0.3
    assert found["scenes"]["1/abc"]["views"] == {"lifted": 7, "scored": 2}


def test_parts_that_nobody_named_are_asked_for(rooms, tmp_path, capsys):
    folder = copy_views(rooms / "one", tmp_path / "1" / "abc")
    (folder / "sparse").mkdir()
    shutil.copytree(rooms / "one" / "labels", tmp_path / "maps")
    arguments = ["--data", str(tmp_path), "--out", str(tmp_path / "out"), "--encoder", f"files:{tmp_path}/maps"]
    assert main(["evaluate", "parts", *arguments]) == 2
    assert "--classes" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_moving_scene_end_to_end(tmp_path):
    scene = make_moving_scene(0, 3, 6000, cameras=5, width=64, height=48)
    save_moving_scene(scene, tmp_path / "data" / "tennis", held_out=2)
    figures = {}
    for noise in ("0", "0.4"):
        options = ["--encoder", f"truth?noise={noise}"]
        found = run("panoptic-4d", tmp_path / "data", tmp_path / noise, *options)
        assert found["scenes"]["tennis"]["views"] == {"lifted": 3, "scored": 2}
        figures[noise] = found["figures"]
    assert figures["0"]["miou"] > 0.3
    assert figures["0.4"]["miou"] < figures["0"]["miou"]
    assert figures["0"]["switches"] == 0


# --- all --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("profile", ["lerf-ovs-loc", "scannet12-2d", "parts", "panoptic-4d", "lerf-mask"])
def test_weights_that_nobody_named_are_asked_for(profile, tmp_path, capsys):
    assert main(["evaluate", profile, "--data", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert f"--encoder: profile {profile} is published with" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["dense", "vectors"])
def test_2d_alone_answers_from_the_vectors_of_the_view(kind, rooms, tmp_path, monkeypatch):
    """One unit vector per class: the answer is the truth at the size of the map, and nothing where none is."""
    folder = rooms / "one"

    class Source:
        space, needs_image = "names:10", False

        def encode(self, view, image=None):
            ids = torch.from_numpy(truth_of(folder, view.stem)).long()[::2, ::2] - 1
            ids[:4] = -1
            if kind == "vectors":
                return FeatureMap(self.space, ids=ids, vectors=torch.eye(10))
            return FeatureMap(self.space, dense=torch.eye(10)[ids.clamp(min=0)], valid=ids >= 0)

    class Text:
        space = "names:10"

        def encode_text(self, texts):
            return torch.eye(10)[[CLASSES.index(text) for text in texts]]

    monkeypatch.setattr("sgwarp.evaluation.cases.make_encoder", lambda *rest: Source())
    monkeypatch.setattr("sgwarp.evaluation.cases.text_encoder_for", lambda *rest: Text())
    found = run("room", rooms, tmp_path, "--scenes", "one", "--method", "2d", "--scoring", "cosine")
    figures = found["scenes"]["one"]["figures"]
    pairs = []
    for stem in ("0000", "0008"):
        truth = truth_of(folder, stem).astype(int) - 1
        ours = truth[::2, ::2].copy()
        ours[:4] = -1
        pairs.append((np.repeat(np.repeat(ours, 2, 0), 2, 1), truth))
    right = sum(((p == t) & (t >= 0)).sum() for p, t in pairs)
    assert figures["accuracy"] == pytest.approx(right / sum((t >= 0).sum() for _, t in pairs))
    assert figures["unknown"] == pytest.approx(
        sum(((p < 0) & (t >= 0)).sum() for p, t in pairs) / (2 * 48 * 64), abs=1e-3
    )
