"""Structure from motion replaces its own results, and never those of COLMAP or a user, which have the same names."""

import cv2
import numpy as np
import pytest

from sgwarp.errors import InputError
from sgwarp.files.images import write_rgb
from sgwarp.reconstruction.sfm.poses import estimate_poses
from sgwarp.reconstruction.sfm.video import extract_frames


@pytest.fixture
def photographs(tmp_path):
    for index in range(3):
        write_rgb(tmp_path / "project" / "images" / f"{index}.png", np.random.default_rng(index).random((96, 128, 3)))
    return tmp_path / "project" / "images"


@pytest.mark.parametrize("name", ["database.db", "sparse/0/cameras.txt"])
def test_a_project_of_colmap_stays_as_it_is(photographs, name):
    theirs = photographs.parent / name
    theirs.parent.mkdir(parents=True, exist_ok=True)
    theirs.write_text("days of work")
    with pytest.raises(InputError, match=r"is there already, and `sgwarp poses` did not make it; choose another --out"):
        estimate_poses(photographs, photographs.parent)
    assert theirs.read_text() == "days of work"
    assert not (photographs.parent / "sfm.json").exists()


@pytest.mark.parametrize("link", [False, True])
def test_photographs_of_another_folder_are_not_taken_for_those_of_the_model(photographs, tmp_path, link):
    out = tmp_path / "out"
    out.mkdir()
    if link:
        (tmp_path / "others").mkdir()
        (out / "images").symlink_to(tmp_path / "others")
    else:
        (out / "images").mkdir()
    with pytest.raises(InputError, match=r"out/images: is there already"):
        estimate_poses(photographs, out)
    assert (out / "images").is_dir()


def test_own_results_are_replaced(photographs, tmp_path):
    """A run that ended without a model, then another of the same folder."""
    out = tmp_path / "out"
    for _ in range(2):
        with pytest.raises(InputError, match="no two photographs overlap enough"):
            estimate_poses(photographs, out)
        assert (out / "sfm.json").is_file()
    (out / "database.db").write_bytes(b"of other photographs")
    (photographs / "3.png").write_bytes((photographs / "2.png").read_bytes())
    with pytest.raises(InputError, match="no two photographs overlap enough"):
        estimate_poses(photographs, out)


def film(path, shade, frames=9):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, (64, 48))
    assert writer.isOpened()
    for _ in range(frames):
        writer.write(np.full((48, 64, 3), shade, np.uint8))
    writer.release()
    return path


def shade_of(folder):
    return round(cv2.imread(str(folder / "00000.jpg")).mean() / 50) * 50


def test_frames_of_another_video_or_interval_are_taken_anew(tmp_path):
    folder = tmp_path / "images"
    assert extract_frames(film(tmp_path / "a.avi", 100), folder, 3) == 3
    (folder / "00000.jpg").touch()
    (folder / "00003.jpg").write_bytes(b"kept, as the folder is")
    assert extract_frames(tmp_path / "a.avi", folder, 3) == 4
    assert extract_frames(tmp_path / "a.avi", folder, 2) == 5
    assert shade_of(folder) == 100
    assert extract_frames(film(tmp_path / "b.avi", 200), folder, 2) == 5
    assert shade_of(folder) == 200
    assert extract_frames(film(tmp_path / "b.avi", 50, frames=6), folder, 2) == 3
    assert shade_of(folder) == 50


def test_a_folder_of_something_else_is_no_place_for_frames(tmp_path):
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "holiday.jpg").write_bytes(b"a photograph")
    with pytest.raises(InputError, match=r"images: is there already, and holds no frames of a video"):
        extract_frames(film(tmp_path / "a.avi", 100), tmp_path / "images", 3)
    assert [path.name for path in (tmp_path / "images").iterdir()] == ["holiday.jpg"]
