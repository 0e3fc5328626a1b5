"""Files that belong to photographs, in every place where a tool puts them."""

import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.io.companions import PICTURES, Companions
from sgwarp.scene import Camera, View

CAMERA = Camera(torch.tensor([[5.0, 0, 2], [0, 5, 2], [0, 0, 1]]), torch.eye(4, dtype=torch.float64), 4, 4)


def views(*names: str) -> list[View]:
    """One view per photograph, its stem as `load_views` makes it where folders repeat names."""
    return [View(name.rpartition(".")[0].replace("/", "_"), CAMERA, name=name) for name in names]


def found(folder, asked, *endings) -> list[str | None]:
    files = Companions(folder, asked)
    chosen = [files.find(view, endings or PICTURES) for view in asked]
    return [paths[0].relative_to(folder).as_posix() if paths else None for paths in chosen]


def put(folder, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()


@pytest.mark.parametrize(
    "name",
    [
        *("cam0_IMG_1.png", "IMG_1.png", "cam0/IMG_1.png", "cam0/IMG_1.JPG.png", "IMG_1.JPG.png"),
        *("CAM0/img_1.PNG", "cam0_img_1.jpg", "cam0/IMG_1.webp"),
    ],
)
def test_each_spelling_is_found(tmp_path, name):
    put(tmp_path, name, "other/IMG_2.png")
    assert found(tmp_path, views("cam0/IMG_1.JPG")) == [name]


def test_a_short_name_that_two_photographs_share_is_nobodys(tmp_path):
    asked = views("cam0/1.jpg", "cam1/1.jpg", "cam1/2.jpg")
    put(tmp_path, "1.png", "2.png")
    assert found(tmp_path, asked) == [None, None, "2.png"]
    put(tmp_path, "cam0/1.png", "cam1/1.jpg.png")
    assert found(tmp_path, asked) == ["cam0/1.png", "cam1/1.jpg.png", "2.png"]


def test_the_surest_name_wins(tmp_path):
    asked = views("cam0/1.jpg")
    for name in ("1.png", "cam0/1.png", "cam0_1.png"):
        put(tmp_path, name)
        assert found(tmp_path, asked) == [name]


def test_another_letter_case_counts_where_it_is_alone(tmp_path):
    put(tmp_path, "a.PNG", "A.png")
    if len(list(tmp_path.iterdir())) < 2:
        pytest.skip("this file system does not tell letter cases apart")
    assert found(tmp_path, views("a.jpg")) == [None]
    put(tmp_path, "a.png")
    assert found(tmp_path, views("a.jpg")) == ["a.png"]


def test_one_file_for_each_ending_in_their_order(tmp_path):
    put(tmp_path, "a.png", "a.npy", "a_s.npy")
    files = Companions(tmp_path, views("a.jpg")).find(views("a.jpg")[0], (".npy", "_s.npy", ".npz", ".png"))
    assert [path.name for path in files] == ["a.npy", "a_s.npy", "a.png"]


def test_a_dot_in_a_name_is_no_suffix(tmp_path):
    put(tmp_path, "frame.png", "frame.001.png")
    assert found(tmp_path, views("frame.001.jpg")) == ["frame.001.png"]
    assert found(tmp_path, views("frame.002.jpg")) == [None]


def test_a_folder_that_is_missing_or_wrong(tmp_path, monkeypatch):
    with pytest.raises(InputError, match="nowhere: no such folder"):
        Companions(tmp_path / "nowhere", [])
    put(tmp_path, "a.png", "b.png")
    monkeypatch.setattr("sgwarp.io.companions.MOST_FILES", 1)
    with pytest.raises(InputError, match="holds more than 1 files"):
        Companions(tmp_path, [])


def test_words_before_a_name(tmp_path):
    """As in mask_IMG_1.png; in a mirrored folder before the last part."""
    put(tmp_path, "cam0/mask_IMG_1.png", "IMG_1.png")
    (view,) = views("cam0/IMG_1.JPG")
    files = Companions(tmp_path, [view]).find(view, [".png"], ["mask_", ""])
    assert [path.relative_to(tmp_path).as_posix() for path in files] == ["cam0/mask_IMG_1.png", "IMG_1.png"]


def test_a_path_with_backslashes(tmp_path):
    put(tmp_path, "cam0/IMG_1.png", "cam1/IMG_1.png")
    assert found(tmp_path, views("cam0\\IMG_1.JPG", "cam1\\IMG_1.JPG")) == ["cam0/IMG_1.png", "cam1/IMG_1.png"]
