"""Mutated files against every reader: nothing but InputError, within 2 seconds and the memory rule.

    python tests/fuzz/fuzzer.py --inputs 1000000 --keep findings/

prints a table and exits with 1 if anything was found; what was found lies in `findings/`, to become a part of the
corpus. Seconds are those of the processor, for others may use the machine, too.
The memory rule: four times the file plus 64 MB, measured as the peak of the resident set over what it was before; and
no single reservation beyond SPACE, which the address space is limited to.
"""

import argparse
import gc
import logging
import os
import random
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
from fuzz_formats import more_readers
from fuzz_mutations import mutate
from fuzz_readers import Reader, readers

from sgwarp.errors import InputError

SECONDS = 2.0
WAITING = 20.0  # by the clock: what waits uses no processor
MEGABYTE = 2**20
ALLOWED, FACTOR = 64 * MEGABYTE, 4
SPACE = 1024 * MEGABYTE  # of addresses beyond those in use
LARGEST_INPUT = MEGABYTE


class TooSlowError(BaseException):
    """The alarm; no `except Exception` of a library catches it."""


def _ring(number, frame):
    raise TooSlowError


class Memory:
    """Peak of the resident set, which Linux can set back; without that, nothing is measured."""

    def __init__(self) -> None:
        self.reset_file = Path("/proc/self/clear_refs")
        self.able = self.reset_file.exists()

    def reset(self) -> int:
        if not self.able:
            return 0
        self.reset_file.write_text("5")
        return self._read("VmRSS")

    def peak(self) -> int:
        return self._read("VmHWM") if self.able else 0

    @staticmethod
    def _read(key: str) -> int:
        with open("/proc/self/status", "rb") as file:
            for line in file:
                if line.startswith(key.encode()):
                    return int(line.split()[1]) * 1024
        return 0


def limit_addresses() -> None:
    """No reservation beyond SPACE: it fails instead of being granted and never used."""
    with open("/proc/self/statm") as file:
        used = int(file.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + SPACE, resource.RLIM_INFINITY))


def check(reader: Reader, data: bytes, memory: Memory | None = None) -> str:
    """What a reader makes of a file: "read", "refused", or what is wrong."""
    reader.file.write_bytes(data)
    before = memory.reset() if memory else 0
    began = time.process_time()
    signal.setitimer(signal.ITIMER_PROF, SECONDS)  # of the processor: others may use the machine, too
    signal.setitimer(signal.ITIMER_REAL, WAITING)
    try:
        reader.read()
        result = "read"
    except InputError as error:
        message = str(error)
        result = "refused" if message.isprintable() and message else "a message that is not one line"
    except TooSlowError:
        return "took over 2 s"
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        return f"{type(error).__name__} in {Path(where.filename).name}:{where.lineno}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.setitimer(signal.ITIMER_REAL, 0)
    if time.process_time() - began > SECONDS:
        return "took over 2 s"
    taken = memory.peak() - before if memory else 0
    if taken > ALLOWED + FACTOR * len(data):
        return f"took over {taken // MEGABYTE // 64 * 64} MB"
    return result


def fuzz(pairs, inputs: int, seconds: float, seed: int, keep: Path | None = None, every: float = 60.0):
    """Mutate the files of all pairs in turn; returns counts by reader and result."""
    originals = {reader.name: reader.file.read_bytes() for reader in pairs}
    results: dict[str, Counter] = {reader.name: Counter() for reader in pairs}
    memory = Memory()
    signal.signal(signal.SIGALRM, _ring)
    signal.signal(signal.SIGPROF, _ring)
    began = told = time.monotonic()
    for number in range(inputs):
        if time.monotonic() - began > seconds:
            break
        reader = pairs[number % len(pairs)]
        data = mutate(originals[reader.name], random.Random(f"{seed} {number}"))[:LARGEST_INPUT]
        result = check(reader, data, memory)
        results[reader.name][result] += 1
        if result not in ("read", "refused") and keep is not None:
            keep.mkdir(parents=True, exist_ok=True)
            (keep / f"{reader.name.replace(' ', '_')}-{number}").write_bytes(data)
            print(f"{reader.name}, input {number}: {result}", flush=True)
        reader.file.write_bytes(originals[reader.name])  # other readers may need it
        if number % (len(pairs) * 50) == 0:
            gc.collect()
        if time.monotonic() - told > every:
            told = time.monotonic()
            print(f"{number + 1} inputs, {time.monotonic() - began:.0f} s", flush=True)
    return results


def table(results) -> str:
    rows = ["| reader | inputs | read | refused | anything else |", "| --- | ---: | ---: | ---: | --- |"]
    total: Counter = Counter()
    for name, counts in results.items():
        total.update(counts)
        rows.append(_row(name, counts))
    return "\n".join([*rows, _row("all", total)])


def _row(name: str, counts: Counter) -> str:
    rest = {what: count for what, count in counts.items() if what not in ("read", "refused")}
    text = ", ".join(f"{count} x {what}" for what, count in sorted(rest.items())) or "0"
    return f"| {name} | {counts.total():,} | {counts['read']:,} | {counts['refused']:,} | {text} |"


def all_readers(folder: Path) -> list[Reader]:
    """Every pair of reader and file, with the files below `folder`."""
    return readers(folder / "first") + more_readers(folder / "more")


def require_good(pairs) -> None:
    """Every file is good before it is changed, or the fuzzer would only see how it is refused."""
    for reader in pairs:
        try:
            reader.read()
            refusal = None
        except InputError as error:
            refusal = error
        assert (refusal is None) == reader.fits, f"{reader.name}: {refusal}"


def quiet() -> None:
    logging.getLogger("sgwarp").setLevel(logging.ERROR)
    warnings.simplefilter("ignore")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--inputs", type=int, default=1_000_000)
    parser.add_argument("--seconds", type=float, default=float("inf"))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, default=None, help="folder for what was found")
    parser.add_argument("--only", default="", help="readers whose name contains this")
    options = parser.parse_args()
    quiet()
    base = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    with tempfile.TemporaryDirectory(dir=base) as folder:
        pairs = [reader for reader in all_readers(Path(folder)) if options.only in reader.name]
        require_good(pairs)
        limit_addresses()
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # image codecs tell stderr about every fault
        results = fuzz(pairs, options.inputs, options.seconds, options.seed, options.keep)
    print(table(results))
    bad = sum(count for counts in results.values() for what, count in counts.items() if what not in ("read", "refused"))
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
