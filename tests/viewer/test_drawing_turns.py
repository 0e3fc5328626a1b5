"""What the drawing thread does with one picture, what a tab's state is afterwards, and when the next one is due."""

from types import SimpleNamespace

import pytest

from sgwarp.errors import InputError
from sgwarp.ops.launcher import Interrupted
from sgwarp.scene import Camera
from sgwarp.viewer import streaming
from sgwarp.viewer.pace import STILL
from sgwarp.viewer.streaming import BUSY_WAIT, SHORTEST, WAIT, Stream, Streamer


class Screen:
    def __init__(self):
        self.shown, self.messages, self.busy = [], [], False

    def show(self, drawn, final):
        self.shown.append((drawn, final))

    def complain(self, message):
        self.messages.append(message)


@pytest.fixture
def clock():
    return SimpleNamespace(now=10.0)


@pytest.fixture
def streamer(clock):
    return Streamer(lambda: clock.now)


@pytest.fixture
def stream(streamer, stage):
    """A tab that has just moved, whose pictures take a hundredth of a second for 240 lines."""
    made = Stream(Screen(), lambda: "shot")
    made.pace = SimpleNamespace(learned=[], moving=lambda camera: camera.resized(240, 320))
    made.pace.took = lambda seconds, height: made.pace.learned.append((round(seconds, 6), height))
    streamer.add(made)
    streamer.move(made, stage.views[0].camera.resized(480, 640))
    return made


@pytest.fixture
def drawn(monkeypatch, clock):
    """Sizes of the pictures that were drawn."""
    sizes = []

    def draw(shot, camera: Camera):
        assert shot == "shot"
        sizes.append(camera.size)
        clock.now += 0.01
        return camera.size

    monkeypatch.setattr(streaming, "draw", draw)
    return sizes


def test_a_moving_picture_is_small_and_the_pace_learns_from_it(streamer, stream, drawn):
    streamer._draw(stream)
    assert drawn == [(240, 320)]
    assert stream.screen.shown == [((240, 320), False)]
    assert stream.pace.learned == [(0.01, 240)]
    assert stream.pictures == {"moving": 1, "still": 0}
    assert (stream.shown, stream.drawn, stream.wanted) == (1, 0, 1)
    assert stream.next_at == pytest.approx(10.0 + SHORTEST)
    assert stream.state == "moving"


def test_a_still_picture_is_full_and_the_pace_learns_nothing(streamer, stream, drawn):
    stream.state = "still"
    streamer._draw(stream)
    assert drawn == [(480, 640)]
    assert stream.screen.shown == [((480, 640), True)]
    assert stream.pace.learned == []
    assert stream.pictures == {"moving": 0, "still": 1}
    assert (stream.drawn, stream.state) == (1, "done")


def test_a_move_while_a_picture_is_drawn_leaves_more_to_do(streamer, stream, monkeypatch):
    stream.state = "still"
    monkeypatch.setattr(streaming, "draw", lambda shot, camera: streamer.change(stream))
    streamer._draw(stream)
    assert (stream.drawn, stream.wanted, stream.state) == (1, 2, "moving")


def test_a_picture_that_was_given_up_is_not_done(streamer, stream, monkeypatch):
    def draw(shot, camera):
        raise Interrupted

    stream.state = "still"
    monkeypatch.setattr(streaming, "draw", draw)
    streamer._draw(stream)
    assert (stream.interrupted, stream.drawn, stream.state) == (1, 0, "still")
    assert not stream.screen.shown
    assert not stream.screen.messages


@pytest.mark.parametrize(
    ("error", "message"), [(InputError("not so"), "not so"), (KeyError("x"), "KeyError: 'x'")], ids=["refused", "fault"]
)
@pytest.mark.parametrize("state", ["moving", "still"])
def test_a_picture_that_fails_is_told_and_not_tried_again(streamer, stream, monkeypatch, error, message, state):
    def draw(shot, camera):
        raise error

    stream.state = state
    monkeypatch.setattr(streaming, "draw", draw)
    streamer._draw(stream)
    assert stream.screen.messages == [message]
    assert stream.pictures == {"moving": 0, "still": 0}
    assert stream.pace.learned == []
    assert (stream.shown if state == "moving" else stream.drawn) == 1


def due(streamer, clock, at):
    clock.now = at
    chosen, wait = streamer._next()
    return ("now", chosen.state) if chosen is not None else pytest.approx(wait)


def test_when_pictures_are_due(streamer, stream, clock):
    """A small one at once, the next when a thirtieth of a second is over, a full one when nothing moved for a while."""
    assert due(streamer, clock, 10.0) == ("now", "moving")
    stream.next_at = 10.0 + SHORTEST
    assert due(streamer, clock, 10.01) == SHORTEST - 0.01
    assert due(streamer, clock, 10.0 + SHORTEST) == ("now", "moving")
    stream.shown = stream.wanted
    assert due(streamer, clock, 10.05) == STILL - 0.05
    assert due(streamer, clock, 10.0 + STILL) == ("now", "still")
    stream.drawn = stream.wanted
    assert due(streamer, clock, 11.0) == WAIT
    streamer.change()
    assert stream.moved_at == 11.0
    assert due(streamer, clock, 11.0) == ("now", "moving")


def test_tabs_that_have_no_turn(streamer, stream, clock):
    stream.screen.busy = True
    assert due(streamer, clock, 20.0) == BUSY_WAIT
    stream.screen.busy, stream.paused = False, True
    assert due(streamer, clock, 20.0) == WAIT
    stream.paused, stream.camera = False, None
    assert due(streamer, clock, 20.0) == WAIT


def test_a_change_concerns_one_tab_or_all(streamer, stream):
    other = Stream(Screen(), lambda: "shot")
    streamer.add(other)
    streamer.change(other)
    assert (stream.wanted, other.wanted) == (1, 1)
    streamer.change()
    assert (stream.wanted, other.wanted) == (2, 2)
    streamer.remove(stream)
    streamer.remove(stream)
    assert streamer._streams == [other]
    assert stream.wanted == 4, "what is being drawn is no longer wanted"
