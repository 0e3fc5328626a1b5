"""Readers of published data sets, on small files in the published format."""

import json

import cv2
import numpy as np
import pytest
import torch

from sgwarp.cli import main
from sgwarp.datasets import (
    labelled_folder,
    lerf_mask,
    lerf_ovs,
    mipnerf360,
    mvimgnet,
    nvos,
    ovs3d,
    panoptic,
    scannet,
    scenesplat,
    spin_nerf,
)
from sgwarp.datasets.base import read_class_names, resize_nearest, trained_in
from sgwarp.datasets.catalogue import MODULES, describe_data_set, detect_reader, find_reader
from sgwarp.datasets.scannet_classes import COCO20, NYU40, SETS, coco_table, read_label_table, set_names, set_table
from sgwarp.errors import InputError

HEIGHT, WIDTH = 18, 24


def square(points, left, top, right, bottom, category):
    corners = [[left, top], [right, top], [right, bottom], [left, bottom]]
    return [*points, {"category": category, "segmentation": corners, "bbox": [left, top, right, bottom]}]


# --- LERF-OVS ---------------------------------------------------------------------------------------------------------


def write_lerf_ovs(writer, scene="ramen"):
    # Numbers with gaps: an index counted from the number would name another photograph.
    writer.colmap(scene, ["frame_00006", "frame_00024", "frame_00060"])
    objects = square([], 2, 3, 6.9, 8.9, "egg")
    objects = square(objects, 10, 10, 15, 14, "bowl")
    objects = square(objects, 18, 2, 20, 4, "egg")
    info = {"name": "frame_00024.jpg", "width": WIDTH, "height": HEIGHT}
    writer.text(f"label/{scene}/frame_00024.json", {"info": info, "objects": objects})


def test_lerf_ovs_joins_occurrences_and_matches_by_stem(writer):
    write_lerf_ovs(writer)
    assert lerf_ovs.list_scenes(writer.folder) == ["ramen"]
    scene = lerf_ovs.open_scene(writer.folder, "ramen")
    assert (scene.frames, scene.labelled, scene.missing) == (3, ("frame_00024",), ())
    egg, bowl = scene.load_queries()
    assert (egg.text, bowl.text, egg.stem, egg.size) == ("egg", "bowl", "frame_00024", (HEIGHT, WIDTH))
    assert egg.boxes.tolist() == [[2.0, 3.0, pytest.approx(6.9), pytest.approx(8.9)], [18.0, 2.0, 20.0, 4.0]]
    expected = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    expected[3:9, 2:7] = True  # decimals cut off, outlines included
    expected[2:5, 18:21] = True
    assert torch.equal(egg.mask(), expected)
    views = {view.stem: view for view in scene.load_views()}
    assert float(views["frame_00024"].camera.position[0]) == pytest.approx(0.1)  # the second photograph, not the 24th


def test_lerf_ovs_says_what_is_missing_and_refuses_what_is_none(writer):
    write_lerf_ovs(writer)
    (writer.folder / "ramen/images/frame_00024.jpg").unlink()
    assert lerf_ovs.open_scene(writer.folder, "ramen").missing == ("images/frame_00024.jpg",)
    path = writer.folder / "label/ramen/frame_00024.json"
    for content, message in (
        ({"objects": []}, "no annotation"),
        ({"info": {"height": 0, "width": 3}, "objects": []}, "cannot be"),
        (
            {"info": {"height": 9, "width": 9}, "objects": [{"category": "a", "segmentation": [1, 2], "bbox": [1]}]},
            "points",
        ),
        ({"info": {"height": 9, "width": 9}, "objects": [{"category": "a"}]}, "no annotation"),
    ):
        writer.text("label/ramen/frame_00024.json", content)
        with pytest.raises(InputError, match=message):
            lerf_ovs.read_annotation(path)
    with pytest.raises(InputError, match="no scene 'soup'"):
        lerf_ovs.open_scene(writer.folder, "soup")


