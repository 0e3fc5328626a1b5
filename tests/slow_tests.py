"""Which tests the inner loop leaves out: those that slow_tests.txt names, measured and not guessed.

`make slow-tests` measures the others and adds what is slow. A test function counts with all its parameters, so that the
list does not change with a parameter's name.
"""

import re
from collections import defaultdict
from pathlib import Path

import pytest

LIST = Path(__file__).with_name("slow_tests.txt")
LONGEST = 0.4  # seconds that one of the function's tests may take, set-up included
LONGEST_OF_ALL = 1.2  # seconds of all of them


def function_of(node_id: str) -> str:
    return re.sub(r"\[.*", "", node_id)


def listed() -> set[str]:
    return set(LIST.read_text().split())


def mark(items: list[pytest.Item]) -> None:
    """Mark what the list names as slow."""
    slow = listed()
    for item in items:
        if function_of(item.nodeid) in slow:
            item.add_marker("slow")


class Recorder:
    """Adds up what each test takes, and at the end adds the slow ones to the list."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.seconds[report.nodeid] += report.duration

    def slow(self) -> set[str]:
        longest: dict[str, float] = defaultdict(float)
        total: dict[str, float] = defaultdict(float)
        for node_id, seconds in self.seconds.items():
            name = function_of(node_id)
            longest[name] = max(longest[name], seconds)
            total[name] += seconds
        return {name for name in total if longest[name] > LONGEST or total[name] > LONGEST_OF_ALL}

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        if hasattr(session.config, "workerinput"):
            return
        root = LIST.parent.parent
        kept = {name for name in listed() if (root / name.split("::")[0]).is_file()}
        LIST.write_text("\n".join(sorted(kept | self.slow())) + "\n")
