"""What a reader says a copy of a data set lacks: every part of the published layout, one taken away at a time."""

import shutil

import numpy as np
import pytest

from sgwarp.datasets import (
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
from sgwarp.datasets.base import read_class_names
from sgwarp.errors import InputError

ANNOTATION = {
    "info": {"name": "b.jpg", "width": 24, "height": 18},
    "objects": [{"category": "egg", "segmentation": [[1, 1], [5, 1], [5, 5]], "bbox": [1, 1, 5, 5]}],
}


def write_all(writer) -> None:
    """Each data set whole, in a folder of its own."""
    writer.colmap("lerf/soup", ["a", "b"])
    writer.text("lerf/label/soup/b.json", ANNOTATION)
    writer.colmap("mask/soup", ["a", "b"])
    writer.mask("mask/soup/test_mask/b/egg.png", 1, 4, 1, 4)
    writer.colmap("ovs/bed", ["a", "b"])
    writer.text("ovs/bed/segmentations/classes.txt", "cup\nsheet\n")
    for name in ("cup", "sheet"):
        writer.mask(f"ovs/bed/segmentations/01/{name}.png", 1, 4, 1, 4)
    writer.colmap("nvos/scenes/fern", ["a", "b"])
    writer.mask("nvos/masks/fern/b_mask.png", 1, 4, 1, 4)
    writer.image("nvos/reference_image/fern/a.JPG")
    for kind in ("pos", "neg"):
        writer.mask(f"nvos/scribbles/fern/{kind}_0.png", 1, 4, 1, 4)
    writer.colmap("spin/fern", ["a", "b"])
    writer.mask("spin/fern/masks/a.png", 1, 4, 1, 4)
    writer.colmap("mv/1/x", ["a", "b"])
    writer.colmap("mip/garden", ["a", "b"])
    for number in (2, 4, 8):
        writer.image(f"mip/garden/images_{number}/a.jpg", 24 // number, 18 // number)
    writer.text("panoptic/tennis/train_meta.json", {"fn": [["a"]]})
    writer.text("panoptic/tennis/test_meta.json", {})
    for name in ("params.npz", "ims/a", "seg/a"):
        writer.text(f"panoptic/tennis/{name}", "x")
    base = "scannet/scans/scene0000_00"
    for name in ("color/0.jpg", "depth/0.png", "label-filt/0.png", "instance-filt/0.png"):
        writer.image(f"{base}/{name}")
    for name in ("pose/0.txt", "intrinsic/intrinsic_color.txt"):
        writer.text(f"{base}/{name}", "1 0 0 0\n" * 4)
    writer.text(f"{base}/scene0000_00_vh_clean_2.labels.ply", "ply")
    writer.text("scannet/scannetv2-labels.combined.tsv", "id\tnyu40id\n")
    for name in ("coord", "color", "opacity", "quat", "scale", "lang_feat", "valid_feat_mask", "segment"):
        np.save(writer.path(f"splat/s/{name}.npy"), np.zeros(1))


SCANS, SCENE = "scans/scene0000_00", "scene0000_00"
SPLAT = ("color", "opacity", "quat", "scale", "lang_feat", "valid_feat_mask", "segment")
PARTS = [
    (
        lerf_ovs,
        "lerf",
        "soup",
        {"soup/images": "images", "soup/sparse": "sparse/0", "label/soup/b.json": "label/soup/*.json"},
    ),
    (lerf_ovs, "lerf", "soup", {"soup/images/b.jpg": "images/b.jpg"}),
    (
        lerf_mask,
        "mask",
        "soup",
        {"soup/images": "images", "soup/sparse": "sparse/0", "soup/images/b.jpg": "images/b.*"},
    ),
    (ovs3d, "ovs", "bed", {"bed/images": "images", "bed/sparse": "sparse*"}),
    (ovs3d, "ovs", "bed", {"bed/segmentations/01/cup.png": "segmentations/01/cup.png"}),
    (nvos, "nvos", "fern", {"scenes/fern": "scenes/fern", "masks/fern/b_mask.png": "masks/fern/*_mask.png"}),
    (nvos, "nvos", "fern", {"reference_image/fern/a.JPG": "reference_image/fern/*.JPG"}),
    (nvos, "nvos", "fern", {"scribbles/fern/pos_0.png": "scribbles/fern/pos_*.png"}),
    (nvos, "nvos", "fern", {"scribbles/fern/neg_0.png": "scribbles/fern/neg_*.png"}),
    (spin_nerf, "spin", "fern", {"fern/images": "images*", "fern/sparse": "sparse/0"}),
    (mvimgnet, "mv", "1/x", {"1/x/sparse/0": "sparse/0"}),
    (mipnerf360, "mip", "garden", {f"garden/images_{n}": f"images_{n}" for n in (2, 4, 8)}),
    (mipnerf360, "mip", "garden", {"garden/images": "images", "garden/sparse/0": "sparse/0"}),
    (panoptic, "panoptic", "tennis", {f"tennis/{n}": n for n in ("params.npz", "test_meta.json", "ims", "seg")}),
    (scannet, "scannet", SCENE, {f"{SCANS}/{n}": n for n in ("depth", "label-filt", "instance-filt")}),
    (scannet, "scannet", SCENE, {f"{SCANS}/pose": "pose", f"{SCANS}/intrinsic": "intrinsic/*color*.txt"}),
    (scannet, "scannet", SCENE, {"scannetv2-labels.combined.tsv": "scannetv2-labels.combined.tsv"}),
    (scannet, "scannet", SCENE, {f"{SCANS}/{SCENE}_vh_clean_2.labels.ply": f"{SCENE}_vh_clean_2.labels.ply"}),
    (scenesplat, "splat", "s", {f"s/{n}.npy": f"{n}.npy" for n in SPLAT}),
]


@pytest.mark.parametrize(("reader", "place", "name", "parts"), PARTS)
def test_each_part_that_is_missing_is_named(writer, reader, place, name, parts):
    write_all(writer)
    root = writer.folder / place
    assert name in reader.list_scenes(root)
    assert reader.open_scene(root, name).missing == ()
    for part, said in parts.items():
        path = root / part
        aside = writer.folder / "aside"
        shutil.move(path, aside)
        if path.parent.name == "sparse" and path.name == "0":
            path.parent.mkdir(exist_ok=True)
        assert said in reader.open_scene(root, name).missing, part
        shutil.move(aside, path)
    assert reader.open_scene(root, name).missing == ()


def test_depth_of_scannet_is_in_millimeters(writer):
    write_all(writer)
    writer.gray("scannet/scans/scene0000_00/depth/0.png", np.full((18, 24), 1234, np.uint16))
    scene = scannet.open_scene(writer.folder / "scannet", "scene0000_00")
    np.testing.assert_allclose(scene.load_depth(type("Stem", (), {"stem": "0"})), 1.234, rtol=1e-6)


def test_scenes_of_scannet_come_in_order(writer):
    for number in (3, 1, 2):
        writer.image(f"scans/scene000{number}_00/color/0.jpg")
    assert scannet.list_scenes(writer.folder) == [f"scene000{number}_00" for number in (1, 2, 3)]


@pytest.mark.parametrize("names", [["a", "b", "a"], {"1": "a", "2": "a"}, [], [1], {"x": "a"}, "a"])
def test_names_of_classes_that_cannot_be(writer, names):
    writer.text("classes.json", names)
    with pytest.raises(InputError, match=r"classes\.json"):
        read_class_names(writer.folder / "classes.json")