# --- masks ------------------------------------------------------------------------------------------------------------


def test_lerf_mask(writer):
    writer.colmap("figurines", ["frame_1", "frame_2"])
    expected = writer.mask("figurines/test_mask/frame_2/green apple.png", 2, 9, 4, 11)
    writer.gray("figurines/test_mask/frame_2/faint.png", np.full((HEIGHT, WIDTH), 128, dtype=np.uint8))
    assert lerf_mask.list_scenes(writer.folder) == ["figurines"]
    scene = lerf_mask.open_scene(writer.folder, "figurines")
    faint, apple = scene.load_queries()
    assert (apple.text, apple.stem, apple.size, len(apple.boxes)) == ("green apple", "frame_2", (HEIGHT, WIDTH), 0)
    assert np.array_equal(apple.mask().numpy(), expected)
    assert not faint.mask().any()  # brighter than 128, not as bright
    assert scene.labelled == ("frame_2",)


def test_ovs3d_numbers_are_places_of_images_by_name(writer):
    writer.colmap("bed", ["a", "b", "c"])
    writer.text("bed/segmentations/classes.txt", "sheet\nbanana\n")
    writer.mask("bed/segmentations/02/sheet.png", 0, 18, 0, 24)
    writer.mask("bed/segmentations/02/banana.png", 5, 8, 5, 9)
    scene = ovs3d.open_scene(writer.folder, "bed")
    assert scene.classes == ("banana", "sheet")  # sorted, as in the published code
    assert scene.labelled == ("c",)
    labels = scene.load_labels("c")
    assert sorted(labels.unique().tolist()) == [1]  # later classes lie above: the sheet was drawn over the banana
    assert [query.text for query in scene.load_queries()] == ["banana", "sheet"]
    writer.mask("bed/segmentations/07/sheet.png", 0, 1, 0, 1)
    with pytest.raises(InputError, match="below the 3 images"):
        ovs3d.open_scene(writer.folder, "bed")


def test_nvos(writer):
    writer.colmap("scenes/horns_undistort", ["IMG_1", "IMG_2"])
    place = "labels/llff"
    expected = writer.mask(f"{place}/masks/horns_left/IMG_2_mask.png", 1, 9, 1, 9)
    writer.image(f"{place}/masks/horns_left/IMG_2.JPG")
    writer.image(f"{place}/reference_image/horns_left/IMG_1.JPG")
    one = writer.mask(f"{place}/scribbles/horns_left/pos_0_horns_left.png", 2, 4, 2, 4)
    two = writer.mask(f"{place}/scribbles/horns_left/pos_1_horns_left.png", 6, 7, 2, 9)
    no = writer.mask(f"{place}/scribbles/horns_left/neg_0_horns_left.png", 12, 14, 2, 9)
    assert nvos.list_scenes(writer.folder) == ["horns_left"]
    scene = nvos.open_scene(writer.folder, "horns_left")
    (query,) = scene.load_queries()
    assert (query.stem, scene.labelled, scene.missing) == ("IMG_2", ("IMG_2",), ())
    assert np.array_equal(query.mask().numpy(), expected)
    strokes = scene.load_scribbles()
    assert strokes.stem == "IMG_1"
    assert np.array_equal(strokes.positive.numpy(), one | two)
    assert np.array_equal(strokes.negative.numpy(), no)
    assert [view.stem for view in scene.load_views()] == ["IMG_1", "IMG_2"]


def test_spin_nerf(writer):
    writer.colmap("fern", ["IMG_1", "IMG_2"])
    writer.gray("fern/images_4/label/IMG_1.png", np.eye(HEIGHT, WIDTH, dtype=np.uint8))  # 0 and 1, not 0 and 255
    scene = spin_nerf.open_scene(writer.folder, "fern")
    (query,) = scene.load_queries()
    assert (query.stem, int(query.mask().sum())) == ("IMG_1", HEIGHT)


# --- plain, unlabelled ------------------------------------------------------------------------------------------------


