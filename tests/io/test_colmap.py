import logging
import math
import struct

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sgwarp.errors import InputError
from sgwarp.io.colmap import read_colmap, read_points

MODELS = {  # number in the binary format, from the list in COLMAP's documentation
    "SIMPLE_PINHOLE": 0,
    "PINHOLE": 1,
    "SIMPLE_RADIAL": 2,
    "RADIAL": 3,
    "OPENCV": 4,
    "OPENCV_FISHEYE": 5,
    "FULL_OPENCV": 6,
    "FOV": 7,
    "SIMPLE_RADIAL_FISHEYE": 8,
    "RADIAL_FISHEYE": 9,
    "THIN_PRISM_FISHEYE": 10,
    "RAD_TAN_THIN_PRISM_FISHEYE": 11,
    "SIMPLE_DIVISION": 12,
    "DIVISION": 13,
    "SIMPLE_FISHEYE": 14,
    "FISHEYE": 15,
    "EUCM": 16,
    "EQUIRECTANGULAR": 17,
}
PINHOLE = (1, "PINHOLE", 32, 24, [50.0, 55.0, 14.5, 12.25])
AXIS_ANGLE = np.array([0.3, -0.5, 0.2])


def quaternion(axis_angle=AXIS_ANGLE):
    angle = np.linalg.norm(axis_angle)
    return [math.cos(angle / 2), *(axis_angle / angle * math.sin(angle / 2))]


def image(name="a.png", camera=1, quat=None, translation=(0.5, -1.0, 2.0), observations=2):
    return (name, camera, quaternion() if quat is None else quat, list(translation), observations)


def cameras_bin(cameras):
    data = struct.pack("<Q", len(cameras))
    for number, model, width, height, values in cameras:
        data += struct.pack(f"<iiQQ{len(values)}d", number, MODELS.get(model, model), width, height, *values)
    return data


def images_bin(images):
    data = struct.pack("<Q", len(images))
    for i, (name, camera, quat, translation, observations) in enumerate(images):
        data += struct.pack("<i7di", 10 + i, *quat, *translation, camera) + name.encode() + b"\0"
        data += struct.pack("<Q", observations) + struct.pack("<ddq", 1.5, 2.5, -1) * observations
    return data


def points_bin(points):
    data = struct.pack("<Q", len(points))
    for i, (xyz, rgb, track) in enumerate(points):
        data += struct.pack("<Q3d3BdQ", 100 + i, *xyz, *rgb, 0.7, track) + struct.pack("<ii", 1, 2) * track
    return data


def words(*values):
    return " ".join(str(v) for v in values) + "\n"


def cameras_txt(cameras):
    return "# Camera list\n" + "".join(words(n, m, w, h, *v) for n, m, w, h, v in cameras)


def images_txt(images):
    text = "# Image list with two lines of data per image:\n#   IMAGE_ID, ...\n"
    for i, (name, camera, quat, translation, observations) in enumerate(images):
        text += words(10 + i, *quat, *translation, camera, name)
        text += words(*[1.5, 2.5, -1] * observations)
    return text


def points_txt(points):
    return "# 3D point list\n" + "".join(
        words(100 + i, *xyz, *rgb, 0.7, *[1, 2] * track) for i, (xyz, rgb, track) in enumerate(points)
    )


@pytest.fixture
def dataset(tmp_path):
    def write(cameras, images, form="bin", folder="sparse/0", size=(24, 32), image_folder="images", absent=()):
        model = tmp_path / folder
        model.mkdir(parents=True, exist_ok=True)
        if form == "bin":
            (model / "cameras.bin").write_bytes(cameras_bin(cameras))
            (model / "images.bin").write_bytes(images_bin(images))
        else:
            (model / "cameras.txt").write_text(cameras_txt(cameras))
            (model / "images.txt").write_text(images_txt(images))
        for name, *_ in images:
            path = tmp_path / image_folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            if name not in absent:
                cv2.imwrite(str(path), np.full((*size, 3), 100, np.uint8))
        return tmp_path

    return write


