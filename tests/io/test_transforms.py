import json
import logging
import math
import re

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sgwarp.errors import InputError
from sgwarp.io.transforms import read_transforms

SHARED = {"fl_x": 50.0, "fl_y": 55.0, "cx": 14.5, "cy": 12.25, "w": 32, "h": 24}
RIGHT, UP, BACK = np.array([0.0, 1, 0]), np.array([0.0, 0, 1]), np.array([1.0, 0, 0])
CENTRE = np.array([1.0, 2.0, 3.0])


def camera_to_world(right=RIGHT, up=UP, back=BACK, centre=CENTRE):
    """OpenGL camera: columns are the world directions of its x (right), y (up), z (back) axis and its centre."""
    return [[*map(float, row)] for row in np.vstack([np.column_stack([right, up, back, centre]), [0, 0, 0, 1]])]


def frame(name="images/0.png", matrix=None, **own):
    return {"file_path": name, "transform_matrix": camera_to_world() if matrix is None else matrix, **own}


@pytest.fixture
def dataset(tmp_path):
    """Write a data set: the photographs of `frames` (unless listed in `absent`) and transforms.json."""

    def write(frames, absent=(), size=(24, 32), **meta):
        for entry in frames:
            path = tmp_path / entry["file_path"]
            if entry["file_path"] not in absent:
                path.parent.mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(path), np.full((*size, 3), 128, np.uint8))
        (tmp_path / "transforms.json").write_text(json.dumps({**meta, "frames": frames}))
        return tmp_path / "transforms.json"

    return write


def project(camera, point):
    at = camera.world_to_camera @ torch.tensor([*point, 1.0], dtype=torch.float64)
    pixel = camera.K @ at[:3]
    return (pixel[:2] / pixel[2]).tolist(), at[2].item()


def test_opengl_becomes_opencv(dataset):
    (view,) = read_transforms(dataset([frame()], **SHARED))
    assert view.camera.position.tolist() == pytest.approx([1, 2, 3])
    ahead, depth = project(view.camera, CENTRE - 4 * BACK)
    assert ahead == pytest.approx([14.5, 12.25])
    assert depth == pytest.approx(4)
    right, _ = project(view.camera, CENTRE - 4 * BACK + RIGHT)
    above, _ = project(view.camera, CENTRE - 4 * BACK + UP)
    assert right == pytest.approx([14.5 + 50 / 4, 12.25])
    assert above == pytest.approx([14.5, 12.25 - 55 / 4])


def test_view(dataset, tmp_path):
    (view,) = read_transforms(dataset([frame()], **SHARED))
    assert view.stem == "0"
    assert view.image_path == tmp_path / "images" / "0.png"
    assert view.camera.size == (24, 32)
    assert view.undistort is None
    assert view.image().shape == (24, 32, 3)
    assert view.image()[0, 0].tolist() == pytest.approx([128 / 255] * 3)


def test_frame_wins_over_file(dataset):
    path = dataset([frame("a.png"), frame("b.png", fl_x=70.0, cx=20.0, w=40)], **SHARED)
    cv2.imwrite(str(path.parent / "b.png"), np.zeros((24, 40, 3), np.uint8))
    a, b = (view.camera for view in read_transforms(path))
    assert a.K.tolist() == [[50, 0, 14.5], [0, 55, 12.25], [0, 0, 1]]
    assert b.K.tolist() == [[70, 0, 20], [0, 55, 12.25], [0, 0, 1]]
    assert (a.width, b.width) == (32, 40)


def test_numbers_in_quotes_and_nulls(dataset):
    """`null` is as if the field were not there."""
    quoted = {key: str(value) for key, value in SHARED.items()}
    (view,) = read_transforms(dataset([frame(fl_x=None, k1=None, mask_path=None)], **quoted))
    assert view.camera.K.tolist() == [[50, 0, 14.5], [0, 55, 12.25], [0, 0, 1]]
    assert view.camera.size == (24, 32)
    (view,) = read_transforms(dataset([frame()], **{**SHARED, "w": None, "h": None}))
    assert view.camera.size == (24, 32)


