import glob
import os
import stat

import pytest

from sgwarp.errors import InputError
from sgwarp.files.atomic import atomic_path


def test_creates_folders_and_keeps_suffix(tmp_path):
    target = tmp_path / "a" / "b" / "scene.compressed.ply"
    with atomic_path(target) as temporary:
        assert temporary.parent == target.parent
        assert temporary.suffix == ".ply"
        temporary.write_text("whole")
        assert not target.exists()
    assert target.read_text() == "whole"
    assert os.listdir(target.parent) == [target.name]


def test_error_leaves_old_file_and_no_rest(tmp_path):
    target = tmp_path / "out.png"
    target.write_text("old")
    with pytest.raises(UnicodeEncodeError), atomic_path(target) as temporary:
        temporary.write_text("ha\udc00", encoding="utf-8")
    assert target.read_text() == "old"
    assert os.listdir(tmp_path) == ["out.png"]


def test_temporary_name_is_hidden_from_globs(tmp_path):
    with atomic_path(tmp_path / "a.png") as temporary:
        temporary.write_text("x")
        assert glob.glob(str(tmp_path / "*.png")) == []


def test_permissions_follow_the_umask(tmp_path):
    plain = tmp_path / "plain"
    plain.touch()
    with atomic_path(tmp_path / "out.txt") as temporary:
        temporary.write_text("x")
    assert stat.S_IMODE((tmp_path / "out.txt").stat().st_mode) == stat.S_IMODE(plain.stat().st_mode)


def test_folder_in_the_way(tmp_path):
    with pytest.raises(InputError, match=r"is a folder"), atomic_path(tmp_path):
        pass


def test_file_where_the_folder_should_be(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=r"cannot be written"), atomic_path(tmp_path / "file" / "out.png"):
        pass
