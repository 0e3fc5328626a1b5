"""Which files of a folder are photographs, by their names and folders alone."""

import pytest

from sgwarp.reconstruction.sfm.poses import photographs_in


def found(folder, *names: str) -> list[str]:
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    return photographs_in(folder)


@pytest.mark.parametrize(
    "name",
    [
        *("{}_mask.png", "{}.mask.png", "{}-mask.png", "{}_depth.png", "mask_{}.png", "dynamic_mask_{}.png"),
        *("depth_{}.png", "MASK_{}.PNG", "{}.JPG.png", "{}.jpg.png", "{}.jpg_mask.png", "mask_{}.jpg.png"),
    ],
)
@pytest.mark.parametrize("stem", ["DSC00017", "a", "img_1.5"])
def test_what_is_named_after_a_photograph_belongs_to_it(tmp_path, name, stem):
    photographs = [f"s/{stem}.JPG", "s/z.jpg"]
    assert found(tmp_path, *photographs, f"s/{name.format(stem)}") == photographs


@pytest.mark.parametrize("name", ["{}_mask.png", "mask_{}.png", "depth_{}.png", "{}.jpg.png", "{}_depth.png"])
def test_without_such_a_photograph_it_is_one(tmp_path, name):
    """In its own folder: one of the same name elsewhere does not count."""
    names = ["other/DSC1.jpg", "s/DSC2.jpg", f"s/{name.format('DSC1')}"]
    assert found(tmp_path, *names) == sorted(names)


def test_a_mask_of_nothing_is_a_photograph(tmp_path):
    names = ["_mask.png", "a.jpg", "mask_.png"]
    assert sorted(found(tmp_path, *names)) == names


@pytest.mark.parametrize("folder", ["masks", "Mask", "depths", "LABELS", "semantics", "normal", "confidence"])
@pytest.mark.parametrize("below", ["{}/a.png", "left/{}/a.png", "{}/left/a.png"])
def test_folders_of_what_belongs_to_photographs(tmp_path, folder, below):
    assert found(tmp_path, "images/a.png", below.format(folder)) == ["images/a.png"]


@pytest.mark.parametrize("folder", ["segmentations", "corrected_images"])
def test_more_of_them(tmp_path, folder):
    assert found(tmp_path, "images/a.png", f"{folder}/a.png") == ["images/a.png"]


@pytest.mark.parametrize(
    ("folder", "copy"), [("images_2", True), ("images_4", True), ("images_8", True), ("images_3", False)]
)
def test_smaller_copies_of_a_folder_beside_it(tmp_path, folder, copy):
    assert found(tmp_path, "x/images/a.png", f"x/{folder}/b.png") == ["x/images/a.png", f"x/{folder}/b.png"][: 2 - copy]
    assert f"x/sub/{folder}/b.png" in found(tmp_path, f"x/sub/{folder}/b.png")  # whose images lie elsewhere


def test_what_is_hidden_or_no_file_is_no_photograph(tmp_path):
    (tmp_path / "folder.png").mkdir()
    names = [".thumbs/a.png", "images/.a.png", "images/.b/c.png", "images/a.txt", "images/a.b.jpg"]
    assert found(tmp_path, *names) == ["images/a.b.jpg"]