def test_field_of_view_in_degrees(dataset):
    """`x_fov`, `y_fov` of instant-ngp."""
    (view,) = read_transforms(dataset([frame()], x_fov=90, y_fov="60", w=32, h=24))
    assert view.camera.K.diagonal().tolist() == pytest.approx([16, 12 * math.sqrt(3), 1])


def test_a_size_that_is_missing_is_not_guessed(dataset):
    """The numbers are those of the photograph before it was made smaller."""
    with pytest.raises(InputError, match=r"is 32 x 24, while 'cx' and 'cy' are the middle of one of about 64 x 48"):
        read_transforms(dataset([frame()], fl_x=100.0, cx=32.0, cy=24.0))
    (view,) = read_transforms(dataset([frame()], fl_x=100.0, cx=32.0, cy=24.0, w=64, h=48))
    assert view.camera.K.tolist() == [[50, 0, 16], [0, 50, 12], [0, 0, 1]]


def test_a_frame_without_name_or_camera_costs_itself(dataset, caplog):
    path = dataset([frame("0.png"), frame("1.png")], **SHARED)
    content = json.loads(path.read_text())
    content["frames"] += [{"transform_matrix": camera_to_world()}, "no frame"]
    path.write_text(json.dumps(content))
    assert [view.stem for view in read_transforms(path)] == ["0", "1"]
    assert "left out 2 frames that cannot be used, first:" in caplog.text
    assert "frame 2: has no 'file_path'" in caplog.text


def test_blender(dataset, tmp_path):
    """camera_angle_x, no size, no extension, names that begin with ./"""
    dataset([frame("train/r_0.png"), frame("train/r_1.png")], size=(30, 40))
    frames = [frame("./train/r_0"), frame("./train/r_1")]
    (tmp_path / "transforms_train.json").write_text(json.dumps({"camera_angle_x": 0.8, "frames": frames}))
    views = read_transforms(tmp_path / "transforms_train.json")
    focal = 20 / math.tan(0.4)
    assert [view.stem for view in views] == ["r_0", "r_1"]
    assert views[0].camera.K.flatten().tolist() == pytest.approx([focal, 0, 20, 0, focal, 15, 0, 0, 1])
    assert views[0].image().shape == (30, 40, 3)


def test_vertical_field_of_view(dataset):
    (view,) = read_transforms(dataset([frame()], camera_angle_y=1.0, w=32, h=24))
    assert view.camera.K.diagonal().tolist() == pytest.approx([12 / math.tan(0.5)] * 2 + [1])
    (view,) = read_transforms(dataset([frame()], camera_angle_x=0.5, camera_angle_y=1.0, w=32, h=24))
    assert view.camera.K.diagonal().tolist() == pytest.approx([16 / math.tan(0.25), 12 / math.tan(0.5), 1])


@pytest.mark.parametrize("extension", [".jpg", ".jpeg", ".JPG"])
def test_extension_may_be_absent(dataset, tmp_path, extension):
    path = dataset([frame("images/a.b" + extension)], **SHARED)
    path.write_text(json.dumps({**SHARED, "frames": [frame("images/a.b")]}))
    (view,) = read_transforms(path)
    assert view.image_path == tmp_path / "images" / ("a.b" + extension)
    assert view.stem == "a.b"


def test_missing_photographs_are_counted(dataset, caplog):
    path = dataset([frame(f"images/{i}.png") for i in range(5)], absent=["images/1.png", "images/3.png"], **SHARED)
    with caplog.at_level(logging.WARNING, logger="sgwarp"):
        views = read_transforms(path)
    assert [view.stem for view in views] == ["0", "2", "4"]
    assert "left out 2 frames without photograph, first 'images/1.png'" in caplog.text


def test_all_photographs_missing(dataset, tmp_path):
    path = dataset([frame("images/0.png"), frame("images/1.png")], absent=["images/0.png", "images/1.png"], **SHARED)
    with pytest.raises(InputError, match=r"none of 2 frames can be used: 2 photographs do not exist .*images/0\.png"):
        read_transforms(path)
    views = read_transforms(path, photographs=False)
    assert [(view.stem, view.image_path) for view in views] == [("0", None), ("1", None)]