@pytest.mark.parametrize("form", ["bin", "txt"])
@pytest.mark.parametrize("folder", ["sparse/0", "sparse", "colmap/sparse/0", "."])
def test_view(dataset, tmp_path, form, folder):
    (view,) = read_colmap(dataset([PINHOLE], [image()], form, folder))
    assert view.stem == "a"
    assert view.image_path.samefile(tmp_path / "images" / "a.png")
    assert view.undistort is None
    assert view.camera.K.tolist() == [[50, 0, 14.5], [0, 55, 12.25], [0, 0, 1]]
    assert view.camera.size == (24, 32)
    expected = np.eye(4)
    expected[:3, :3] = cv2.Rodrigues(AXIS_ANGLE)[0]
    expected[:3, 3] = [0.5, -1.0, 2.0]
    assert np.allclose(view.camera.world_to_camera.numpy(), expected, atol=1e-12)
    assert view.image().shape == (24, 32, 3)


def test_path_may_be_the_model_itself(dataset, tmp_path):
    dataset([PINHOLE], [image()])
    (view,) = read_colmap(tmp_path / "sparse" / "0")
    assert view.image_path.samefile(tmp_path / "images" / "a.png")


def test_binary_is_preferred(dataset, tmp_path):
    dataset([PINHOLE], [image("a.png")], "txt")
    dataset([PINHOLE], [image("b.png")], "bin")
    assert [view.stem for view in read_colmap(tmp_path)] == ["b"]


@pytest.mark.parametrize("form", ["bin", "txt"])
def test_sorted_by_name_and_no_observations(dataset, form):
    """Also a name with spaces, an image seen by no point (an empty line in the text), and two cameras."""
    other = (7, "SIMPLE_PINHOLE", 32, 24, [40.0, 16.0, 12.0])
    images = [image("c d.png", 7, observations=0), image("a.png", 1, observations=0), image("b.png", 7)]
    views = read_colmap(dataset([PINHOLE, other], images, form))
    assert [view.stem for view in views] == ["a", "b", "c d"]
    assert [view.camera.K[0, 0].item() for view in views] == [50, 40, 40]


def test_unnormalised_quaternion(dataset):
    (view,) = read_colmap(dataset([PINHOLE], [image(quat=[3 * q for q in quaternion()])]))
    assert np.allclose(view.camera.world_to_camera[:3, :3].numpy(), cv2.Rodrigues(AXIS_ANGLE)[0], atol=1e-12)


@pytest.mark.parametrize(
    ("model", "values", "radial"),
    [
        ("SIMPLE_RADIAL", [50.0, 16.0, 12.0, -0.1], lambda r: 1 - 0.1 * r**2),
        ("RADIAL", [50.0, 16.0, 12.0, -0.1, 0.02], lambda r: 1 - 0.1 * r**2 + 0.02 * r**4),
        ("OPENCV", [50.0, 50.0, 16.0, 12.0, -0.1, 0.02, 0.0, 0.0], lambda r: 1 - 0.1 * r**2 + 0.02 * r**4),
        (
            "FULL_OPENCV",
            [50.0, 50.0, 16.0, 12.0, -0.1, 0.02, 0.0, 0.0, 0.01, 0.2, -0.03, 0.004],
            lambda r: (1 - 0.1 * r**2 + 0.02 * r**4 + 0.01 * r**6) / (1 + 0.2 * r**2 - 0.03 * r**4 + 0.004 * r**6),
        ),
        (
            "OPENCV_FISHEYE",
            [50.0, 50.0, 16.0, 12.0, -0.1, 0.02, 0.003, 0.0],
            lambda r: (t := math.atan(r)) * (1 - 0.1 * t**2 + 0.02 * t**4 + 0.003 * t**6) / r,
        ),
        ("SIMPLE_RADIAL_FISHEYE", [50.0, 16.0, 12.0, -0.1], lambda r: (t := math.atan(r)) * (1 - 0.1 * t**2) / r),
        (
            "RADIAL_FISHEYE",
            [50.0, 16.0, 12.0, -0.1, 0.02],
            lambda r: (t := math.atan(r)) * (1 - 0.1 * t**2 + 0.02 * t**4) / r,
        ),
    ],
)
def test_distorted_models(dataset, tmp_path, model, values, radial):
    """The pinhole image shows a ray where the definition of the model says it fell."""
    dataset([(1, model, 32, 24, values)], [image()])
    u, v = np.meshgrid(np.arange(32), np.arange(24))
    cv2.imwrite(str(tmp_path / "images" / "a.png"), np.stack([0 * u, v * 8, u * 8], axis=2).astype(np.uint8))
    (view,) = read_colmap(tmp_path)
    column, row = 2, 19
    x = (column + 0.5 - 16) / view.camera.K[0, 0].item()
    y = (row + 0.5 - 12) / view.camera.K[1, 1].item()
    scale = radial(math.hypot(x, y))
    expected = (x * scale * 50 + 16 - 0.5) * 8, (y * scale * 50 + 12 - 0.5) * 8
    assert (view.image()[row, column, :2] * 255).tolist() == pytest.approx(expected, abs=0.8)