def test_labelled_folder(writer):
    writer.colmap("kitchen", ["a", "b"])
    labels = np.arange(HEIGHT * WIDTH, dtype=np.uint8).reshape(HEIGHT, WIDTH) % 3
    writer.gray("kitchen/labels/a.png", labels)
    writer.text("kitchen/classes.json", {"0": "void", "1": "cup", "2": "plate"})
    writer.gray("kitchen/depth/a.png", np.full((HEIGHT, WIDTH), 1500, dtype=np.uint16))
    assert labelled_folder.list_scenes(writer.folder) == ["kitchen"]
    assert labelled_folder.list_scenes(writer.folder / "kitchen") == ["kitchen"]
    for root in (writer.folder, writer.folder / "kitchen"):
        scene = labelled_folder.open_scene(root, "kitchen")
        assert (scene.classes, scene.labelled, scene.frames) == (("cup", "plate"), ("a",), 2)
        assert np.array_equal(scene.load_labels("a").numpy(), labels.astype(int) - 1)
        view = scene.load_views()[0]
        assert float(scene.load_depth(view)[0, 0]) == pytest.approx(1.5)
    for names in (["cup", "plate", "cup"], {"1": "cup", "2": "cup"}):
        writer.text("kitchen/classes.json", names)
        with pytest.raises(InputError, match=r"classes\.json: 'cup' is the name of two classes"):
            labelled_folder.open_scene(writer.folder, "kitchen")
    writer.text("kitchen/classes.json", ["cup"])
    with pytest.raises(InputError, match=r"id 2, but classes\.json names 1"):
        labelled_folder.open_scene(writer.folder, "kitchen").load_labels("a")


