"""run.json and the progress display."""

import io
import json
import math
import sys
import time
from contextlib import contextmanager

import pytest

from sgwarp.runs.log import RunLog
from sgwarp.runs.progress import show_progress
from sgwarp.version import __version__

KEYS = ["command", "version", "device", "threads", "stages", "left_out", "error", "outputs"]


def test_where_the_results_lie():
    log = RunLog()
    assert log.where() == ""
    log.outputs += ["out/scene.ply", "out/scene.ops.json", *(f"out/maps/{number:04d}.png" for number in range(60))]
    assert log.where() == "wrote out/scene.ply, out/scene.ops.json, 60 files in out/maps"


def test_the_file_holds_exactly_the_agreed_keys(tmp_path, monkeypatch):
    clock = [100.0]
    monkeypatch.setattr(time, "perf_counter", lambda: clock[0])
    log = RunLog(command="sgwarp lift a.ply", device="cpu", threads=2)
    with log.stage("read"):
        clock[0] += 0.25
    with log.stage("read"):
        clock[0] += 0.25
    log.leave_out("views", 3)
    log.leave_out("views")
    log.leave_out("nothing", 0)
    log.error["coverage"] = 0.5
    log.error["residual"] = math.nan
    log.outputs.append("s.safetensors")
    path = log.write(tmp_path / "new")
    record = json.loads(path.read_text())
    assert path == tmp_path / "new" / "run.json"
    assert list(record) == KEYS
    assert record["version"] == __version__
    assert record["left_out"] == {"views": 4}
    assert record["error"] == {"coverage": 0.5, "residual": None}
    assert record["stages"] == {"read": 0.5}
    assert [p.name for p in path.parent.iterdir()] == ["run.json"]


def test_a_stage_that_fails_is_timed_too():
    log = RunLog()
    with pytest.raises(ValueError, match="no"), log.stage("lift"):
        raise ValueError("no")
    assert "lift" in log.stages


def test_summary_sets_time_beside_error():
    log = RunLog(stages={"lift": 1.25}, error={"coverage": 0.5}, left_out={"views_without_map": 2})
    assert log.summary() == "lift 1.25 s; coverage 0.5000; left out: 2 views without map"
    assert RunLog().summary() == ""


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_a_log_file_stays_almost_empty(monkeypatch):
    stream = io.StringIO()
    with show_progress("lift", stream) as report:
        for done in range(100):
            report(done, 100, "0001")
    assert stream.getvalue() == ""

    clock = iter([0.0, *(k * 20.0 for k in range(1, 1000))])
    monkeypatch.setattr(time, "monotonic", lambda: next(clock))
    with show_progress("lift", stream) as report:
        for done in range(6):
            report(done, 6, f"{done:04d}")
    lines = stream.getvalue().splitlines()
    assert 1 <= len(lines) < 6
    assert all(line.startswith("lift ") and "/6" in line for line in lines)


def test_a_terminal_gets_a_bar_that_goes_away():
    stream = Terminal()
    with show_progress("lift", stream) as report:
        report(0, 2, "")
        report(2, 2, "0001")
    assert "lift" in stream.getvalue()


def test_without_rich_a_terminal_gets_a_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "rich.console", None)
    stream = Terminal()
    with show_progress("lift", stream) as report:
        report(1, 2, "a long name")
        report(2, 2, "b")
    written = stream.getvalue()
    assert "\rlift 1/2 a long name" in written
    assert written.split("\r")[2] == "lift 2/2 b".ljust(len("lift 1/2 a long name"))  # covers the longer line
    assert written.endswith("\r")
    assert "\n" not in written


def test_a_log_shows_nothing_unless_it_is_told_how(tmp_path, capsys):
    shown = []

    @contextmanager
    def show(title):
        yield lambda done, total, name: shown.append((title, done, total, name))

    for log in (RunLog(), RunLog(show=show)):
        with log.show("lift") as report:
            report(1, 2, "a")
        assert "show" not in json.loads(log.write(tmp_path).read_text())
    assert shown == [("lift", 1, 2, "a")]
    assert capsys.readouterr() == ("", "")