@pytest.mark.parametrize("form", ["bin", "txt"])
def test_unsupported_model_is_named(dataset, form):
    message = rf"cameras\.{form}: camera 3: model EQUIRECTANGULAR is not supported; .*panoramas.*supported: .*PIN"
    panorama = (3, "EQUIRECTANGULAR", 32, 24, [32.0, 24.0])
    with pytest.raises(InputError, match=message):
        read_colmap(dataset([panorama], [image(camera=3)], form))


@pytest.mark.parametrize("form", ["bin", "txt"])
def test_camera_that_cannot_be_used_costs_its_photographs(dataset, caplog, form):
    panorama = (3, "EQUIRECTANGULAR", 32, 24, [32.0, 24.0])
    path = dataset([PINHOLE, panorama], [image("a.png"), image("b.png", camera=3)], form)
    with caplog.at_level(logging.WARNING, logger="sgwarp"):
        assert [view.stem for view in read_colmap(path)] == ["a"]
    assert "left out 1 images that cannot be used, first: " in caplog.text
    assert "model EQUIRECTANGULAR is not supported" in caplog.text


def test_unknown_model_number(dataset):
    with pytest.raises(InputError, match=r"cameras\.bin: camera 3: model number 99 is not known"):
        read_colmap(dataset([(3, 99, 32, 24, [1.0])], [image(camera=3)]))


@pytest.mark.parametrize("form", ["bin", "txt"])
def test_singular_intrinsics(dataset, form):
    camera = (4, "SIMPLE_PINHOLE", 32, 24, [0.0, 16.0, 12.0])
    with pytest.raises(InputError, match=rf"cameras\.{form}: camera 4: K: singular or mirrored"):
        read_colmap(dataset([camera], [image(camera=4)], form))


@pytest.mark.parametrize(
    ("factor", "size"), [(2, (1643, 2473)), (4, (822, 1237)), (4, (821, 1236)), (8, (411, 618)), (3.3, (996, 1499))]
)
def test_smaller_photographs_scale_the_camera(dataset, tmp_path, factor, size):
    """Sizes as in Mip-NeRF 360 (4946 x 3286), rounded up or down by the tool that made them."""
    camera = (1, "PINHOLE", 4946, 3286, [4000.0, 4100.0, 2473.0, 1643.0])
    dataset([camera], [image()], size=(4, 4))
    dataset([camera], [image()], size=size, image_folder=f"images_{factor}")
    (view,) = read_colmap(tmp_path, f"images_{factor}")
    assert view.camera.size == size
    u, v = size[1] / 4946, size[0] / 3286
    assert view.camera.K.flatten().tolist() == pytest.approx([4000 * u, 0, 2473 * u, 0, 4100 * v, 1643 * v, 0, 0, 1])
    assert view.image_path.samefile(tmp_path / f"images_{factor}" / "a.png")


