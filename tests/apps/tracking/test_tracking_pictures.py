"""Sheet, video, boards and plots of a tracked scene: which picture lies where, and which line is drawn through what."""

import itertools
import json
from types import SimpleNamespace

import numpy as np
import pytest

from sgwarp.apps.tracking import pictures, run, state
from sgwarp.apps.tracking.pictures import LINE, SIDE_BY_SIDE, frame_picture, object_colours
from sgwarp.errors import InputError
from sgwarp.files.images import read_rgb, write_rgb
from sgwarp.runs.log import RunLog


def picture_of(seed: int, height: int = 12, width: int = 20) -> np.ndarray:
    """A picture that is no mirror image of itself."""
    return np.random.default_rng(seed).integers(0, 255, (height, width, 3), dtype=np.uint8)


@pytest.fixture
def drawn(tmp_path):
    """Five pictures, the last of them larger."""
    paths = [tmp_path / f"{k}.png" for k in range(5)]
    for k, path in enumerate(paths):
        write_rgb(path, picture_of(k, *((16, 24) if k == 4 else ())))
    return paths


def test_a_contact_sheet_shows_pictures_as_they_are_row_by_row(drawn, tmp_path):
    pictures.write_contact_sheet(tmp_path / "sheet.png", drawn)
    sheet = read_rgb(tmp_path / "sheet.png")
    assert sheet.shape == (2 * 16, 3 * 24, 3)
    white = sheet.copy()
    for k, path in enumerate(drawn):
        one, y, x = read_rgb(path), k // 3 * 16, k % 3 * 24
        np.testing.assert_array_equal(sheet[y : y + len(one), x : x + one.shape[1]], one)
        white[y : y + len(one), x : x + one.shape[1]] = 255
    assert (white == 255).all(), "nothing else is on it"


def test_a_video_shows_the_pictures_one_after_the_other(drawn, tmp_path, monkeypatch):
    import cv2

    frames, made = [], []

    class Writer:
        def __init__(self, path, fourcc, rate, size):
            made.append((fourcc, rate, size))
            open(path, "w").close()

        def isOpened(self):
            return True

        def write(self, frame):
            frames.append(frame[:, :, ::-1].copy())

        def release(self):
            made.append("released")

    Writer.fourcc = staticmethod(cv2.VideoWriter.fourcc)
    monkeypatch.setattr(cv2, "VideoWriter", Writer)
    monkeypatch.setattr(pictures, "require_frames", lambda where, path, count: made.append(count))
    pictures.write_video(tmp_path / "v.mp4", drawn)
    assert made == [(Writer.fourcc(*"mp4v"), 10, (24, 16)), "released", len(drawn)]
    assert (tmp_path / "v.mp4").is_file()
    for frame, path in zip(frames, drawn, strict=True):
        one = read_rgb(path)
        np.testing.assert_array_equal(frame[: len(one), : one.shape[1]], one)
        assert (frame[len(one) :] == 255).all()


