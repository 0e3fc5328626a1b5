"""Photographs that are not quite where a data set says, and those that are not read at all."""

import json
import logging
import re
import shutil
import struct

import cv2
import numpy as np
import pytest

from sgwarp.errors import InputError
from sgwarp.io.views import load_views
from sgwarp.reconstruction.sfm.poses import photographs_in

POSE = np.eye(4).tolist()


def photograph(path, value=0):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((24, 32, 3), value, np.uint8))


def transforms(folder, names, **meta):
    frames = [{"file_path": name, "transform_matrix": POSE} for name in names]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "transforms.json").write_text(json.dumps({"fl_x": 40.0, "w": 32, "h": 24, **meta, "frames": frames}))


def colmap(folder, names):
    (folder / "sparse/0").mkdir(parents=True, exist_ok=True)
    (folder / "sparse/0/cameras.txt").write_text("1 PINHOLE 32 24 40 40 16 12\n")
    rows = [f"{number} 1 0 0 0 0 0 0 1 {name}\n\n" for number, name in enumerate(names, 1)]
    (folder / "sparse/0/images.txt").write_text("".join(rows))


@pytest.mark.parametrize("write", [lambda f, names: transforms(f, [f"images/{n}" for n in names]), colmap])
@pytest.mark.parametrize(
    ("listed", "stored"),
    [("a b.png", "a b.PNG"), ("IMG_1.JPG", "img_1.png"), ("one.jpg", "one.webp"), ("cam0/x.png", "cam0/x.tiff")],
)
def test_another_ending_or_letter_case_is_found_and_said(tmp_path, caplog, write, listed, stored):
    photograph(tmp_path / "images" / stored, 70)
    photograph(tmp_path / "images" / "other.png")
    write(tmp_path, [listed, "other.png"])
    first, _ = sorted(load_views(tmp_path), key=lambda view: view.name.endswith("other.png"))
    assert round(float(first.image().mean()) * 255) in (69, 70, 71)
    assert first.stem == listed.rsplit("/")[-1].rsplit(".")[0]
    assert "1 photographs have another ending or letter case than is listed, first" in caplog.text


@pytest.mark.parametrize("write", [lambda f, names: transforms(f, names), colmap])
@pytest.mark.parametrize(
    ("listed", "stored"),
    [
        ("/home/you/room/images/a.png", "a.png"),
        ("C:\\Users\\you\\images\\cam0\\a.png", "cam0/a.png"),
        ("D:/room/images/a.png", "a.png"),
        ("../room/images/a.png", "a.png"),
        ("images/a.png", "a.png"),
        ("a.png", "a.png"),
        ("file:///home/you/images/a%20b.png", "a b.png"),
        ("my%20%C3%BC.png", "my ü.png"),
        ("cafe\u0301.png", "caf\u00e9.png"),
    ],
)
def test_names_from_another_machine_or_tool_are_found(tmp_path, write, listed, stored):
    """Of each the photograph is the one file that its listed path ends like, and not the other one."""
    photograph(tmp_path / "images" / stored, 70)
    photograph(tmp_path / "images" / "other.png")
    write(tmp_path, [listed, "images/other.png"])
    first, _ = sorted(load_views(tmp_path), key=lambda view: view.name.endswith("other.png"))
    assert round(float(first.image().mean()) * 255) == 70


def test_the_end_of_a_path_that_two_share_is_nobodys(tmp_path, caplog):
    photograph(tmp_path / "a.png")
    photograph(tmp_path / "b.png")
    transforms(tmp_path, ["/x/cam0/a.png", "/x/cam1/a.png", "/x/b.png"])
    with pytest.raises(InputError, match="lies outside the data set"):
        load_views(tmp_path)
    transforms(tmp_path, ["cam0/a.png", "cam1/a.png", "/x/b.png"])
    assert [view.stem for view in load_views(tmp_path)] == ["b"]
    assert "1 photographs are listed with paths that do not exist here; files whose paths end alike" in caplog.text


@pytest.mark.parametrize("write", [transforms, colmap])
def test_a_photograph_that_is_listed_twice_counts_once(tmp_path, caplog, write):
    photograph(tmp_path / "images/a.png")
    photograph(tmp_path / "images/b.png")
    write(tmp_path, ["images/a.png", "images/b.png", "./images/a.png", "images/a.png"])
    assert sorted(view.stem for view in load_views(tmp_path)) == ["a", "b"]
    assert "left out 2 " in caplog.text
    assert "that are listed before" in caplog.text


