"""What `sgwarp batch` tells its workers: limits in their units, threads, whose options win. Nothing is run here."""

from pathlib import Path

import pytest

from sgwarp.cluster.listing import Scene
from sgwarp.cluster.tasks import Limits
from sgwarp.commands.batch import Batch
from sgwarp.commands.scene_stages import Plan, stages_of


@pytest.fixture
def tasks(stage_files, tmp_path):
    """`tasks(**options)` of a batch of one scene."""

    def make(scene_options=(), **options):
        batch = Batch(scenes="list", do="lift", out=tmp_path / "out", **options)
        return batch._tasks([Scene("one", stage_files.scene, dict(scene_options))])

    return make


@pytest.mark.parametrize(
    ("options", "limits"),
    [
        ({}, Limits(None, None)),
        ({"time_limit": 90.0}, Limits(90.0, None)),
        ({"memory_limit": 1.5}, Limits(None, 1_500_000_000)),
        ({"time_limit": 0.5, "memory_limit": 0.3}, Limits(0.5, 300_000_000)),
    ],
)
def test_limits_are_seconds_and_bytes(tasks, options, limits):
    (task,) = tasks(**options)
    assert task.limits == limits


def test_how_it_is_run_does_not_belong_to_the_results(tasks, tmp_path):
    """Threads, the folder and retries are no options of the stage: other ones do not do a scene again."""
    (plain,), (other,) = tasks(threads=1), tasks(threads=3, retry_failed=True)
    assert (plain.common, other.common) == (("--threads", "1"), ("--threads", "3"))
    assert (plain.retry, other.retry) == (False, True)
    assert plain.options == other.options
    assert Path(plain.folder) == tmp_path / "out"
    assert plain.run != other.run  # what failed in one start is tried again in the next


@pytest.mark.parametrize(
    ("plan", "scene", "tau"),
    [
        ({"tau": "0.1"}, {}, "0.1"),
        ({"tau": "0.1"}, {"tau": "0.2"}, "0.2"),
        ({"lift.tau": "0.1"}, {"lift.tau": "0.2"}, "0.2"),
        ({"tau": "0.1", "lift.tau": "0.3"}, {}, "0.3"),
        ({"lift.tau": "0.1"}, {"tau": "0.2"}, "0.1"),  # what names the stage goes before what names the option alone
        ({"tau": "0.1"}, {"tau": "0.2", "lift.tau": "0.4"}, "0.4"),
    ],
)
def test_whose_option_wins(stage_files, plan, scene, tau):
    (stage,), _ = stages_of(Scene("one", stage_files.scene, scene), Plan(("lift",), {"border": "3", **plan}, "cpu"))
    words = dict(zip(stage.arguments[1::2], stage.arguments[2::2], strict=True))
    assert (words["--tau"], words["--border"]) == (tau, "3")


@pytest.mark.parametrize(
    ("workers", "threads", "cores", "each"), [(1, None, 8, 8), (3, None, 8, 2), (9, None, 8, 1), (2, 5, 8, 5)]
)
def test_threads_of_a_worker(tasks, monkeypatch, workers, threads, cores, each):
    monkeypatch.setattr("os.sched_getaffinity", lambda process: set(range(cores)), raising=False)
    (task,) = tasks(workers=workers, threads=threads)
    assert task.common == ("--threads", str(each))
