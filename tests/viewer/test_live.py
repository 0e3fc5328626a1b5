"""What a long run shows while it goes on."""

import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.io.views import load_views
from sgwarp.lifting.lifter import lift
from sgwarp.reconstruction.fitting.settings import FitSettings
from sgwarp.reconstruction.fitting.trainer import fit
from sgwarp.runs.log import RunLog
from sgwarp.viewer import live as module
from sgwarp.viewer.live import Live
from sgwarp.viewer.server import Address


@pytest.mark.slow
def test_a_lift_shows_the_mean_of_the_views_so_far(stage):
    states, order = [], []

    def encode(view):
        order.append(view)
        return stage.dense(view)

    whole = lift(stage.gaussians, stage.views, encode, log=RunLog(watch=lambda make: states.append(make())))
    assert len(states) == len(stage.views) + 1
    for count in (1, 3):
        alone = lift(stage.gaussians, order[:count], {view.stem: stage.dense(view) for view in order[:count]})
        torch.testing.assert_close(states[count - 1].weight, alone.weight)
        torch.testing.assert_close(states[count - 1].features, alone.features)
    assert torch.equal(states[-1].features, whole.features)
    assert torch.equal(states[-2].features, whole.features)


def test_a_watched_lift_and_an_unwatched_one_are_the_same(stage):
    watched = lift(stage.gaussians, stage.views, stage.dense, log=RunLog(watch=lambda make: make()))
    alone = lift(stage.gaussians, stage.views, stage.dense)
    assert torch.equal(watched.features, alone.features)


def test_a_fit_shows_the_scene_as_it_grows(stage_files):
    views, states = load_views(stage_files.views), []
    settings = FitSettings(steps=20, cap=5000, sh_degree=0)
    log = RunLog(watch=lambda make: states.append(make()))
    fitted = fit(views, stage_files.gaussians, settings=settings, log=log)
    assert len(states) == 4  # steps 0, 10 and 20, and the result
    assert torch.equal(states[-1].means, fitted.gaussians.means)
    first = states[0]
    assert len(first) == len(stage_files.gaussians)
    torch.testing.assert_close(first.means, stage_files.gaussians.means, rtol=0, atol=1e-5)
    assert not torch.equal(states[1].means[: len(first)], first.means)


def test_watching_is_not_written(tmp_path):
    import json

    log = RunLog(watch=lambda make: None)
    log.write(tmp_path)
    assert "watch" not in json.loads((tmp_path / "run.json").read_text())


class Shown:
    """In place of a viewer."""

    def __init__(self, bench):
        self.bench, self.waited, self.closed = bench, False, False

    def wait(self):
        self.waited = True
        raise KeyboardInterrupt

    def close(self):
        self.closed = True


@pytest.fixture
def clock(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(module, "open_viewer", lambda bench, address: Shown(bench))
    return now


def test_states_are_shown_at_most_once_a_second_and_the_last_one_surely(clock):
    seen = []
    live = Live(lambda state: seen.append(("begin", state)), lambda bench, state: seen.append(("update", state)))

    def watch(number):
        live.watch(lambda: number)

    watch(1)
    watch(2)
    clock[0] += 0.5
    watch(3)
    assert seen == [("begin", 1)]
    clock[0] += 0.6
    watch(4)
    watch(5)
    assert seen[1:] == [("update", 4)]
    live.finish()
    assert seen[2:] == [("update", 5)]
    assert (live.viewer.waited, live.viewer.closed) == (True, True)


def test_the_viewer_listens_where_it_is_told(clock, monkeypatch):
    addresses = []
    monkeypatch.setattr(module, "open_viewer", lambda bench, address: addresses.append(address) or Shown(bench))
    live = Live(lambda state: state, lambda bench, state: None, Address(port=1234))
    live.watch(lambda: 1)
    assert addresses == [Address(port=1234)]


def test_slow_copies_are_made_less_often(clock):
    def slow(number):
        clock[0] += 1.0
        return number

    seen = []
    live = Live(seen.append, lambda bench, state: seen.append(state))
    for number in range(100):
        live.watch(lambda number=number: slow(number))
        clock[0] += 1.0
    assert len(seen) <= 6  # five hundredths of a hundred seconds


def test_a_state_that_is_none_is_passed_over(clock):
    def nothing():
        raise InputError("no view sees any Gaussian")

    seen = []
    live = Live(seen.append, lambda bench, state: None)
    live.watch(nothing)
    assert live.viewer is None
    live.watch(lambda: 1)
    assert seen == [1]


def test_without_viser_a_run_ends_before_it_begins(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match=r"sgwarp\[viewer\]"):
        Live(lambda state: None, lambda bench, state: None)
