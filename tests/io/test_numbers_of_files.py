"""Numbers as files and their names hold them: frames in order, colors in whatever range."""

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from sgwarp.io.colors import unit_colors
from sgwarp.io.points import load_points
from sgwarp.io.sequences import load_sequence


@pytest.mark.parametrize(
    "names",
    [
        ["2.ply", "10.ply", "101.ply"],
        ["take1_frame2.ply", "take1_frame10.ply", "take1_frame101.ply"],
        ["2024_scene3_7.ply", "2023_scene5_8.ply", "2022_scene1_9.ply"],
        ["start.ply", "frame0.ply", "frame1.ply"],  # without a number: before the others
    ],
)
def test_the_last_number_of_a_name_is_the_frame(tmp_path, names):
    for name in reversed(names):
        (tmp_path / name).touch()
    assert [path.name for path in load_sequence(tmp_path).files] == names


@pytest.mark.parametrize(
    ("kind", "values", "white"),
    [
        ("u1", [0, 1, 255], 255),
        ("u1", [0, 1], 255),  # a dark picture
        ("i4", [0, 1], 255),  # whole numbers of more bits never mean 1
        ("i8", [0, 255], 255),
        ("u2", [0, 256], 65535),
        ("u2", [0, 65535], 65535),
        ("f4", [0.0, 1.0], 1),
        ("f4", [0.0, 1.5], 255),
        ("f8", [0.0, 300.0], 65535),
        ("f8", [0.0, 70000.0], 70000),
    ],
)
def test_what_white_is(kind, values, white):
    found = unit_colors(np.array(values, kind))
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, np.array(values, np.float64) / white, rtol=1e-6)


def test_negative_colors_are_black_and_infinite_ones_decide_nothing():
    found = unit_colors(np.array([-0.5, 0.5, np.inf], np.float32))
    assert found[:2].tolist() == [0.0, 0.5]


def test_points_that_are_not_finite_are_counted(tmp_path, caplog):
    rows = np.zeros(9, dtype=[*((axis, "<f4") for axis in "xyz"), *((c, "u1") for c in ("red", "green", "blue"))])
    rows["x"] = [0, 1, np.nan, 3, 4, np.inf, 6, 7, 8]
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(tmp_path / "points.ply"))
    positions, colors = load_points(tmp_path / "points.ply")
    assert positions[:, 0].tolist() == [0, 1, 3, 4, 6, 7, 8]
    assert len(colors) == 7
    assert "left out 2 of 9 points: not finite" in caplog.text
