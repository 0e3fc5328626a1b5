"""Faults under `evaluate`: a disk that is full at any write, a stop or a kill in any write, two runs of one output."""

import errno
import json
import os
import signal
import warnings
from pathlib import Path

import pytest

from sgwarp.cli import main
from sgwarp.datasets.synthetic import make_room
from sgwarp.datasets.synthetic_files import save_room
from sgwarp.files import atomic

SCENES = ("hall", "study")


@pytest.fixture(scope="module")
def rooms(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("rooms")
    for seed, name in enumerate(SCENES):
        save_room(make_room(seed=seed, count=200), root / name, views=4, width=32, height=24)
    return root


def evaluate(rooms: Path, out: Path) -> int:
    words = ["evaluate", "room", "--data", rooms, "--out", out, "--encoder", "truth", "--sheets", "1"]
    return main([str(word) for word in words])


def figures(out: Path) -> dict:
    """What a run found: of every scene, and in all."""
    scenes = {name: json.loads((out / "scenes" / name / "result.json").read_text())["result"] for name in SCENES}
    found = {name: {key: one[key] for key in ("figures", "per_class", "confusion")} for name, one in scenes.items()}
    results = json.loads((out / "results.json").read_text())
    return found | {"all": results["figures"]}


def rests(out: Path) -> list[Path]:
    return [path for path in out.rglob(".*") if path.is_file()]


@pytest.fixture(scope="module")
def whole(rooms, tmp_path_factory):
    """An undisturbed run: its figures, and how many files it writes."""
    out, flushed, flush = tmp_path_factory.mktemp("whole") / "out", [], atomic._flush
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(atomic, "_flush", lambda path: (flushed.append(path), flush(path)))
        assert evaluate(rooms, out) == 0
    assert len(flushed) > 6
    return figures(out), len(flushed)


def at_write(number: int, act) -> pytest.MonkeyPatch:
    """From now on the write of that number, counted from 0, does `act` before it takes its name."""
    patch, flush, seen = pytest.MonkeyPatch(), atomic._flush, []

    def counted(path):
        seen.append(path)
        if len(seen) == number + 1:
            act()
        flush(path)

    patch.setattr(atomic, "_flush", counted)
    return patch


def full() -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.slow
def test_a_disk_that_is_full_at_any_write(rooms, whole, tmp_path, capsys):
    """One line says which file, nothing is left of it, and with room the run goes on to the same figures."""
    wanted, writes = whole
    for number in range(writes):
        out = tmp_path / str(number)
        patch = at_write(number, full)
        try:
            code = evaluate(rooms, out)
        finally:
            patch.undo()
        printed = capsys.readouterr()
        assert code in (1, 2), number  # 1: one scene of two could not be written
        lines = [line for line in (printed.out + printed.err).splitlines() if "No space left on device" in line]
        assert lines, number
        assert all(str(out) in line and "make room" in line for line in lines)
        assert rests(out) == []
        assert evaluate(rooms, out) == 0
        assert figures(out) == wanted


@pytest.mark.slow
def test_sigterm_in_any_write(rooms, whole, tmp_path):
    wanted, writes = whole
    for number in range(0, writes, 2):
        out = tmp_path / str(number)
        patch = at_write(number, lambda: os.kill(os.getpid(), signal.SIGTERM))
        try:
            assert evaluate(rooms, out) == 143
        finally:
            patch.undo()
        assert rests(out) == []
        assert evaluate(rooms, out) == 0
        assert figures(out) == wanted


def forked(run) -> int:
    """A process that runs it and ends."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # the threads of torch, which the child makes anew
        child = os.fork()
    if child == 0:
        code = 99
        try:
            code = run()
        finally:
            os._exit(code)
    return child


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_kill_in_any_write(rooms, whole, tmp_path):
    """The half file stays until the next run, which removes it and ends with the same figures."""
    wanted, writes = whole
    for number in range(1, writes, 2):
        out = tmp_path / str(number)
        patch = at_write(number, lambda: os.kill(os.getpid(), signal.SIGKILL))
        try:
            _, status = os.waitpid(forked(lambda out=out: evaluate(rooms, out)), 0)
        finally:
            patch.undo()
        assert os.WIFSIGNALED(status)
        assert len(rests(out)) == 1
        assert evaluate(rooms, out) == 0
        assert figures(out) == wanted
        assert rests(out) == []


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_two_runs_of_one_output(rooms, whole, tmp_path):
    """Neither ends in a traceback; what is there is whole, and another run completes it."""
    out = tmp_path / "out"
    children = [forked(lambda: evaluate(rooms, out)) for _ in range(2)]
    codes = [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children]
    assert set(codes) <= {0, 1, 2}
    for path in out.rglob("*.json"):
        json.loads(path.read_text())
    assert evaluate(rooms, out) == 0
    assert figures(out) == whole[0]
    assert rests(out) == []


@pytest.mark.parametrize("blocked", ["out", "out/scenes", "out/results.json"])
def test_a_place_that_refuses(rooms, tmp_path, capsys, blocked):
    """A file where a folder should be, or a folder where a file should be."""
    place = tmp_path / blocked
    place.parent.mkdir(parents=True, exist_ok=True)
    place.mkdir() if place.suffix else place.write_text("here first")
    assert evaluate(rooms, tmp_path / "out") == 2
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert last.startswith("sgwarp: ")
    assert str(place) in last
    assert place.is_dir() if place.suffix else place.read_text() == "here first"