@pytest.mark.parametrize("name", ["nul\0.png", "a" * 300 + ".png", "\ud800.png"])
def test_names_no_file_can_have(dataset, name):
    path = dataset([frame("0.png"), frame(name)], absent=[name], **SHARED)
    assert [view.stem for view in read_transforms(path)] == ["0"]


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_poses_that_are_not_finite_are_counted(dataset, caplog, value):
    lost = camera_to_world(centre=[value, 0, 0])
    path = dataset([frame("0.png"), frame("1.png", lost), frame("2.png")], **SHARED)
    with caplog.at_level(logging.WARNING, logger="sgwarp"):
        assert [view.stem for view in read_transforms(path)] == ["0", "2"]
    assert "left out 1 frames whose pose holds NaN or infinity" in caplog.text


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (camera_to_world(2 * RIGHT, 2 * UP, 2 * BACK), r"not a rigid transform: its rotation is scaled by 2; divide"),
        (camera_to_world(RIGHT, UP + RIGHT, BACK), r"not a rigid transform: .* orthogonal unit vectors"),
        (camera_to_world(RIGHT, UP, 0 * BACK), r"not a rigid transform"),
        (camera_to_world(-RIGHT), r"mirrors the world \(determinant -1\)"),
        ([*camera_to_world()[:3], [0.0, 0.0, 0.0, 2.0]], r"last row of 'transform_matrix' must be \[0, 0, 0, 1\]"),
        ([[1.0, 0.0], [0.0, 1.0]], r"'transform_matrix' must be 4 x 4 numbers"),
        ("identity", r"'transform_matrix' must be 4 x 4 numbers"),
        ({}, r"'transform_matrix' must be 4 x 4 numbers"),
        ([[10**400] * 4] * 4, r"'transform_matrix' must be 4 x 4 numbers"),
    ],
)
def test_bad_pose_names_the_frame(dataset, caplog, matrix, message):
    with pytest.raises(InputError, match=r"transforms\.json: frame 0 \(1\.png\): .*" + message):
        read_transforms(dataset([frame("1.png", matrix)], **SHARED))
    with caplog.at_level(logging.WARNING, logger="sgwarp"):
        views = read_transforms(dataset([frame("0.png"), frame("1.png", matrix)], **SHARED))
    assert [view.stem for view in views] == ["0"]
    assert re.search(r"left out 1 frames .*frame 1 \(1\.png\): .*" + message, caplog.text)


def test_three_rows_are_enough(dataset):
    (view,) = read_transforms(dataset([frame(matrix=camera_to_world()[:3])], **SHARED))
    assert view.camera.position.tolist() == pytest.approx([1, 2, 3])


def test_rounded_pose_is_inverted_exactly(dataset):
    """Poses printed with few digits are not quite orthogonal; the centre must stay where the file says."""
    angle = 0.3
    right = np.array([math.cos(angle), math.sin(angle), 0]).round(4)
    up = np.array([-math.sin(angle), math.cos(angle), 0]).round(4)
    matrix = camera_to_world(right, up, np.array([0.0, 0, 1]), [1000.0, -2000.0, 500.0])
    (view,) = read_transforms(dataset([frame(matrix=matrix)], **SHARED))
    at = view.camera.world_to_camera @ torch.tensor([1000.0, -2000.0, 500.0, 1.0], dtype=torch.float64)
    assert at[:3].abs().max() < 1e-9


def test_singular_intrinsics(dataset):
    path = dataset([frame("0.png")], **{**SHARED, "fl_x": 0.0})
    with pytest.raises(InputError, match=r"frame 0 \(0\.png\): K: singular or mirrored \(fx = 0, fy = 55\)"):
        read_transforms(path)