@pytest.mark.parametrize("size", [(24, 16), (12, 32), (32, 24), (20, 30), (23, 32)])
def test_photograph_of_another_size(dataset, size):
    with pytest.raises(InputError, match=rf"a\.png: image is {size[1]} x {size[0]}, its camera says 32 x 24"):
        read_colmap(dataset([PINHOLE], [image()], size=size))


def test_larger_photographs_scale_the_camera(dataset):
    (view,) = read_colmap(dataset([PINHOLE], [image()], size=(48, 64)))
    assert view.camera.size == (48, 64)
    assert view.camera.K.tolist() == [[100.0, 0, 29.0], [0, 110.0, 24.5], [0, 0, 1]]


def test_photograph_of_another_shape_is_left_out(dataset, tmp_path, caplog):
    path = dataset([PINHOLE], [image("a.png"), image("b.png")])
    cv2.imwrite(str(tmp_path / "images" / "b.png"), np.zeros((24, 25, 3), np.uint8))
    with caplog.at_level(logging.WARNING, logger="sgwarp"):
        assert [view.stem for view in read_colmap(path)] == ["a"]
    assert "b.png: image is 25 x 24, its camera says 32 x 24" in caplog.text


def test_largest_of_several_models_is_read(dataset, tmp_path, caplog):
    dataset([PINHOLE], [image("a.png")], folder="sparse/0")
    dataset([PINHOLE], [image("b.png"), image("c.png")], folder="sparse/1", form="txt")
    (tmp_path / "sparse" / "1" / "points3D.txt").write_text(points_txt(POINTS))
    with caplog.at_level(logging.WARNING, logger="sgwarp"):
        assert [view.stem for view in read_colmap(tmp_path)] == ["b", "c"]
    assert "holds 2 models (0 with 1, 1 with 2 images); the one with most images is read, 1" in caplog.text
    assert len(read_points(tmp_path)[0]) == len(POINTS)
    assert [view.stem for view in read_colmap(tmp_path / "sparse" / "0")] == ["a"]


def test_text_without_lines_of_observations(dataset, tmp_path):
    """Other tools leave out the empty line below an image, or put more between them, and start with a mark."""
    dataset([PINHOLE], [image("a.png"), image("b 1.png"), image("c.png")], "txt")
    rows = images_txt([image("a.png"), image("b 1.png"), image("c.png", observations=1)]).splitlines()[2:]
    text = "\ufeff# made elsewhere\r\n" + "\r\n".join([rows[0], rows[2], "", "", rows[4], rows[5]])
    (tmp_path / "sparse" / "0" / "images.txt").write_bytes(text.encode())
    (tmp_path / "sparse" / "0" / "cameras.txt").write_text("1 pinhole 32.0 24.0 50 55 14.5 12.25\n")
    assert [view.stem for view in read_colmap(tmp_path)] == ["a", "b 1", "c"]


def test_sideways_photograph_is_turned_where_only_that_fits(dataset, tmp_path, caplog):
    path = dataset([PINHOLE], [image("a.jpg"), image("b.jpg"), image("c.jpg")])
    upright = np.zeros((24, 32, 3), np.uint8)
    upright[:12] = 255  # white above
    for name, raster, orientation in (("a", upright, 1), ("b", np.rot90(upright, 1), 6), ("c", upright, 3)):
        data = cv2.imencode(".jpg", np.ascontiguousarray(raster))[1].tobytes()
        note = b"Exif\0\0II*\0" + struct.pack("<IHHHIII", 8, 1, 0x0112, 3, 1, orientation, 0)
        segment = b"\xff\xe1" + struct.pack(">H", len(note) + 2) + note
        (tmp_path / "images" / f"{name}.jpg").write_bytes(data[:2] + segment + data[2:])
    with caplog.at_level(logging.WARNING, logger="sgwarp"):
        views = read_colmap(path)
    assert "turned 1 photographs upright" in caplog.text
    assert "1 photographs note an EXIF orientation (first c.jpg: 3, upside down)" in caplog.text
    for view in views:  # an orientation that both fit is not applied: cameras belong to the stored raster
        assert view.image()[2].mean() > 0.95
        assert view.image()[-2].mean() < 0.05


