"""A short run of the fuzzer, and the files that it has found over the years."""

import base64
import gc
import json
import os
import random
import signal
import subprocess
import sys
from pathlib import Path

import pytest

CORPUS = json.loads((Path(__file__).with_name("corpus.json")).read_text())
SECONDS = 10.0


@pytest.fixture(scope="module")
def pairs(tmp_path_factory):
    import fuzzer

    made = fuzzer.all_readers(tmp_path_factory.mktemp("fuzz"))
    fuzzer.require_good(made)
    return made


@pytest.fixture
def alarm():
    """The fuzzer's handlers of signals, taken back afterwards."""
    import fuzzer

    before = [signal.signal(number, fuzzer._ring) for number in (signal.SIGALRM, signal.SIGPROF)]
    yield fuzzer
    for number, handler in zip((signal.SIGALRM, signal.SIGPROF), before, strict=True):
        signal.signal(number, handler)


@pytest.mark.filterwarnings("ignore")
def test_nothing_but_input_errors(pairs, alarm):
    """The rule, on as many inputs as ten seconds allow; `make fuzz` runs a million."""
    before = random.getstate()
    results = alarm.fuzz(pairs, 10**6, SECONDS, seed=0)
    bad = {
        name: {what: n for what, n in counts.items() if what not in ("read", "refused")}
        for name, counts in results.items()
    }
    assert not {name: found for name, found in bad.items() if found}
    assert min(counts.total() for counts in results.values()) > 3
    assert random.getstate() == before


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("number", range(len(CORPUS)))
def test_what_was_found_stays_mended(pairs, alarm, number):
    entry = CORPUS[number]
    reader = next(reader for reader in pairs if reader.name == entry["reader"])
    original = reader.file.read_bytes()
    try:
        assert alarm.check(reader, base64.b64decode(entry["file"]), alarm.Memory()) in ("read", "refused")
    finally:
        reader.file.write_bytes(original)


@pytest.mark.slow
def test_a_file_that_is_shortened_while_it_is_read():
    """In place, by another process; a reader that maps its file would end this one with SIGBUS."""
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run(
        [sys.executable, Path(__file__).with_name("shrinking.py")],
        env={**os.environ, "PYTHONPATH": str(root)}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    used, refused = (int(part.split()[0]) for part in done.stdout.splitlines()[-1].split(",")[:2])
    assert min(used, refused) > 100


def test_the_fuzzer_sees_what_is_wrong(tmp_path, alarm):
    """Each fault that it looks for, made on purpose."""
    from fuzz_readers import Reader

    from sgwarp.errors import InputError

    kept = []

    def raw():
        raise KeyError("x")

    def slow():
        while True:
            pass

    def greedy():
        kept.append(bytearray(b"x") * (200 * 2**20))

    def unclear():
        error = InputError("x")
        error.args = ("two\nlines",)
        raise error

    def refused():
        raise InputError("x")

    for read, wanted in (
        (raw, "KeyError in test_fuzz"),
        (slow, "took over 2 s"),
        (unclear, "a message"),
        (refused, "refused"),
    ):
        assert alarm.check(Reader("a", tmp_path / "a", read), b"x").startswith(wanted)
    memory = alarm.Memory()
    gc.collect()  # what earlier tests left behind is not to be given back while the peak is taken
    if memory.able:
        assert alarm.check(Reader("a", tmp_path / "a", greedy), b"x", memory) == "took over 192 MB"