def test_mvimgnet_and_mipnerf360(writer):
    writer.colmap("data/1/abc", ["001", "002"])
    assert mvimgnet.list_scenes(writer.folder / "data") == ["1/abc"]
    scene = mvimgnet.open_scene(writer.folder / "data", "1/abc")
    assert (scene.frames, scene.classes, scene.missing) == (2, (), ())
    assert len(scene.load_views()) == 2
    writer.colmap("m/garden", ["D1", "D2"])
    for name in ("D1", "D2"):
        writer.image(f"m/garden/images_2/{name}.jpg", WIDTH // 2, HEIGHT // 2)
    scene = mipnerf360.open_scene(writer.folder / "m", "garden")
    assert scene.missing == ("images_4", "images_8")
    assert scene.load_views()[0].camera.size == (HEIGHT // 2, WIDTH // 2)


def test_panoptic(writer):
    writer.text("tennis/train_meta.json", {"w": 8, "h": 6, "fn": [["1/0.jpg"], ["1/1.jpg"]], "k": [], "w2c": []})
    assert panoptic.list_scenes(writer.folder) == ["tennis"]
    scene = panoptic.open_scene(writer.folder, "tennis")
    assert scene.frames == 2
    assert scene.missing == ("params.npz", "test_meta.json", "ims", "seg")


# --- ScanNet ----------------------------------------------------------------------------------------------------------

ROWS = "id\traw_category\tcategory\tnyu40id\n1\twall\twall\t1\n7\tdesk\tdesk\t14\n22\tbookcase\tx\t10\n40\todd\todd\t\n"


def write_scannet(writer, name="scene0050_02"):
    writer.text("scannetv2-labels.combined.tsv", ROWS)
    base = f"scans/{name}"
    K = np.array([[1170.0, 0, 647.5, 0], [0, 1170.0, 483.5, 0], [0, 0, 1, 0], [0, 0, 0, 1]])  # of 1296 x 968
    writer.text(f"{base}/intrinsic/intrinsic_color.txt", "\n".join(" ".join(map(str, row)) for row in K))
    for number in (0, 5, 20, 100):
        writer.image(f"{base}/color/{number}.jpg", 81, 61)
        pose = np.eye(4)
        pose[0, 3] = number
        rows = np.full((4, 4), -np.inf) if number == 20 else pose
        writer.text(f"{base}/pose/{number}.txt", "\n".join(" ".join(map(str, row)) for row in rows))
        labels = np.zeros((10, 12), dtype=np.uint16)
        labels[:, 2:], labels[:, 4:], labels[:, 6:], labels[:, 8:], labels[:, 10:] = 1, 7, 22, 40, 900
        writer.gray(f"{base}/label-filt/{number}.png", labels)
        writer.gray(f"{base}/depth/{number}.png", np.full((10, 12), 2000, dtype=np.uint16))
    return writer.folder


def test_scannet_frames(writer):
    root = write_scannet(writer)
    assert scannet.list_scenes(root) == ["scene0050_02"]
    scene = scannet.open_scene(root, "scene0050_02")
    assert scene.labelled == ("0", "5", "20", "100")  # by number, not by letters
    views = scene.load_views()
    assert [view.stem for view in views] == ["0", "5", "100"]  # 20 was lost
    camera = views[1].camera
    assert camera.size == (61, 81)
    assert float(camera.K[0, 0]) == pytest.approx(1170 * 81 / 1296)
    assert float(camera.K[1, 2]) == pytest.approx(483.5 * 61 / 968)
    assert camera.position.tolist() == pytest.approx([5, 0, 0])
    labels = scene.load_labels("0")
    # nothing, wall, desk as table, bookcase as shelves, no nyu40 id, not in the table
    names = list(COCO20)
    expected = [-1, names.index("wall"), names.index("table"), names.index("shelves"), -1, -1]
    assert labels[0, ::2].tolist() == expected
    assert scene.missing == ("instance-filt", "scene0050_02_vh_clean_2.labels.ply")


def test_scannet_mesh(writer):
    root = write_scannet(writer)
    header = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
    header += "property uchar red\nproperty ushort label\nend_header\n0 1 2 9 14\n3 4 5 9 99\n"
    writer.text("scans/scene0050_02/scene0050_02_vh_clean_2.labels.ply", header)
    points = scannet.open_scene(root, "scene0050_02").load_points()
    assert points.positions.tolist() == [[0, 1, 2], [3, 4, 5]]
    assert points.labels.tolist() == [14, 0]


def test_scannet_objects_of_vertices(writer):
    """Vertices name segments, objects list segments; a segment of no object has none."""
    root = write_scannet(writer)
    base = "scans/scene0050_02/scene0050_02"
    header = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    rows = "0 0 0 5\n1 0 0 5\n2 0 0 1\n3 0 0 7\n"
    writer.text(f"{base}_vh_clean_2.labels.ply", f"{header}property ushort label\nend_header\n{rows}")
    groups = [
        {"id": 0, "objectId": 0, "segments": [40, 12], "label": "chair"},
        {"id": 1, "objectId": 7, "segments": [3], "label": "desk"},
    ]
    writer.text(f"{base}.aggregation.json", json.dumps({"segGroups": groups}))
    assert scannet.open_scene(root, "scene0050_02").load_points().instances is None
    segments = f"{base}_vh_clean_2.0.010000.segs.json"
    writer.text(segments, json.dumps({"segIndices": [12, 40, 99, 3]}))
    assert scannet.open_scene(root, "scene0050_02").load_points().instances.tolist() == [1, 1, 0, 8]
    writer.text(segments, json.dumps({"segIndices": [12, 40, 99]}))
    with pytest.raises(InputError, match="3 vertices, but the mesh has 4"):
        scannet.open_scene(root, "scene0050_02").load_points()
    writer.text(segments, json.dumps({"segIndices": "all"}))
    with pytest.raises(InputError, match="segIndices"):
        scannet.open_scene(root, "scene0050_02").load_points()


def test_intrinsics_of_photographs_at_their_own_size_stay(writer):
    K = np.array([[500.0, 0, 324.0], [0, 500.0, 242.0], [0, 0, 1]])
    assert torch.allclose(scannet.scaled_intrinsics(K, 648, 484), torch.from_numpy(K))


def test_class_sets_of_scannet():
    assert len(NYU40) == 40
    assert len(COCO20) == 20
    assert [len(SETS[count]) for count in (19, 15, 10)] == [19, 15, 10]
    table = coco_table()
    assert [NYU40[k - 1] for k in range(1, 41) if int(table[k]) == list(COCO20).index("curtain")] == [
        "curtain",
        "shower curtain",
    ]
    assert int((table < 0).sum()) == 41 - 23  # id 0 and `other`: 20 classes of 23 ids
    assert set_names(10) == ("wall", "floor", "bed", "chair", "sofa", "table", "door", "window", "bookshelf", "toilet")
    assert set_table(15)[11] == -1
    assert set_table(15)[12] == 10


def test_the_table_of_scannet_is_checked(writer):
    for text, message in (
        ("id\tname\n", "nyu40id"),
        ("id\tnyu40id\nx\t1\n", "line 2"),
        ("id\tnyu40id\n1\t99\n", "range"),
    ):
        writer.text("table.tsv", text)
        with pytest.raises(InputError, match=message):
            read_label_table(writer.folder / "table.tsv")


def test_lost_matrices_are_named(writer):
    root = write_scannet(writer)
    writer.text("scans/scene0050_02/pose/5.txt", "1 2 3")
    with pytest.raises(InputError, match=r"pose.5\.txt.*16 numbers"):
        scannet.open_scene(root, "scene0050_02").load_views()


# --- SceneSplat -------------------------------------------------------------------------------------------------------


def write_scenesplat(folder, compact=True):
    folder.mkdir(parents=True)
    rng = np.random.default_rng(0)
    fields = {
        "coord": rng.normal(size=(5, 3)).astype(np.float32),
        "color": rng.integers(0, 256, (5, 3)).astype(np.uint8),
        "opacity": rng.random(5).astype(np.float32),
        "quat": rng.normal(size=(5, 4)).astype(np.float32),
        "scale": rng.random((5, 3)).astype(np.float32),
        "valid_feat_mask": np.array([1, 0, 1, 1, 0]),
        "segment": np.array([2, -1, 0, 1, -1]),
    }
    features = rng.normal(size=(5, 768)).astype(np.float16)
    fields["lang_feat"] = features[[0, 2, 3]] if compact else features
    for name, array in fields.items():
        np.save(folder / f"{name}.npy", array)
    return fields, features


@pytest.mark.parametrize("compact", [True, False])
def test_scenesplat(tmp_path, compact):
    fields, features = write_scenesplat(tmp_path / "val" / "room0", compact)
    assert scenesplat.list_scenes(tmp_path) == ["val/room0"]
    scene = scenesplat.open_scene(tmp_path, "val/room0")
    gaussians = scenesplat.read_gaussians(scene.gaussians)
    assert np.allclose(gaussians.scales, fields["scale"])
    assert np.allclose(gaussians.opacities, fields["opacity"])
    shown = 0.28209479177387814 * gaussians.sh[:, 0].numpy() + 0.5
    assert np.allclose(shown, fields["color"] / 255, atol=1e-6)
    semantics = scenesplat.read_semantics(scene.gaussians, gaussians)
    assert semantics.seen.tolist() == [True, False, True, True, False]
    assert np.array_equal(semantics.features[[0, 2, 3]].numpy(), features[[0, 2, 3]])
    assert not semantics.features[1].any()
    assert semantics.space.startswith("siglip2")
    assert scene.load_points().labels.tolist() == [2, -1, 0, 1, -1]


def test_scenesplat_refuses_rows_that_fit_nothing(tmp_path):
    write_scenesplat(tmp_path / "room0")
    np.save(tmp_path / "room0" / "lang_feat.npy", np.zeros((4, 768), dtype=np.float16))
    gaussians = scenesplat.read_gaussians(tmp_path / "room0")
    with pytest.raises(InputError, match="expected 5 or 3 rows"):
        scenesplat.read_semantics(tmp_path / "room0", gaussians)
    np.save(tmp_path / "room0" / "opacity.npy", np.full(5, 7.0, dtype=np.float32))
    with pytest.raises(InputError, match=r"room0: opacities.*sigmoid"):
        scenesplat.read_gaussians(tmp_path / "room0")
    np.save(tmp_path / "room0" / "scale.npy", np.zeros((4, 3), dtype=np.float32))
    with pytest.raises(InputError, match=r"scale\.npy: expected \[5, 3\]"):
        scenesplat.read_gaussians(tmp_path / "room0")


# --- all --------------------------------------------------------------------------------------------------------------


def test_every_reader_is_in_the_catalogue_under_its_name():
    for name in MODULES:
        reader = find_reader(name)
        assert name == reader.NAME
        assert reader.ABOUT
    with pytest.raises(InputError, match="not known"):
        find_reader("imagenet")


def test_a_folder_is_recognized(writer):
    assert detect_reader(writer.folder) is None
    assert detect_reader(writer.folder / "nowhere") is None
    write_lerf_ovs(writer)
    facts = describe_data_set(writer.folder, detect_reader(writer.folder))
    assert facts["data_set"] == "lerf-ovs"
    assert facts["by_scene"]["ramen"] == {
        "frames": 3,
        "labelled": 1,
        "classes": None,
        "gaussians": None,
        "missing": None,
    }
    scannet_root = write_scannet(type(writer)(writer.folder / "other"))
    assert detect_reader(scannet_root).NAME == "scannet"


def test_trained_scenes_are_found(tmp_path):
    assert trained_in(tmp_path) is None
    for number in (7000, 30000, "x"):
        place = tmp_path / "point_cloud" / f"iteration_{number}"
        place.mkdir(parents=True)
        (place / "point_cloud.ply").touch()
    assert trained_in(tmp_path).parent.name == "iteration_30000"
    (tmp_path / "scene.ply").touch()
    assert trained_in(tmp_path).name == "scene.ply"


def test_class_names(writer):
    writer.text("a.json", {"0": "void", "2": "cup"})
    assert read_class_names(writer.folder / "a.json") == ("class 1", "cup")
    for content in ({"1000000": "cup"}, [], ["a", 3], {"cup": 1}):
        writer.text("a.json", content)
        with pytest.raises(InputError, match="list of class names"):
            read_class_names(writer.folder / "a.json")


def test_resizing_mixes_no_labels():
    """Each pixel takes what lies under its center: of two, the second; nothing is averaged."""
    labels = torch.tensor([[0, 0, 7, 7], [0, 0, 7, 7], [3, 3, 9, 9], [3, 3, 9, 9]])
    assert resize_nearest(labels, (2, 2)).tolist() == [[0, 7], [3, 9]]
    assert resize_nearest(torch.arange(4)[None], (1, 2)).tolist() == [[1, 3]]
    assert resize_nearest(torch.arange(4)[None], (2, 8))[1].tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    large = torch.randint(0, 5, (97, 131), generator=torch.Generator().manual_seed(0))
    exact = cv2.resize(large.numpy().astype(np.uint8), (64, 48), interpolation=cv2.INTER_NEAREST_EXACT)
    assert np.array_equal(resize_nearest(large, (48, 64)).numpy(), exact)


def test_info_lists_scenes_and_what_is_missing(writer, capsys):
    write_lerf_ovs(writer)
    (writer.folder / "ramen/images/frame_00024.jpg").unlink()
    assert main(["info", str(writer.folder)]) == 0
    said = capsys.readouterr().out
    assert "data set: lerf-ovs" in said
    assert "frames: 2" in said
    assert "missing: images/frame_00024.jpg" in said
    assert main(["info", str(writer.folder), "--data-set", "lerf-ovs", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["by_scene"]["ramen"]["labelled"] == 1
    assert main(["info", str(writer.folder), "--data-set", "scannet"]) == 2
    assert "holds no scene of 'scannet'" in capsys.readouterr().err
