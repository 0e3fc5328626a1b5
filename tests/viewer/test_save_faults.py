"""Faults under what the viewer saves: temporary files without room or place, a stop and a kill in a save, two at once.

A save goes to the browser as a download; the machine sees a temporary file alone.
"""

import os
import signal
import warnings
from concurrent.futures import ThreadPoolExecutor

import pytest

from sgwarp.apps.editing import operations as ops
from sgwarp.errors import InputError
from sgwarp.viewer import downloads

KINDS = ("scene.ply", "edits.json", "path.mp4")


@pytest.fixture
def saves(tab, stage, monkeypatch, tmp_path):
    """Each kind of save that needs a temporary file, which goes below `tmp_path`."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    tab.bench.apply("all", ops.Scale(1.1))
    keys = [view.camera for view in stage.views[:2]]
    return {
        "scene.ply": lambda: downloads.scene_file(tab.bench, plain=True),
        "edits.json": lambda: downloads.script_file(tab.bench),
        "path.mp4": lambda: downloads.video_file(tab.shot(), keys),
    }


@pytest.mark.parametrize("size", [0, 60])
@pytest.mark.parametrize("kind", KINDS)
def test_no_room(saves, disk, tmp_path, kind, size):
    """Said in a line that names the save; nothing is sent, nothing left; with room the same save is whole."""
    with disk(size), pytest.raises(InputError, match=rf"{kind}.*(File too large|frames are there|the disk is full)"):
        saves[kind]()
    assert os.listdir(tmp_path) == []
    assert len(saves[kind]()) > 60


@pytest.mark.parametrize("kind", KINDS)
def test_half_the_room(saves, disk, tmp_path, kind):
    """The disk is full in the middle of the file."""
    whole = saves[kind]()
    with (
        disk(len(whole) // 2),
        pytest.raises(InputError, match=rf"{kind}.*(File too large|frames are there|the disk is full)"),
    ):
        saves[kind]()
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("kind", KINDS)
def test_no_place(saves, monkeypatch, kind):
    monkeypatch.setattr("tempfile.tempdir", "/proc/1/nowhere")
    with pytest.raises(InputError, match=rf"{kind}: no temporary file can be written \(.*\); free some room or set"):
        saves[kind]()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.parametrize(("number", "left"), [(signal.SIGTERM, 0), (signal.SIGKILL, 1)])
def test_a_stop_in_a_save(saves, monkeypatch, tmp_path, number, left):
    """SIGTERM removes the temporary folder on its way out; after SIGKILL it stays in TMPDIR, as any program's does."""
    from sgwarp.runs.interrupt import termination_as_interrupt

    def stop(*_: object) -> None:
        os.kill(os.getpid(), number)

    monkeypatch.setattr(downloads, "save_script", stop)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        child = os.fork()
    if child == 0:
        try:
            with termination_as_interrupt():
                saves["edits.json"]()
        except KeyboardInterrupt:
            os._exit(143)
        os._exit(0)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert status == (143 if number == signal.SIGTERM else -signal.SIGKILL)
    assert len(os.listdir(tmp_path)) == left


def test_two_tabs_save_at_once(saves):
    """Each gets its own, whole."""
    with ThreadPoolExecutor(4) as pool:
        scenes = [pool.submit(saves["scene.ply"]) for _ in range(2)]
        scripts = [pool.submit(saves["edits.json"]) for _ in range(2)]
    alone = saves["scene.ply"](), saves["edits.json"]()
    assert {one.result() for one in scenes} == {alone[0]}
    assert {one.result() for one in scripts} == {alone[1]}
