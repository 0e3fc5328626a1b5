"""`--view` of commands that take long: what the viewer opens with, and what each later state changes in it."""

from types import SimpleNamespace

import pytest
import torch

from sgwarp.commands.demo import Demo
from sgwarp.commands.fit import Fit
from sgwarp.commands.lift import Lift
from sgwarp.lifting.lifter import lift


@pytest.fixture
def watched(stage, toy_text, monkeypatch):
    """`watched(name)`: how a command makes and updates its workbench, with the stage in the place of its scene."""
    noted = SimpleNamespace(encoders=[], room=None)

    def live(begin, update, address=None):
        return SimpleNamespace(begin=begin, update=update, address=address)

    def encoder(name, *arguments):
        noted.encoders.append((name, *arguments))
        return toy_text

    room = SimpleNamespace(gaussians=stage.gaussians, views=stage.views, to=lambda device: room)
    monkeypatch.setattr("sgwarp.viewer.live.Live", live)
    monkeypatch.setattr("sgwarp.encoders.registry.make_text_encoder", encoder)
    monkeypatch.setattr("sgwarp.encoders.registry.image_tower_for", lambda *arguments: ("tower", *arguments))
    monkeypatch.setattr("sgwarp.demo.data.Room.load", lambda: room)

    def of(name):
        if name == "fit":
            return Fit._live(stage.views), noted
        if name == "lift":
            options = {"scene": None, "views": None, "out": None}
            return Lift(**options)._live(stage.gaussians, stage.views), noted
        return Demo()._live(), noted

    return of


@pytest.mark.parametrize("name", ["lift", "demo"])
def test_a_later_state_of_a_lift_is_asked_and_leaves_the_scene(watched, stage, name):
    live, noted = watched(name)
    first, later = (lift(stage.gaussians, stage.views[:count], stage.dense) for count in (1, 3))
    bench = live.begin(first)
    assert bench.materials.gaussians is stage.gaussians
    assert bench.materials.views == stage.views
    assert bench.materials.semantics is first
    assert noted.encoders == [("conse", "cpu")]
    live.update(bench, later)
    assert bench.materials.gaussians is stage.gaussians
    assert all(part.semantics is later for part in (bench.materials, bench.session.context, bench.asker))


def test_lifted_labels_are_shown_without_an_encoder_of_phrases(watched, stage):
    live, noted = watched("lift")
    bench = live.begin(lift(stage.gaussians, stage.views[:1], stage.one_hot))
    assert noted.encoders == []
    assert bench.materials.encoder is None


def test_the_demo_takes_the_tower_of_its_space_for_clicks(watched, stage, toy_text):
    live, _ = watched("demo")
    bench = live.begin(lift(stage.gaussians, stage.views[:1], stage.dense))
    assert bench.materials.make_tower == ("tower", toy_text.space, "cpu")


def test_a_later_state_of_a_fit_is_another_scene(watched, stage):
    live, _ = watched("fit")
    first, later = (stage.gaussians.subset(torch.arange(count)) for count in (50, 80))
    bench = live.begin(first)
    assert (bench.materials.gaussians is first, bench.materials.views) == (True, stage.views)
    live.update(bench, later)
    assert bench.materials.gaussians is later
    assert len(bench.session.state.gaussians) == 80
