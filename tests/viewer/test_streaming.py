"""The thread that draws: three states, turns, tabs that are slow or broken, and giving up what is not wanted."""

import itertools
import threading
from contextlib import suppress
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sgwarp.ops import launcher
from sgwarp.ops.launcher import Interrupted, interruptible
from sgwarp.rendering.renderer import render
from sgwarp.viewer import screen as screen_module
from sgwarp.viewer.modes import Drawn, Shot
from sgwarp.viewer.pace import GOAL, SIZES, SLOWEST, Pace
from sgwarp.viewer.screen import Canvas
from sgwarp.viewer.streaming import SHORTEST, Stream, Streamer


class Screen:
    """Keeps what it is shown."""

    def __init__(self):
        self.shown, self.messages, self.busy = [], [], False
        self.got = threading.Condition()

    def show(self, drawn, final):
        with self.got:
            self.shown.append((drawn.pixels, final))
            self.got.notify_all()

    def complain(self, message):
        with self.got:
            self.messages.append(message)
            self.got.notify_all()

    def wait(self, ready):
        with self.got:
            assert self.got.wait_for(lambda: ready(self), timeout=60)


@pytest.fixture
def streamer():
    made = Streamer()
    made.start()
    yield made
    made.stop()
    assert not made._thread.is_alive()


def finished(screen) -> bool:
    return any(final for _, final in screen.shown)


@pytest.fixture
def camera(stage):
    return stage.views[2].camera.resized(540, 720)


def stream_of(stage, screen) -> Stream:
    return Stream(screen, lambda: Shot(stage.gaussians))


def test_a_move_gives_a_small_picture_and_then_the_full_one(streamer, stage, camera):
    screen = Screen()
    stream = stream_of(stage, screen)
    streamer.add(stream)
    streamer.move(stream, camera)
    screen.wait(finished)
    (small, first), (full, last) = screen.shown[0], screen.shown[-1]
    assert (first, last) == (False, True)
    assert small.shape == (360, 480, 3)
    assert full.shape == (540, 720, 3)
    assert stream.state == "done"
    count = len(screen.shown)
    streamer.change(stream)
    screen.wait(lambda one: len(one.shown) > count + 1 and one.shown[-1][1])
    assert np.array_equal(screen.shown[-1][0], full)


def test_a_tab_that_takes_no_pictures_does_not_hold_up_another(streamer, stage, camera):
    slow, quick = Screen(), Screen()
    slow.busy = True
    streams = [stream_of(stage, screen) for screen in (slow, quick)]
    for stream in streams:
        streamer.add(stream)
        streamer.move(stream, camera)
    quick.wait(finished)
    assert not slow.shown
    slow.busy = False
    slow.wait(finished)


def test_a_fault_of_one_tab_is_told_there_and_nowhere_else(streamer, stage, camera, caplog):
    broken, whole = Screen(), Screen()

    def fail():
        raise ZeroDivisionError("of a test")

    streams = [Stream(broken, fail), stream_of(stage, whole)]
    for stream in streams:
        streamer.add(stream)
        streamer.move(stream, camera)
    whole.wait(finished)
    broken.wait(lambda one: len(one.messages) >= 2)
    assert "ZeroDivisionError" in broken.messages[0]
    assert not broken.shown


def test_pictures_are_drawn_without_torchs_workers(streamer, stage, camera):
    """They spin; the other threads keep theirs."""
    before, seen, screen = torch.get_num_threads(), [], Screen()

    def shot():
        seen.append(torch.get_num_threads())
        return Shot(stage.gaussians)

    stream = Stream(screen, shot)
    streamer.add(stream)
    streamer.move(stream, camera)
    screen.wait(finished)
    other = []
    thread = threading.Thread(target=lambda: other.append(torch.get_num_threads()))
    thread.start()
    thread.join()
    assert set(seen) == {1}
    assert (torch.get_num_threads(), other) == (before, [before])


def test_tabs_have_cameras_of_their_own(streamer, stage):
    screens = [Screen(), Screen()]
    views = stage.views[0].camera.resized(120, 160), stage.views[5].camera.resized(120, 160)
    for screen, view in zip(screens, views, strict=True):
        stream = stream_of(stage, screen)
        streamer.add(stream)
        streamer.move(stream, view)
    for screen, view in zip(screens, views, strict=True):
        screen.wait(finished)
        truth = (render(stage.gaussians, view).clamp(0, 1) * 255 + 0.5).byte().numpy()
        assert np.array_equal(screen.shown[-1][0], truth)


def test_a_picture_waits_until_it_is_due(stage, camera):
    now = [0.0]
    streamer, stream = Streamer(lambda: now[0]), stream_of(stage, Screen())
    streamer.add(stream)
    streamer.move(stream, camera)
    stream.next_at = SHORTEST
    chosen, wait = streamer._next()
    assert chosen is None
    assert wait == pytest.approx(SHORTEST)
    now[0] = SHORTEST
    assert streamer._next() == (stream, 0.0)


@pytest.mark.parametrize("waits", [True, False])
def test_a_canvas_is_busy_while_its_client_has_not_taken_the_picture(monkeypatch, waits):
    monkeypatch.setattr(screen_module, "is_waiting", lambda client: client.waits)
    assert Canvas(SimpleNamespace(waits=waits), print).busy is waits