def test_missing_photographs_are_counted(dataset, caplog):
    path = dataset([PINHOLE], [image("a.png"), image("b.png"), image("c.png")], absent=["a.png", "b.png"])
    with caplog.at_level(logging.WARNING, logger="sgwarp"):
        assert [view.stem for view in read_colmap(path)] == ["c"]
    assert "left out 2 images without photograph, first 'a.png'" in caplog.text


def test_no_photographs_at_all(dataset, tmp_path):
    dataset([PINHOLE], [image()], absent=["a.png"])
    with pytest.raises(InputError, match=r"none of 1 registered images can be used: 1 photographs are not in .*images"):
        read_colmap(tmp_path)
    with pytest.raises(InputError, match=r"no folder 'images_4' of photographs"):
        read_colmap(tmp_path, "images_4")
    (view,) = read_colmap(tmp_path, photographs=False)
    assert view.image_path is None
    assert view.camera.size == (24, 32)


@pytest.mark.parametrize(
    ("quat", "translation"), [([math.nan] * 4, (0, 0, 0)), ([0.0] * 4, (0, 0, 0)), (None, (math.inf, 0, 0))]
)
def test_poses_that_cannot_be_used_are_counted(dataset, caplog, quat, translation):
    path = dataset([PINHOLE], [image("a.png"), image("b.png", quat=quat, translation=translation)])
    with caplog.at_level(logging.WARNING, logger="sgwarp"):
        assert [view.stem for view in read_colmap(path)] == ["a"]
    assert "left out 1 images whose pose holds NaN" in caplog.text


def test_image_of_an_unknown_camera(dataset):
    with pytest.raises(InputError, match=r"image 'a\.png' refers to camera 5, which is not listed"):
        read_colmap(dataset([PINHOLE], [image(camera=5)]))


def test_stems_are_unique(dataset):
    views = read_colmap(dataset([PINHOLE], [image("left/0.png"), image("right/0.png")]))
    assert [view.stem for view in views] == ["left_0", "right_0"]


@pytest.mark.parametrize("file", ["cameras", "images"])
def test_cut_short_at_every_byte(dataset, tmp_path, file):
    dataset([PINHOLE], [image("a.png"), image("b.png")])
    path = tmp_path / "sparse" / "0" / f"{file}.bin"
    data = path.read_bytes()
    for length in range(len(data)):
        path.write_bytes(data[:length])
        with pytest.raises(InputError, match=rf"{file}\.bin: is cut short: ends after {length} bytes in "):
            read_colmap(tmp_path)


def test_record_that_is_cut_is_named(dataset, tmp_path):
    dataset([PINHOLE], [image("a.png"), image("b.png")])
    path = tmp_path / "sparse" / "0" / "images.bin"
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(InputError, match="in image 1 of 2; copy or export it again"):
        read_colmap(tmp_path)


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("cameras", "1 PINHOLE 32\n", "line 1 is malformed, expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS"),
        ("cameras", "# x\n1 PINHOLE 32 24 50 x 16 12\n", "line 2 is malformed"),
        ("cameras", "1 PINHOLE 32 24 50 16 12\n", "camera 1: model PINHOLE has 4 parameters, found 3"),
        ("images", "1 1 0 0 0 0 0 0 1\n\n", "line 1 is malformed, expected IMAGE_ID QW"),
        ("images", "1 1 0 zero 0 0 0 0 1 a.png\n\n", "line 1 is malformed"),
    ],
)
def test_malformed_text(dataset, tmp_path, file, text, message):
    dataset([PINHOLE], [image()], "txt")
    (tmp_path / "sparse" / "0" / f"{file}.txt").write_text(text)
    with pytest.raises(InputError, match=rf"{file}\.txt: {message}"):
        read_colmap(tmp_path)


