"""Lists and folders as people really have them: comments, marks of editors, other languages, results inside."""

import json
import os
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from sgwarp.cluster.listing import list_scenes
from sgwarp.cluster.records import Place, check_apart
from sgwarp.cluster.tasks import Outcome, Stage, Task
from sgwarp.cluster.working import settled, work
from sgwarp.errors import InputError


def test_a_table_from_a_spreadsheet(tmp_path):
    text = "\ufeff# scans of May\r\npath, name ,fit.steps\r\nscän 1/東京,tokyo,7\r\n# left out\r\n\r\n,,\r\n"
    (tmp_path / "list.CSV").write_bytes(text.encode())
    (scene,) = list_scenes(str(tmp_path / "list.CSV"))
    assert (scene.name, scene.path, scene.options) == ("tokyo", tmp_path / "scän 1" / "東京", {"fit.steps": "7"})


def test_a_text_file_of_windows(tmp_path):
    (tmp_path / "list.txt").write_bytes("\ufeff# scans\r\n'scän 1/東京' fit.steps=7\r\n\r\n".encode())
    (scene,) = list_scenes(str(tmp_path / "list.txt"))
    assert (scene.name, scene.path, scene.options) == ("東京", tmp_path / "scän 1" / "東京", {"fit.steps": "7"})


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("path,fit.steps,fit.steps\na,1,2\n", "column 'fit.steps' stands there twice"),
        ("", "no column 'path'"),
        ("# scans\npath,name\na,x\n,y\n", "line 4 has no path"),
        ("path,\na,5\n", "line 2 has a cell in a column without a name"),
        ("path,,fit.steps,\na,,7,\nb,,7,x\n", "line 3 has a cell in a column without a name"),
    ],
)
def test_bad_tables_are_refused(tmp_path, text, match):
    (tmp_path / "list.csv").write_text(text)
    with pytest.raises(InputError, match=match):
        list_scenes(str(tmp_path / "list.csv"))


def test_commas_at_the_end_name_no_columns(tmp_path):
    """A spreadsheet writes them where it once had more columns."""
    (tmp_path / "list.csv").write_text("path,fit.steps,,\na,7,,\n,,,\nb\n")
    assert [(scene.name, scene.options) for scene in list_scenes(str(tmp_path / "list.csv"))] == [
        ("a", {"fit.steps": "7"}),
        ("b", {}),
    ]


def test_a_name_too_long_for_a_folder_is_refused(tmp_path):
    (tmp_path / "list.csv").write_text(f"path,name\na,{'東' * 70}\n")
    with pytest.raises(InputError, match="cannot be the name"):
        list_scenes(str(tmp_path / "list.csv"))


@pytest.mark.parametrize("source", [".", "*"])
def test_the_folder_of_results_is_no_scene(tmp_path, monkeypatch, source):
    for name in ("a", "b", "results"):
        (tmp_path / name).mkdir()
    monkeypatch.chdir(tmp_path)
    assert [scene.name for scene in list_scenes(source, Path("results"))] == ["a", "b"]


def task(folder: Path, name: str, source: Path) -> Task:
    return Task(
        name, str(folder), (Stage("first", (str(source), "{out}", "0")),), (str(source),), "batch_runner:run", "r"
    )


def test_results_never_replace_what_they_are_made_from(tmp_path):
    photographs = tmp_path / "scans" / "one"
    photographs.mkdir(parents=True)
    with pytest.raises(InputError, match="its results would replace"):
        check_apart([task(tmp_path / "scans", "one", photographs)], tmp_path / "scans", {"one"})
    with pytest.raises(InputError, match="its results would replace"):
        check_apart([task(tmp_path / "scans", "two", photographs / "scene.ply")], tmp_path / "scans", {"one", "two"})
    with pytest.raises(InputError, match="which scene one reads"):
        check_apart([task(photographs / "results", "one", photographs)], photographs / "results", {"one"})
    os.symlink(photographs, tmp_path / "link")
    with pytest.raises(InputError, match="which scene one reads"):
        check_apart([task(tmp_path / "link", "one", photographs)], tmp_path / "link", {"one"})
    check_apart([task(tmp_path / "results", "one", photographs)], tmp_path / "results", {"one"})


def test_a_folder_that_no_batch_wrote_stays(batch):
    mine = batch.folder / "out" / "scene00"
    mine.mkdir(parents=True)
    (mine / "photograph.jpg").write_bytes(b"mine")
    first, second, *_ = batch.tasks()
    outcome = work(first)
    assert outcome.status == "failed"
    assert "is not replaced" in outcome.error
    assert sorted(path.name for path in mine.iterdir()) == ["photograph.jpg"]
    assert work(second).status == "done"


def test_what_a_kill_left_of_older_results_is_removed(batch):
    first = batch.tasks()[0]
    assert work(first).status == "done"
    old = Place(batch.folder / "out", "scene00").old
    old.mkdir()
    (old / "large.bin").write_bytes(b"old")
    assert settled(first) is None
    assert work(first).status == "skipped"
    assert not old.exists()


def test_a_scene_that_another_batch_works_on_is_no_failure(batch, monkeypatch):
    monkeypatch.setattr("sgwarp.cluster.records.WAIT", 0.2)
    first = batch.tasks()[0]
    with Place(batch.folder / "out", "scene00").locked():
        assert work(first).status == "held"
    assert not (batch.folder / "out" / "scene00").exists()
    assert work(first).status == "done"


def test_a_fault_of_one_scene_is_recorded(batch):
    first = batch.tasks()[0]
    values = first.to_json() | {"stages": [], "fault": "holds 0 scenes"}
    assert work(Task.from_json(values)) == Outcome("scene00", "failed", "holds 0 scenes")
    assert batch.record("scene00", "failed.json")["error"] == "holds 0 scenes"


def test_records_of_the_future_and_of_other_versions_hold(batch):
    """Clocks of machines differ, and packages are upgraded between two runs."""
    first = batch.tasks()[0]
    os.utime(batch.folder / "in" / "scene00" / "data.txt", (4e9, 4e9))
    assert work(first).status == "done"
    path = batch.folder / "out" / "scene00" / "done.json"
    record = json.loads(path.read_text())
    path.write_text(json.dumps(record | {"version": "99.0"}))
    assert work(first).status == "skipped"
    path.write_text(path.read_text()[:100])  # of a disk that was full
    assert work(first).status == "done"


def test_a_full_disk_fails_scenes_and_a_retry_does_them(batch):
    runner = batch.folder / "batch_runner.py"
    whole = runner.read_text()
    runner.write_text(whole.replace("    time.sleep(seconds)", "    raise OSError(28, 'No space left on device')"))
    first = batch.tasks()[0]
    assert work(first) == Outcome("scene00", "failed", "OSError: [Errno 28] No space left on device")
    assert not list((batch.folder / "out").rglob("*.bin"))
    runner.write_text(whole)
    del sys.modules["batch_runner"]
    assert work(first).status == "failed"
    assert work(replace(first, run="run 2", retry=True)).status == "done"