def test_photographs_that_differ_in_their_ending_are_two(tmp_path):
    for name in ("images/a.png", "images/a.jpg", "images/b.png"):
        photograph(tmp_path / name)
    transforms(tmp_path, ["images/a.png", "images/a.jpg", "images/b.png"])
    assert [view.stem for view in load_views(tmp_path)] == ["a.png", "a.jpg", "b"]


def test_no_photograph_is_taken_twice(tmp_path, caplog):
    """b.jpg is gone; b.png is listed itself, so that it does not stand in."""
    photograph(tmp_path / "images/a.png")
    photograph(tmp_path / "images/b.png")
    transforms(tmp_path, ["images/b.png", "images/b.jpg", "images/a.png"])
    assert [view.stem for view in load_views(tmp_path)] == ["b", "a"]
    assert "left out 1 frames without photograph" in caplog.text


def test_two_files_that_may_be_meant_are_neither(tmp_path):
    photograph(tmp_path / "images/a.png")
    photograph(tmp_path / "images/a.bmp")
    photograph(tmp_path / "images/b.png")
    transforms(tmp_path, ["images/a.jpg", "images/b.png"])
    assert [view.stem for view in load_views(tmp_path)] == ["b"]


@pytest.mark.parametrize("name", ["images\0/a.png", "images/\ud800/a.png", "x" * 5000 + "/a.png", "images/a.png/b.png"])
def test_names_that_no_file_can_have_are_left_out(tmp_path, name):
    photograph(tmp_path / "images/a.png")
    transforms(tmp_path, [name, "images/a.png"])
    assert [view.name for view in load_views(tmp_path)] == ["images/a.png"]


def test_whole_paths_into_the_data_set_are_taken(tmp_path):
    photograph(tmp_path / "images/a.png")
    transforms(tmp_path, [str(tmp_path / "images/a.png")])
    assert len(load_views(tmp_path)) == 1
    transforms(tmp_path / "inner", [f"{tmp_path}/inner/../images/a.png"])
    with pytest.raises(InputError, match="lies outside the data set"):
        load_views(tmp_path / "inner")


@pytest.mark.parametrize(
    ("file", "content", "expected"),
    [
        ("poses_bounds.npy", b"", "LLFF"),
        ("keyframes/cameras/1.json", b"{}", "Polycam.*ns-process-data polycam"),
        ("rgbd/0.depth", b"", "Record3D.*ns-process-data record3d, of the .r3d file"),
        ("pose/0.txt", b"1 0 0 0", "ScanNet"),
        ("cams.xml", b"<?xml ?><document><chunk><cameras>", "Metashape"),
        ("cameras.json", b'[{"id": 0, "img_name": "a"}]', "3DGS trainer.*give the data set that it was trained on"),
        ("cams.csv", b"#name,x,y,alt", "RealityCapture"),
        ("notes.csv", b"name,weight", "holds no views.*sgwarp poses"),
        ("scene.log", b"0 0 0\n1 0 0 0\n", "Tanks and Temples"),
        ("run.log", b"began 1 2 3\n", "holds no views"),
        ("IMG_1.HEIC", b"", r"not decoded \(1 HEIC files\); convert them to JPEG"),
    ],
)
def test_captures_that_are_not_read_are_named(tmp_path, file, content, expected):
    photograph(tmp_path / "photos/a.png")
    (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / file).write_bytes(content)
    with pytest.raises(InputError, match=expected):
        load_views(tmp_path)


PANORAMAS = [
    ("reconstruction.json", b'[{"cameras": {"v2": {"projection_type": "spherical", "width": 64}}}]', "OpenSfM"),
    ("reconstruction.json", b'[{"cameras": {"c": {"projection_type":"equirectangular"}}}]', "OpenSfM"),
    (
        "sfm_data.json",
        b'{"views": []' + b" " * 5000 + b',"intrinsics": [{"polymorphic_name": "spherical"}]}',
        "OpenMVG",
    ),
    ("cameras.sfm", b'{"intrinsics": [{"intrinsicId": "1", "type": "equirectangular"}]}', "Meshroom"),
    ("cams.xml", b'<document><chunk><sensors><sensor id="0" label="x" type="spherical">', "Metashape"),
]