def test_no_model(tmp_path):
    with pytest.raises(InputError, match="holds no COLMAP model"):
        read_colmap(tmp_path)
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 32 24 50 50 16 12\n")
    (tmp_path / "images").mkdir()
    with pytest.raises(InputError, match=r"has neither images\.bin nor images\.txt"):
        read_colmap(tmp_path)


POINTS = [((1.5, -2.0, 3.25), (10, 20, 255), 3), ((0.0, 1e-3, -7.0), (0, 0, 0), 0), ((4.0, 5.0, 6.0), (9, 8, 7), 1)]


@pytest.mark.parametrize("form", ["bin", "txt"])
def test_points(tmp_path, form):
    (tmp_path / "sparse").mkdir()
    path = tmp_path / "sparse" / f"points3D.{form}"
    path.write_bytes(points_bin(POINTS) if form == "bin" else points_txt(POINTS).encode())
    xyz, rgb = read_points(path)
    assert xyz.tolist() == [list(p[0]) for p in POINTS]
    assert rgb.tolist() == [list(p[1]) for p in POINTS]
    assert (xyz.dtype, rgb.dtype) == (np.float64, np.float64)
    assert np.array_equal(read_points(tmp_path / "sparse")[0], xyz)
    (tmp_path / "sparse" / "cameras.txt").write_text("1 PINHOLE 32 24 50 50 16 12\n")
    assert np.array_equal(read_points(tmp_path)[0], xyz)


def test_no_points(tmp_path):
    (tmp_path / "points3D.bin").write_bytes(points_bin([]))
    xyz, rgb = read_points(tmp_path)
    assert xyz.shape == rgb.shape == (0, 3)
    (tmp_path / "sparse").mkdir()
    with pytest.raises(InputError, match=r"has neither points3D\.bin nor points3D\.txt"):
        read_points(tmp_path / "sparse")
    (tmp_path / "points3D.txt").write_text("7 1 2 3 300 0 0 0.5\n")
    with pytest.raises(InputError, match=r"points3D\.txt: line 1 is malformed, expected POINT3D_ID X Y Z R G B"):
        read_points(tmp_path / "points3D.txt")
    with pytest.raises(InputError, match=r"gone\.bin: no such file"):
        read_points(tmp_path / "gone.bin")


def test_points_cut_short_at_every_byte(tmp_path):
    data = points_bin(POINTS)
    for length in range(len(data)):
        (tmp_path / "points3D.bin").write_bytes(data[:length])
        with pytest.raises(InputError, match=r"points3D\.bin: is cut short"):
            read_points(tmp_path / "points3D.bin")


@settings(deadline=None, max_examples=150)
@given(cameras=st.binary(max_size=120), images=st.binary(max_size=200), text=st.booleans(), valid=st.booleans())
def test_random_bytes(tmp_path_factory, allow_input_error, cameras, images, text, valid):
    suffix = "txt" if text else "bin"
    folder = tmp_path_factory.getbasetemp() / f"model_{suffix}"
    folder.mkdir(exist_ok=True)
    start = cameras_txt([PINHOLE]).encode() if text else cameras_bin([PINHOLE])
    (folder / f"cameras.{suffix}").write_bytes(start if valid else cameras)
    (folder / f"images.{suffix}").write_bytes(images)
    (folder / f"points3D.{suffix}").write_bytes(images)
    with allow_input_error(folder):
        read_colmap(folder, photographs=False)
    with allow_input_error(folder):
        read_points(folder)


def test_camera_is_rigid_for_any_rotation(dataset):
    gen = torch.Generator().manual_seed(0)
    quats = torch.randn(6, 4, generator=gen, dtype=torch.float64).tolist()
    views = read_colmap(dataset([PINHOLE], [image(f"{i}.png", quat=q) for i, q in enumerate(quats)]))
    for view in views:
        R = view.camera.world_to_camera[:3, :3]
        assert torch.allclose(R @ R.T, torch.eye(3, dtype=torch.float64), atol=1e-12)