@pytest.mark.parametrize(
    ("meta", "message"),
    [
        ({"w": 32, "h": 24}, "has no focal length"),
        ({"fl_x": "wide", "w": 32, "h": 24}, "'fl_x' must be a number, got 'wide'"),
        ({"fl_x": None, "w": 32, "h": 24}, "has no focal length"),
        ({"fl_x": [50.0], "w": 32, "h": 24}, r"'fl_x' must be a number, got \[50\.0\]"),
        ({"camera_angle_x": 45.8, "w": 32, "h": 24}, "got 45.8; if these are degrees, name it 'x_fov'"),
        ({"x_fov": 200, "w": 32, "h": 24}, "degrees between 0 and 180, got 200"),
        (
            {**SHARED, "cx": 0.5, "cy": 0.5},
            r"principal point \(0\.5, 0\.5\) .* in shares of it; give cx and cy in pixels",
        ),
        ({**SHARED, "fl_x": 0.8, "fl_y": 1.1}, "focal lengths 0.8, 1.1 .* are they in pixels"),
        ({"camera_angle_x": 3.5, "w": 32, "h": 24}, "between 0 and pi, got 3.5"),
        ({"fl_x": 50, "w": 0, "h": 24}, "'w' must be a positive whole number of pixels, got 0"),
        ({"fl_x": 50, "w": 32, "h": 24.5}, "'h' must be a positive whole number"),
        ({**SHARED, "camera_model": "EQUIRECTANGULAR"}, "camera_model 'EQUIRECTANGULAR' is not supported"),
        ({**SHARED, "camera_model": ["OPENCV"]}, r"camera_model \['OPENCV'\] is not supported"),
        ({**SHARED, "k4": 0.1}, "'k4' is not defined for camera_model OPENCV;"),
        ({**SHARED, "k1": -50.0}, "distortion .* folds the image"),
        ({**SHARED, "fl_x": 10**400}, "'fl_x' must be a number"),
    ],
)
def test_bad_intrinsics(dataset, meta, message):
    with pytest.raises(InputError, match=r"transforms\.json: frame 0 \(images/0\.png\): .*" + message):
        read_transforms(dataset([frame()], **meta))


def test_cameras_alone_need_a_size(dataset):
    path = dataset([frame()], fl_x=50.0)
    with pytest.raises(InputError, match=r"frame 0 \(images/0\.png\): has no 'h'"):
        read_transforms(path, photographs=False)


def test_photograph_of_another_size(dataset):
    (view,) = read_transforms(dataset([frame()], size=(12, 16), **SHARED))
    assert view.camera.K.tolist() == [[25.0, 0, 7.25], [0, 27.5, 6.125], [0, 0, 1]]
    for distortion in ({}, {"k1": -0.1}):
        with pytest.raises(InputError, match=r"images/0\.png: image is 16 x 16, its camera says 32 x 24"):
            read_transforms(dataset([frame()], size=(16, 16), **distortion, **SHARED))


def test_each_photograph_has_its_own_size(dataset):
    path = dataset([frame("a.png"), frame("b.png")], camera_angle_x=0.8)
    cv2.imwrite(str(path.parent / "b.png"), np.zeros((48, 80, 3), np.uint8))
    a, b = (view.camera for view in read_transforms(path))
    assert (a.size, b.size) == ((24, 32), (48, 80))
    assert a.K[0, 0].item() == pytest.approx(16 / math.tan(0.4))
    assert b.K.flatten().tolist() == pytest.approx([40 / math.tan(0.4), 0, 40, 0, 40 / math.tan(0.4), 24, 0, 0, 1])


def test_files_that_a_frame_names(dataset, tmp_path, caplog):
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks" / "0.png").write_bytes(b"")
    own = {"mask_path": "masks/0.png", "depth_file_path": "gone.png"}
    path = dataset(
        [frame("0.png", mask_path="masks/0.png"), frame("1.png", **own)], **SHARED, train_filenames=["0.png"]
    )
    with caplog.at_level(logging.WARNING, logger="sgwarp"):
        view, other = read_transforms(path)
    assert view.mask_path == other.mask_path == tmp_path / "masks" / "0.png"
    assert other.depth_path is None
    assert view.name == "0.png"
    assert "1 of 1 files that its frames name as depth_file_path do not exist, first gone.png" in caplog.text
    assert "not used: train_filenames" in caplog.text