def test_a_video_that_cannot_be_written_names_the_option(drawn, tmp_path, monkeypatch):
    import cv2

    class Writer:
        fourcc = staticmethod(cv2.VideoWriter.fourcc)

        def __init__(self, *given):
            pass

        def isOpened(self):
            return False

    monkeypatch.setattr(cv2, "VideoWriter", Writer)
    with pytest.raises(InputError, match=r"v.mp4: .*--no-pictures"):
        pictures.write_video(tmp_path / "v.mp4", drawn)
    assert not (tmp_path / "v.mp4").exists()


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5])
def test_views_of_a_frame_lie_side_by_side(count):
    """At most four, two in a row, each over its own photograph."""
    photographs = [picture_of(k) for k in range(count)]
    images = [np.full((12, 20), 3, np.uint8) for _ in range(count)]
    board = frame_picture(photographs, images, ("3",), (3,), "title")
    shown, columns = min(count, SIDE_BY_SIDE), 1 if count == 1 else 2
    rows = -(-shown // columns)
    assert (board[:LINE, : columns * 20] < 128).any(), "the title"
    for k in range(shown):
        y, x = LINE + k // columns * 12, k % columns * 20
        tile = board[y : y + 12, x : x + 20].astype(float)
        wanted = 0.4 * photographs[k] + 0.6 * object_colours(("3",))[0]
        assert np.abs(tile - wanted).max() <= 1
    if shown < rows * columns:
        assert (board[LINE + 12 : LINE + 24, 20:40] == 255).all()


def test_a_value_of_an_image_has_the_color_of_its_object():
    photograph, image = np.full((4, 6, 3), 100, np.uint8), np.array([[7, 7, 2, 2, 0, 255]] * 4, np.uint8)
    board = frame_picture([photograph], [image], ("two", "seven"), (2, 7), "")[LINE : LINE + 4, :6].astype(float)
    first, second = object_colours(("two", "seven")).astype(float)
    for column, color in ((0, second), (1, second), (2, first), (3, first)):
        assert np.abs(board[:, column] - (40 + 0.6 * color)).max() <= 1
    assert (board[:, 4] < 60).all(), "no object is dimmed"
    assert (board[:, 5] < 60).all()


def test_colors_go_by_id_or_else_by_place():
    assert np.array_equal(object_colours(("7", "2")), object_colours(tuple(map(str, range(8))))[[7, 2]])
    assert np.array_equal(object_colours(("lamp", "2")), object_colours(("0", "1")))


@pytest.fixture
def lines(monkeypatch, tmp_path):
    """`lines(objects, frames)`: what is plotted, by panel."""
    pytest.importorskip("matplotlib")
    from matplotlib.axes import Axes

    def plotted(objects, frames):
        found = {}

        def plot(self, *values, **options):
            found.setdefault(self, []).append((*values, options))
            return original(self, *values, **options)

        original = Axes.plot
        with monkeypatch.context() as patch:
            patch.setattr(Axes, "plot", plot)
            assert pictures.write_trajectories(tmp_path / "t.png", {"frames": frames, "objects": objects})
        assert read_rgb(tmp_path / "t.png").size
        return list(found.values()), list(found)

    return plotted


def same(found, expected):
    np.testing.assert_array_equal(np.asarray(found, float), np.asarray(expected, float))


def test_a_line_goes_through_the_places_and_ends_in_a_dot(lines):
    nan = np.nan
    centers = [[float(t), 10.0 + t, 20.0 + t] for t in range(6)]
    moved = {"centroid": [*centers[:4], None, centers[5]], "visible": [True, True, False, True, True, True]}
    away = {"centroid": [None] * 6, "visible": [False] * 6}
    (above, over_time), axes = lines({"4": moved, "5": away}, [0, 1, 2, 3, 4, 5])
    (x, z, options), (last_x, last_z, mark, _) = above
    same(x, [0, 1, nan, 3, nan, 5])
    same(z, [20, 21, nan, 23, nan, 25])
    assert (last_x, last_z, mark) == (5.0, 25.0, "o")
    assert options["label"] == "4"
    same(options["color"], object_colours(("4",))[0] / 255)
    ((times, heights, _),) = over_time
    same(times, [0, 1, nan, 3, nan, 5])
    same(heights, [-10, -11, nan, -13, nan, -15])
    assert [one.get_xlabel() for one in axes] == ["x [m]", "frame"]
    assert [one.get_ylabel() for one in axes] == ["z [m]", "-y [m]"]
    assert [text.get_text() for text in axes[0].get_legend().get_texts()] == ["4"]


def test_a_plot_of_nothing_is_still_one(lines):
    (found, _) = lines({"1": {"centroid": [None], "visible": [False]}}, [0])
    assert found == []


# What a run draws


def test_all_overlays_are_drawn_in_order_and_named(tmp_path, monkeypatch):
    calls, log = [], RunLog()
    for name in ("write_contact_sheet", "write_video", "write_trajectories"):
        monkeypatch.setattr(pictures, name, lambda path, given, name=name: calls.append((name, path, given)) or True)
    overlays = tmp_path / "overlays"
    overlays.mkdir()
    rows = []
    for index in range(4):
        folder = tmp_path / f"{index:05d}"
        folder.mkdir()
        row = {"frame": index, "objects": [], "scores": {}, "changed_object": None, "views": ["a"], "left_out": 0.5}
        rows.append(row)
        (folder / "frame.json").write_text(json.dumps(row))
        if index != 2:  # a frame in which no view was asked
            (overlays / f"{index:05d}.jpg").touch()
    (tmp_path / "00007").mkdir()
    (tmp_path / "00007" / "frame.json").touch()  # of an earlier, longer run
    (tmp_path / "00008").mkdir()  # no frame of ours
    tracks = run._finish(run.Output(tmp_path), 4, log)
    drawn = [overlays / f"{index:05d}.jpg" for index in (0, 1, 3)]
    assert calls == [
        ("write_contact_sheet", tmp_path / "contact_sheet.jpg", drawn),
        ("write_video", tmp_path / "video.mp4", drawn),
        ("write_trajectories", tmp_path / "trajectories.png", tracks),
    ]
    names = ("tracks.json", "contact_sheet.jpg", "video.mp4", "trajectories.png")
    assert log.outputs == [str(tmp_path / name) for name in names]
    assert tracks == run.gather(rows)
    assert (tracks["frames"], tracks["left_out"]) == ([0, 1, 2, 3], [0.5] * 4)
    assert not (tmp_path / "00007").exists()
    assert (tmp_path / "00008").exists()
    calls.clear()
    quiet = RunLog()
    run._finish(run.Output(tmp_path, pictures=False), 4, quiet)
    assert not calls
    assert quiet.outputs == [str(tmp_path / "tracks.json")]


# Stored features


def stored(folder, index, **changes):
    fields = {"shape": np.array((4, 2)), "whole": np.array(index == 0), "rows": np.arange(4, dtype=np.int32)}
    fields |= {"features": np.full((4, 2), index + 1, np.float16), **changes}
    np.savez(folder / f"{index:05d}.npz", **fields)


def test_stored_frames_build_on_each_other(tmp_path):
    stored(tmp_path, 0)
    stored(tmp_path, 1, rows=np.array([1, 3], np.int32), features=np.full((2, 2), 9, np.float16))
    assert state.read_features(tmp_path, 0).tolist() == [[1, 1]] * 4
    assert state.read_features(tmp_path, 1).tolist() == [[1, 1], [9, 9], [1, 1], [9, 9]]


@pytest.mark.parametrize(
    "changes",
    [
        {"rows": np.array([-1, 0, 1, 2], np.int32)},
        {"rows": np.array([0, 1, 2, 4], np.int32)},
        {"rows": np.array([0.0, 1.0, 2.0, 3.0])},
        {"rows": np.array([[0, 1, 2, 3]], np.int32)},
        {"rows": np.arange(3, dtype=np.int32)},
        {"features": np.zeros((4, 3), np.float16)},
    ],
)
@pytest.mark.parametrize("frame", [0, 1])
def test_rows_that_do_not_fit_their_frame_are_refused(tmp_path, frame, changes):
    stored(tmp_path, 0)
    stored(tmp_path, frame, **changes)
    with pytest.raises(InputError, match=rf"{frame:05d}.npz: is damaged"):
        state.read_features(tmp_path, frame)


def test_a_whole_frame_has_every_row(tmp_path):
    stored(tmp_path, 0, shape=np.array((5, 2)))
    with pytest.raises(InputError, match=r"00000\.npz: is damaged"):
        state.read_features(tmp_path, 0)


def tracked(index, features, weight):
    import torch

    return SimpleNamespace(index=index, features=torch.tensor(features), weight=torch.tensor(weight))


def test_a_feature_is_stored_again_where_it_moved_by_a_hundredth(tmp_path):
    store = state.FeatureStore(tmp_path)
    first = [[1.0, 0.0], [1.0, 0.0], [1.0, 0.0], [1.0, 0.0]]
    store.write(tracked(0, first, [1.0, 1.0, 0.0, 1.0]))
    second = [[1.02, 0.0], [1.008, 0.0], [1.0, 0.0], [1.0, 0.0]]
    store.write(tracked(1, second, [1.0, 1.0, 1.0, 0.0]))
    with np.load(tmp_path / "00001.npz") as file:
        assert file["rows"].tolist() == [0, 2, 3], "moved, first seen, no longer seen"
        assert not bool(file["whole"])
    assert (store.rows, store.all_rows) == (4 + 3, 8)
    found = state.read_features(tmp_path, 1)
    np.testing.assert_allclose(found, [[1.02, 0], [1.0, 0], [1.0, 0], [0, 0]], atol=1e-3)
    again = state.FeatureStore(tmp_path)
    again.resume(1)
    again.write(tracked(2, second, [1.0, 1.0, 1.0, 0.0]))
    assert again.rows == 0
    again.write(tracked(3, [[1.0, 0.0]] * 5, [1.0] * 5))
    assert again.rows == 5, "another number of Gaussians is stored whole"
    assert all((tmp_path / f"{k:05d}.npz").is_file() for k in range(4))
    assert [len(state.read_features(tmp_path, k)) for k, _ in itertools.pairwise(range(5))] == [4, 4, 4, 5]
