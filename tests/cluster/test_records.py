"""Locks, clocks and folders at work of one scene, without worker processes."""

import json
import signal

import pytest

from sgwarp.cluster import records
from sgwarp.cluster.records import FAILED, STAGES, Place, read_json
from sgwarp.cluster.tasks import Limits, Task
from sgwarp.cluster.watching import watched
from sgwarp.cluster.working import work
from sgwarp.errors import InputError


def test_a_scene_has_one_worker(tmp_path, monkeypatch):
    monkeypatch.setattr(records, "WAIT", 0.3)
    place = Place(tmp_path, "scene")
    with place.locked(), pytest.raises(InputError, match="another process works on it"), place.locked():
        pass
    with place.locked():  # it is free again
        pass


def test_the_clock_of_a_scene_stops_with_it():
    """The alarm would end the worker in the middle of a later scene."""
    with watched(Limits(seconds=3600.0), print):
        assert signal.getitimer(signal.ITIMER_REAL)[0] > 3600
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


@pytest.mark.parametrize("record", [None, "damaged", "[]"])
def test_what_a_killed_process_left_without_a_record_is_removed(batch, record):
    """Nothing says which options the files were made with."""
    task = batch.tasks()[0]
    place = Place(batch.folder / "out", task.name)
    place.partial.mkdir(parents=True)
    (place.partial / "old.bin").write_bytes(b"of other options")
    if record is not None:
        (place.partial / STAGES).write_text(record)
    assert work(task).status == "done"
    assert not (place.final / "old.bin").exists()
    assert list(json.loads((place.final / "done.json").read_text())["seconds"]) == ["first", "second"]


def test_an_endless_error_is_recorded_in_part(tmp_path):
    """A library may print a whole array into its message; a table of scenes has a line for each."""
    outcome = work(Task("a", str(tmp_path), (), (), "none:none", "1", fault="no room: " + "x" * 5000))
    assert outcome.status == "failed"
    assert outcome.error == "no room: " + "x" * 991
    assert read_json(Place(tmp_path, "a").final / FAILED)["error"] == outcome.error