@pytest.mark.parametrize("model", [None, "OPENCV", "OPENCV_FISHEYE"])
def test_distorted_photographs_are_undistorted(dataset, tmp_path, model):
    meta = {**SHARED, "k1": -0.2, "k2": 0.02, **({"camera_model": model} if model else {})}
    path = dataset([frame()], **meta)
    u, v = np.meshgrid(np.arange(32), np.arange(24))
    photograph = np.stack([u * 8, v * 8, u + v], axis=2).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "images" / "0.png"), photograph[:, :, ::-1])
    (view,) = read_transforms(path)
    assert view.camera.K[0, 2] == 14.5
    assert view.camera.K[0, 0] != 50
    image = view.image()
    assert image.shape == (24, 32, 3)
    # Where a ray falls on the photograph, from the definition of the models: x (1 + k1 r2 + k2 r4) or x theta_d / r.
    column, row = 3, 20
    x = (column + 0.5 - 14.5) / view.camera.K[0, 0].item()
    y = (row + 0.5 - 12.25) / view.camera.K[1, 1].item()
    r2 = x * x + y * y
    scale = 1 - 0.2 * r2 + 0.02 * r2**2
    if model == "OPENCV_FISHEYE":
        theta = math.atan(math.sqrt(r2))
        scale = theta * (1 - 0.2 * theta**2 + 0.02 * theta**4) / math.sqrt(r2)
    expected = (x * scale * 50 + 14.5 - 0.5) * 8, (y * scale * 55 + 12.25 - 0.5) * 8
    assert (image[row, column, :2] * 255).tolist() == pytest.approx(expected, abs=0.8)


def test_fisheye_flag_of_instant_ngp(dataset):
    (view,) = read_transforms(dataset([frame()], is_fisheye=True, **SHARED))
    assert view.undistort is not None


def test_pinhole_without_coefficients_is_left_alone(dataset):
    zeros = dict.fromkeys(("k1", "k2", "k3", "p1", "p2"), 0.0)
    (view,) = read_transforms(dataset([frame()], camera_model="OPENCV", **zeros, **SHARED))
    assert view.undistort is None
    assert view.camera.K[0, 0] == 50


def test_stems_are_unique(dataset):
    views = read_transforms(dataset([frame("a/0.png"), frame("b/0.png"), frame("b/1.png")], **SHARED))
    assert [view.stem for view in views] == ["a_0", "b_0", "b_1"]
    with pytest.raises(
        InputError, match=r"'a/b/0\.png' and 'a_b/0\.png' are both view 'a_b_0\.png'; rename or drop one"
    ):
        read_transforms(dataset([frame("a/b/0.png"), frame("a_b/0.png")], **SHARED))


def test_order_is_that_of_the_file(dataset):
    names = ["10.png", "9.png", "2.png"]
    assert [v.stem for v in read_transforms(dataset([frame(n) for n in names], **SHARED))] == ["10", "9", "2"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "is not valid JSON"),
        ("", "is not valid JSON"),
        ("[]", "has no list 'frames'"),
        ('{"frames": 3}', "has no list 'frames'"),
        ('{"frames": []}', "its list 'frames' is empty"),
        ('{"frames": [{}]}', "frame 0: has no 'file_path'"),
        ('{"frames": ["a.png"]}', "frame 0: has no 'file_path'"),
        ('{"frames": [{"file_path": 7}]}', "frame 0: has no 'file_path'"),
    ],
)
def test_malformed_file(tmp_path, text, message):
    (tmp_path / "transforms.json").write_text(text)
    with pytest.raises(InputError, match=r"transforms\.json: " + message):
        read_transforms(tmp_path / "transforms.json")


def test_missing_file(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_transforms(tmp_path / "transforms.json")


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=4),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=16,
)
KEYS = st.sampled_from(
    ["fl_x", "fl_y", "cx", "w", "h", "k1", "k4", "p1", "camera_angle_x", "camera_model", "is_fisheye"]
)


@pytest.mark.slow
@settings(deadline=None, max_examples=150)
@given(meta=st.dictionaries(KEYS, VALUES, max_size=4), own=st.dictionaries(KEYS, VALUES, max_size=3), matrix=VALUES)
def test_random_values(tmp_path_factory, allow_input_error, meta, own, matrix):
    path = tmp_path_factory.getbasetemp() / "transforms.json"
    for pose in (matrix, camera_to_world()):
        entry = {"file_path": "a.png", "transform_matrix": pose, **own}
        path.write_text(json.dumps({**SHARED, **meta, "frames": [entry]}))
        with allow_input_error(path):
            read_transforms(path, photographs=False)