def test_a_moving_picture_is_coarser_than_the_one_that_stays():
    sent = []
    scene = SimpleNamespace(set_background_image=lambda pixels, **options: sent.append(options))
    canvas = Canvas(SimpleNamespace(scene=scene, flush=lambda: None), print)
    drawn = Drawn(np.zeros((8, 12, 3), np.uint8), np.ones((8, 12), np.float32))
    for final in (False, True):
        canvas.show(drawn, final)
    assert sent[0]["jpeg_quality"] < sent[1]["jpeg_quality"]
    assert [one["depth"].shape for one in sent] == [(2, 3), (8, 12)]


def test_a_tab_that_was_removed_gets_nothing(streamer, stage, camera):
    screen = Screen()
    stream = stream_of(stage, screen)
    streamer.add(stream)
    streamer.remove(stream)
    streamer.move(stream, camera)
    other = Screen()
    watched = stream_of(stage, other)
    streamer.add(watched)
    streamer.move(watched, camera)
    other.wait(finished)
    assert not screen.shown


def test_a_full_picture_is_given_up_when_the_camera_moves(streamer, stage, camera, monkeypatch):
    """The move comes while the full picture is drawn: in the first launch that can be given up."""
    screen = Screen()
    stream = stream_of(stage, screen)
    again = threading.Event()
    original = launcher.launch

    def launch(kernel, count, *args, **options):
        if getattr(launcher._local, "unwanted", None) is not None and not again.is_set():
            again.set()
            streamer.move(stream, camera)
        original(kernel, count, *args, **options)

    monkeypatch.setattr("sgwarp.ops.splatting.tiles.launch", launch)
    monkeypatch.setattr("sgwarp.ops.splatting.forward.launch", launch)
    streamer.add(stream)
    streamer.move(stream, camera)
    screen.wait(finished)
    assert again.is_set()
    assert stream.interrupted == 1
    assert stream.pictures["still"] == 1


# Launches that are given up


def test_unwanted_work_stops_and_the_next_is_whole(stage):
    camera = stage.views[2].camera
    wanted = render(stage.gaussians, camera)
    with pytest.raises(Interrupted), interruptible(lambda: True):
        render(stage.gaussians, camera)
    assert torch.equal(render(stage.gaussians, camera), wanted)


@pytest.fixture
def two_threads():
    """Each launch asks for every chunk then, whatever number a test before has left."""
    before = launcher.get_threads()
    launcher.set_threads(2)
    yield
    launcher.set_threads(before)


def test_work_is_given_up_in_the_middle_of_a_launch(stage, two_threads):
    """The n-th question is answered with yes, for every n that comes up: nothing is ever returned half done."""
    camera = stage.views[2].camera.resized(360, 480)
    wanted, given_up, limit, found = render(stage.gaussians, camera), 0, 1, None
    while found is None:
        count = itertools.count(1)  # next() is atomic: several threads ask
        with suppress(Interrupted), interruptible(lambda count=count, limit=limit: next(count) >= limit):
            found = render(stage.gaussians, camera)
        given_up += found is None
        limit += max(1, limit // 3)
    assert torch.equal(found, wanted)
    assert given_up > 5


def test_other_threads_are_not_given_up(stage):
    camera, results = stage.views[2].camera, []
    with interruptible(lambda: True):
        thread = threading.Thread(target=lambda: results.append(render(stage.gaussians, camera)))
        thread.start()
        thread.join()
    assert torch.equal(results[0], render(stage.gaussians, camera))


# Sizes


def settle(cost, camera, pace=None, pictures=200) -> Pace:
    """A pace after pictures that take cost(height) seconds."""
    pace = pace or Pace()
    for _ in range(pictures):
        height = pace.moving(camera).height
        pace.took(cost(height), height)
    return pace


@pytest.mark.parametrize("per_pixel", [1e-9, 1e-8, 5e-8, 1e-7, 4e-7])
def test_pictures_are_as_large_as_time_allows(stage, per_pixel):
    camera = stage.views[0].camera.resized(900, 1200)

    def cost(height):
        return 0.004 + per_pixel * height * height * 4 / 3

    pace = settle(cost, camera)
    height = pace.moving(camera).height
    affordable = [size for size in SIZES if cost(size) <= SLOWEST]
    assert cost(height) <= SLOWEST or height == SIZES[0]
    assert height >= min(900, max((size for size in affordable if cost(size) < 0.5 * GOAL), default=SIZES[0]))
    later = settle(cost, camera, pace, 50)
    assert later.moving(camera).height == height, "it does not go up and down"


def test_a_load_that_comes_and_goes_is_followed(stage):
    camera = stage.views[0].camera.resized(480, 640)
    quick, slow = (lambda height: 1e-8 * height * height), (lambda height: 1e-6 * height * height)
    pace = settle(quick, camera)
    assert pace.moving(camera).size == (480, 640)
    assert settle(slow, camera, pace).moving(camera).height <= 256
    assert settle(quick, camera, pace).moving(camera).height == 480
