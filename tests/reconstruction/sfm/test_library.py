"""Calls of pycolmap: room on the disk before them, a progress bar and Ctrl-C meanwhile, one line where they fail."""

import shutil
import sys
import threading
from types import SimpleNamespace

import pytest

from sgwarp.errors import InputError
from sgwarp.reconstruction.sfm import library
from sgwarp.reconstruction.sfm.library import has_pycolmap, require_pycolmap, require_room, run_cancellable

MEGABYTE = 2**20


@pytest.fixture
def token(monkeypatch):
    """The one that a call gets; `canceled` is set when it is canceled."""
    found = SimpleNamespace(canceled=threading.Event())
    found.cancel = found.canceled.set
    monkeypatch.setattr(library, "require_pycolmap", lambda: SimpleNamespace(CancellationToken=lambda: found))
    monkeypatch.setattr(library, "POLL", 0.01)
    return found


@pytest.mark.parametrize(("free", "more", "enough"), [(42, 10, True), (42, 11, False), (32, 0, True), (31, 0, False)])
def test_room_is_what_is_stored_and_32_megabytes(tmp_path, monkeypatch, free, more, enough):
    asked = []

    def usage(path):
        asked.append(path)
        return SimpleNamespace(free=free * MEGABYTE)

    monkeypatch.setattr(shutil, "disk_usage", usage)
    database = tmp_path / "database.db"
    if enough:
        require_room(database, more * MEGABYTE)
    else:
        said = f"{free} MB left and structure from motion needs {more + 32}; make room or choose another place"
        with pytest.raises(InputError, match=rf"database\.db: the disk has {said}"):
            require_room(database, more * MEGABYTE)
    assert asked == [tmp_path]


def test_where_nothing_tells_of_room_the_call_may_try(tmp_path):
    (tmp_path / "there").mkdir()
    with pytest.raises(InputError, match="the disk has"):
        require_room(tmp_path / "there" / "database.db", 2**60)
    require_room(tmp_path / "missing" / "database.db", 2**60)


def test_a_call_runs_beside_and_its_progress_is_watched(tmp_path, token):
    seen, enough = [], threading.Event()

    def call(given):
        assert given is token
        assert threading.current_thread() is not threading.main_thread()
        assert threading.current_thread().daemon  # a process that ends does not wait for it
        assert enough.wait(20)
        return "what it found"

    def watch():
        seen.append(threading.current_thread() is threading.main_thread())
        if len(seen) >= 3:
            enough.set()

    assert run_cancellable(tmp_path / "database.db", call, watch) == "what it found"
    assert len(seen) >= 3
    assert all(seen)
    assert run_cancellable(tmp_path / "database.db", lambda given: None) is None


def test_an_interruption_cancels_the_call_and_waits_for_it(tmp_path, token):
    ended = []

    def call(given):
        assert given.canceled.wait(20)
        ended.append(True)

    def interrupt():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_cancellable(tmp_path / "database.db", call, interrupt)
    assert ended


def test_what_the_library_gives_up_with_is_one_line(tmp_path, token):
    def call(given):
        raise RuntimeError("SQLite error:\n   disk I/O error")

    said = r"database\.db: structure from motion cannot go on \(SQLite error: disk I/O error\); if the disk is full"
    with pytest.raises(InputError, match=said):
        run_cancellable(tmp_path / "database.db", call)


@pytest.mark.parametrize("error", [ZeroDivisionError("ours"), InputError("a file: is not good"), KeyboardInterrupt()])
def test_other_errors_are_raised_as_they_are(tmp_path, token, error):
    def call(given):
        raise error

    with pytest.raises(type(error)) as caught:
        run_cancellable(tmp_path / "database.db", call)
    assert caught.value is error


def test_without_the_library_the_remedy_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(InputError, match=r"needs pycolmap; run: pip install 'sgwarp\[sfm\]'"):
        require_pycolmap()
    assert not has_pycolmap()


def test_the_library_is_silent(monkeypatch):
    log = SimpleNamespace(FATAL=3, minloglevel=0)
    monkeypatch.setitem(sys.modules, "pycolmap", SimpleNamespace(logging=log))
    assert require_pycolmap().logging is log
    assert log.minloglevel == 3
    assert has_pycolmap()
