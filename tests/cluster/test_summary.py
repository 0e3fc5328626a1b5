"""The table of many scenes: medians, the worst, and who failed."""

import pytest

from sgwarp.cluster.summary import SHOWN, duration, table
from sgwarp.cluster.tasks import Outcome


def done(name: str, seconds: float) -> Outcome:
    return Outcome(name, "done", "", {"fit": seconds, "lift": 0.5})


@pytest.mark.parametrize(
    ("seconds", "middle", "most"),
    [((3.0,), "3.00", "3.00"), ((9.0, 1.0, 2.0), "2.00", "9.00"), ((5.0, 1.0, 30.0, 2.0, 4.0), "4.00", "30.00")],
)
def test_seconds_of_a_stage(seconds, middle, most):
    lines = table([done(str(number), value) for number, value in enumerate(seconds)]).splitlines()
    assert lines[0] == f"{len(seconds)} done, 0 skipped, 0 failed scenes"
    assert f"  fit: {middle} s per scene (median), {most} s at most" in lines
    assert "  lift: 0.50 s per scene (median), 0.50 s at most" in lines


@pytest.mark.parametrize("count", [0, 1, SHOWN, SHOWN + 1, SHOWN + 7])
def test_so_many_failures_are_named_and_the_rest_counted(count):
    outcomes = [Outcome(f"s{number:02d}", "failed", f"reason {number}") for number in reversed(range(count))]
    lines = table([done("fine", 1.0), *outcomes]).splitlines()
    named = [line for line in lines if "reason" in line]
    assert named == [f"  s{number:02d}: reason {number}" for number in range(min(count, SHOWN))]
    rest = [line for line in lines if "more that failed" in line]
    assert rest == ([f"  and {count - SHOWN} more that failed"] if count > SHOWN else [])


@pytest.mark.parametrize(("seconds", "text"), [(0.4, "0:00:00"), (59.6, "0:01:00"), (3725.0, "1:02:05")])
def test_durations(seconds, text):
    assert duration(seconds) == text
