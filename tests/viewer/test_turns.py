"""Whose turn it is among tabs, which term names a selection, and what a page turns about."""

from types import SimpleNamespace

import pytest
import torch

from sgwarp.apps.editing.selection import Selection
from sgwarp.scene import Camera, Gaussians, Instance, InstanceMap, View
from sgwarp.viewer.pace import STILL
from sgwarp.viewer.server import Viewer
from sgwarp.viewer.streaming import Stream, Streamer
from sgwarp.viewer.workbench import Materials, Workbench


def wanting(name: str, busy: bool = False) -> Stream:
    """A tab whose camera has stood still for long, and that has no picture yet."""
    stream = Stream(SimpleNamespace(busy=busy, name=name), lambda: None, camera="somewhere", moved_at=0.0)
    stream.wanted = 1
    return stream


@pytest.mark.parametrize(
    ("tabs", "order"),
    [("abc", "abcabc"), ("aBc", "acacac"), ("Ab", "bbbb"), ("a", "aaa")],  # a capital one takes no pictures
)
def test_tabs_that_always_want_a_picture_take_turns(tabs, order):
    streamer = Streamer(clock=lambda: STILL + 1.0)
    for name in tabs:
        streamer.add(wanting(name.lower(), name.isupper()))
    assert "".join(streamer._next()[0].screen.name for _ in order) == order


def line_of(places) -> Gaussians:
    means = torch.nn.functional.pad(torch.tensor(places, dtype=torch.float32)[:, None], (0, 2))
    count = len(means)
    quats = torch.tensor([1.0, 0, 0, 0]).expand(count, 4)
    return Gaussians(means, quats, torch.full((count, 3), 0.1), torch.ones(count), torch.zeros(count, 1, 3))


def test_a_whole_instance_is_named_by_its_number_however_scattered_it_is():
    """Thirty Gaussians in a row and two far away: none of them is left out, and the term is the shortest."""
    gaussians = line_of([0.1 * k for k in range(30)] + [50.0, 50.1] + [90.0, 90.1])
    zero = (0.0, 0.0, 0.0)
    table = (Instance(1, "default", 0, 32, 1, 1, 1.0, zero, (1.0, 0.0, 0.0, 0.0), zero),)
    ids = (torch.arange(34) < 32).to(torch.int32)[None, :, None]
    found = InstanceMap(ids, torch.ones(1, 34, 1), torch.full((34,), 9.0), table, ("default",), gaussians.fingerprint)
    bench = Workbench(Materials(gaussians, instances=found))
    members = torch.arange(34) < 32
    assert bench.term_of(members, 1) == "id:1"
    assert torch.equal(bench.session.preview(Selection(("id:1",), clean=False)), members)
    fewer = members & (torch.arange(34) != 3)
    assert bench.term_of(fewer, 1) == "rows:0-2,4-31"
    assert bench.term_of(members) == "rows:0-31"


@pytest.mark.parametrize(
    ("middle", "ahead"),
    [(6.0, 6.0), (0.5, 0.5), (-3.0, 0.1), (0.0, 0.1)],  # never behind the camera, nor at it: ten near planes
)
def test_an_orbit_turns_about_the_middle_of_the_scene_ahead_of_the_camera(middle, ahead):
    means = torch.tensor([[0.0, 0.0, middle]] * 5 + [[100.0, 0.0, middle]] * 2)
    gaussians = line_of([0.0] * 7)
    gaussians = Gaussians(means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    bench = SimpleNamespace(materials=SimpleNamespace(gaussians=gaussians), depth_range=lambda: (0.01, 100.0))
    camera = Camera(torch.tensor([[10.0, 0, 5], [0, 10.0, 5], [0, 0, 1]]), torch.eye(4), 10, 10)
    target = Viewer._target(SimpleNamespace(bench=bench), View("a", camera))
    torch.testing.assert_close(target, torch.tensor([0.0, 0.0, ahead], dtype=torch.float64))