@pytest.mark.parametrize(("file", "content", "tool"), PANORAMAS)
def test_panoramas_of_other_tools_are_named(tmp_path, file, content, tool):
    """Their export to COLMAP, the remedy for other photographs, has no such lens."""
    photograph(tmp_path / "photos/a.png")
    (tmp_path / file).write_bytes(content)
    for given, verb in ((tmp_path, "holds"), (tmp_path / file, "is")):
        with pytest.raises(
            InputError, match=rf"{verb} .*{tool}.* of panoramas, .*; cut the panoramas into perspective"
        ):
            load_views(given)
    flat = re.sub(rb"spherical|equirectangular", b"perspective", content)
    (tmp_path / file).write_bytes(flat)
    with pytest.raises(InputError, match=rf"{tool}.*which is not read; convert it"):
        load_views(tmp_path)


def test_lists_that_are_given_by_name_are_named(tmp_path):
    (tmp_path / "cams.csv").write_bytes(b"#name,x,y,alt")
    with pytest.raises(InputError, match=r"cams\.csv: is RealityCapture's list .*, which is not read; convert it"):
        load_views(tmp_path / "cams.csv")


XMP = b'http://ns.adobe.com/xap/1.0/\0<x:xmpmeta><rdf:Description GPano:ProjectionType="equirectangular"/></x:xmpmeta>'


