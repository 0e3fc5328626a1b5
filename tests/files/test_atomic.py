import glob
import os
import stat
import subprocess
import sys

import pytest

from sgwarp.errors import InputError
from sgwarp.files import atomic
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


def test_a_failed_write_is_one_error_and_leaves_nothing(tmp_path, disk):
    """The operating system itself refuses to let the file grow."""
    target = tmp_path / "out.txt"
    target.write_text("old")
    refused = pytest.raises(InputError, match=r"out\.txt: cannot be written \(File too large\)")
    with disk(8), refused, atomic_path(target) as temporary:
        temporary.write_text("more than eight")
    assert target.read_text() == "old"
    assert os.listdir(tmp_path) == ["out.txt"]


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs a device that is always full")
def test_a_full_disk_is_one_error(tmp_path):
    with pytest.raises(InputError, match="No space left"), atomic_path(tmp_path / "a"), open("/dev/full", "w") as full:
        full.write("x")
    assert os.listdir(tmp_path) == []


def test_the_target_of_a_link_is_replaced(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "real" / "a.txt").write_text("old")
    (tmp_path / "a.txt").symlink_to(tmp_path / "real" / "a.txt")
    with atomic_path(tmp_path / "a.txt") as temporary:
        temporary.write_text("new")
    assert (tmp_path / "a.txt").is_symlink()
    assert (tmp_path / "real" / "a.txt").read_text() == "new"


KILLED = """
import os, sys
from sgwarp.files.atomic import atomic_path
with atomic_path(sys.argv[1]) as temporary:
    temporary.write_text("half")
    os.kill(os.getpid(), 9)
"""


def test_what_a_killed_process_left_goes_at_the_next_write(tmp_path):
    target = tmp_path / "a.safetensors"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, "-c", KILLED, str(target)], env=environment, check=False)
    assert done.returncode == -9
    left = os.listdir(tmp_path)
    assert len(left) == 1
    assert atomic.leftovers(tmp_path) == [tmp_path / left[0]]
    with atomic_path(tmp_path / "other.txt") as temporary:
        temporary.write_text("x")
    assert os.listdir(tmp_path) == ["other.txt"]


@pytest.mark.skipif(not os.path.exists("/proc/self/stat"), reason="looks for processes in /proc")
def test_a_process_that_nobody_has_asked_how_it_ended_writes_no_more(tmp_path):
    """As a killed one stays listed in a container whose first process takes care of none."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.Popen([sys.executable, "-c", KILLED, str(tmp_path / "a.txt")], env=environment)
    os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)  # it has ended, and is still there
    os.kill(process.pid, 0)
    (left,) = tmp_path.iterdir()
    assert atomic.leftovers(tmp_path) == [left]
    assert process.wait() == -9


def test_what_others_are_writing_stays(tmp_path):
    machine = atomic._machine()
    other = "0000" if machine != "0000" else "ffff"
    running, dead, elsewhere, old = (
        tmp_path / f".a.{name}.png" for name in (f"{machine}-1-00000000", f"{machine}-4194999-00000000",
                                                 f"{other}-4194999-00000000", f"{other}-1-00000001")
    )  # fmt: skip
    for path in (running, dead, elsewhere, old, tmp_path / ".a.png", tmp_path / ".git.1234-5.png"):
        path.touch()
    os.utime(old, (0, 0))
    assert set(atomic.leftovers(tmp_path)) == {dead, old}
    with atomic_path(tmp_path / "b.png") as temporary:
        temporary.touch()
        assert temporary not in atomic.leftovers(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {
        "b.png", running.name, elsewhere.name, ".a.png", ".git.1234-5.png"
    }  # fmt: skip
