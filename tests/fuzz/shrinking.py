"""Files that another process shortens while they are read: every reader gives what it has, or an InputError.

    python tests/fuzz/shrinking.py

Cuts the file of each pair, in place, at moments spread over the lines that its reader runs, then uses what was read. A
reader that maps its file ends this process with SIGBUS.
"""

import dataclasses
import os
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from fuzzer import all_readers, quiet

from sgwarp.errors import InputError

MOMENTS = 8  # at which each file is cut
PACKAGE = str(Path(sys.modules["sgwarp"].__file__ or "").parent)


def at_line(number: int, act: Callable[[], None], run: Callable[[], Any]) -> tuple[Any, int]:
    """What `run` gives, with `act` done before the given line of the package; and how many lines it ran."""
    seen = 0

    def line(frame: Any, event: str, _: Any) -> Any:
        nonlocal seen
        if event == "line":
            if seen == number:
                act()
            seen += 1
        return line

    def call(frame: Any, event: str, argument: Any) -> Any:
        return line if frame.f_code.co_filename.startswith(PACKAGE) else None

    sys.settrace(call)
    try:
        found = run()
    finally:
        sys.settrace(None)
    return found, seen


def use(value: Any) -> None:
    """Look at every number."""
    if isinstance(value, torch.Tensor):
        value.double().sum() if value.numel() and not value.is_complex() else None
    elif isinstance(value, np.ndarray):
        value.copy()
    elif isinstance(value, Mapping):
        for one in value.values():
            use(one)
    elif isinstance(value, (list, tuple)):
        for one in value:
            use(one)
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        for field in dataclasses.fields(value):
            use(getattr(value, field.name))


def main() -> int:
    quiet()
    counts, wrong = {"used": 0, "refused": 0}, 0
    with tempfile.TemporaryDirectory() as folder:
        for reader in all_readers(Path(folder)):
            if not reader.fits:
                continue
            original = reader.file.read_bytes()
            _, lines = at_line(-1, lambda: None, reader.read)
            for moment in sorted({lines * k // MOMENTS for k in range(MOMENTS)}):
                for size in {0, len(original) // 2}:

                    def cut(file: Path = reader.file, size: int = size) -> None:
                        os.truncate(file, size)

                    try:
                        use(at_line(moment, cut, reader.read)[0])
                        counts["used"] += 1
                    except InputError:
                        counts["refused"] += 1
                    except Exception as error:
                        wrong += 1
                        print(f"{reader.name}, cut to {size} at line {moment}: {error!r}")
                    reader.file.write_bytes(original)
    print(f"{counts['used']} used, {counts['refused']} refused, {wrong} wrong")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