def panorama(path, size=(128, 64)):
    """A JPEG with the XMP that panorama cameras write (Google's Photo Sphere metadata)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((size[1], size[0], 3), 90, np.uint8))
    plain = path.read_bytes()
    path.write_bytes(plain[:2] + b"\xff\xe1" + struct.pack(">H", len(XMP) + 2) + XMP + plain[2:])


@pytest.mark.parametrize("sized", [False, True])
def test_panoramas_behind_a_pinhole_are_left_out(tmp_path, sized):
    panorama(tmp_path / "images/a.jpg")
    panorama(tmp_path / "images/b.jpg", (128, 96))  # a part of one, cut out as a view
    size = {"w": 128, "h": 64} if sized else {"w": None, "h": None}
    transforms(tmp_path, ["images/a.jpg"], **size)
    with pytest.raises(InputError, match=r"a\.jpg: is a panorama \(equirectangular\); cut the panoramas into"):
        load_views(tmp_path)
    transforms(tmp_path, ["images/b.jpg"], **(size | {"h": 96} if sized else size))
    assert [view.stem for view in load_views(tmp_path)] == ["b"]


@pytest.mark.parametrize("name", ["equirectangular", "SPHERICAL", "OMNIDIRECTIONALSTEREO_L", "VR180_R"])
def test_every_name_of_a_panorama_has_its_remedy(tmp_path, name):
    photograph(tmp_path / "a.png")
    transforms(tmp_path, ["a.png"], camera_model=name)
    with pytest.raises(InputError, match=f"'{name}' is not supported; cut the panoramas into perspective images"):
        load_views(tmp_path)


def test_masks_and_depth_beside_photographs_are_none(tmp_path):
    names = ("IMG_1.JPG", "IMG_1_mask.png", "IMG_2.jpg", "dynamic_mask_IMG_2.png", "IMG_2.jpg.png", "depth_IMG_2.tif")
    for name in (*names, "the_mask.png", "IMG_3.mask.png"):
        photograph(tmp_path / name)
    assert photographs_in(tmp_path) == ["IMG_1.JPG", "IMG_2.jpg", "IMG_3.mask.png", "the_mask.png"]


def test_only_photographs_are_taken_for_photographs(tmp_path):
    """Masks, depth and smaller copies beside them are not; where there is nothing else, they are what was meant."""
    for name in ("images/a.png", "images/sub/b.JPG", "images_4/a.png", "masks/a.png", "depth/a.png", "._a.png"):
        photograph(tmp_path / "all" / name)
    photograph(tmp_path / "all/Labels/0.webp")
    photograph(tmp_path / "room_2/c.tif")
    assert photographs_in(tmp_path / "all") == ["images/a.png", "images/sub/b.JPG"]
    assert photographs_in(tmp_path / "all/masks") == ["a.png"]
    assert photographs_in(tmp_path / "room_2") == ["c.tif"]
    shutil.rmtree(tmp_path / "all/images")
    assert photographs_in(tmp_path / "all") == ["images_4/a.png"]


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({"latlong": True}, "'latlong' is not supported; cut the panoramas into perspective images"),
        ({"ftheta_p0": 0.1}, "'ftheta_p0' is not supported; undistort"),
        ({"from_mitsuba": True}, "'from_mitsuba' is not supported; its axes"),
        ({"camera_model": "EQUIRECTANGULAR"}, "not supported; cut the panoramas into perspective images"),
    ],
)
def test_lenses_that_no_pinhole_stands_for_are_refused(tmp_path, fields, expected):
    photograph(tmp_path / "a.png")
    transforms(tmp_path, ["a.png"], **fields)
    with pytest.raises(InputError, match=expected):
        load_views(tmp_path)


def test_what_says_nothing_is_not_refused_and_what_is_not_used_is_said(tmp_path, caplog):
    photograph(tmp_path / "a.png")
    transforms(
        tmp_path, ["a.png"], latlong=False, from_mitsuba=False, rolling_shutter=[0, 0, 0], camera_model="pinhole"
    )
    assert len(load_views(tmp_path)) == 1
    assert not caplog.text
    transforms(tmp_path, ["a.png"], rolling_shutter=[0, 0, 1], camera_model="PERSPECTIVE")
    load_views(tmp_path)
    assert "not used: rolling_shutter" in caplog.text


def test_the_other_splits_are_said(tmp_path, caplog):
    caplog.set_level(logging.INFO, logger="sgwarp")
    photograph(tmp_path / "a.png")
    transforms(tmp_path, ["a.png"])
    (tmp_path / "transforms.json").rename(tmp_path / "transforms_train.json")
    (tmp_path / "transforms_test.json").write_text("{}")
    load_views(tmp_path)
    assert "is read alone; give transforms_test.json by name" in caplog.text


def test_observations_are_not_counted_as_images(tmp_path, caplog):
    """The line of observations below an image has as many fields as one with a name."""
    names = [f"{number}.png" for number in range(4)]
    for name in names:
        photograph(tmp_path / "images" / name)
    colmap(tmp_path, names)
    shutil.copytree(tmp_path / "sparse/0", tmp_path / "sparse/1")
    observed = "".join(f"{n} 1 0 0 0 0 0 0 1 {name}\n{'1.0 2.0 -1 ' * 4}\n" for n, name in enumerate(names[:3], 1))
    (tmp_path / "sparse/0/images.txt").write_text("# list\n" + observed)
    assert len(load_views(tmp_path)) == 4
    assert "holds 2 models (0 with 3, 1 with 4 images)" in caplog.text


@pytest.mark.parametrize(("middle", "size"), [((12, 16), (32, 24)), ((16, 12), (24, 32))])
def test_a_sideways_photograph_without_a_size_is_turned_where_its_middle_asks(tmp_path, middle, size):
    """Stored 32 wide and 24 high, with EXIF orientation 6; the camera says no size."""
    data = cv2.imencode(".jpg", np.full((24, 32, 3), 90, np.uint8))[1].tobytes()
    tiff = b"II*\0" + struct.pack("<IHHHIII", 8, 1, 0x0112, 3, 1, 6, 0)
    segment = b"Exif\0\0" + tiff
    exif = b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment
    (tmp_path / "a.jpg").write_bytes(data[:2] + exif + data[2:])
    frames = [{"file_path": "a.jpg", "transform_matrix": POSE}]
    meta = {"fl_x": 40.0, "cx": middle[0], "cy": middle[1], "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(meta))
    (view,) = load_views(tmp_path)
    assert view.camera.size == tuple(view.image().shape[:2]) == size


def test_a_photograph_that_lacks_a_row_fits_its_camera(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((1080, 1920, 3), np.uint8))
    transforms(tmp_path, ["a.png"], w=1920, h=1081, fl_x=2000.0)
    (view,) = load_views(tmp_path)
    assert view.camera.size == (1080, 1920)
