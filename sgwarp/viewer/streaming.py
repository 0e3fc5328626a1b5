"""The thread that draws pictures for all tabs: small ones while a camera moves, a full one when it stands still."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, Protocol

import torch

from sgwarp.errors import InputError
from sgwarp.ops.launcher import Interrupted, interruptible
from sgwarp.scene import Camera
from sgwarp.viewer.modes import Drawn, Shot, draw
from sgwarp.viewer.pace import STILL, Pace

logger = logging.getLogger("sgwarp")
SHORTEST = 1 / 30  # seconds from one moving picture to the next; the browser needs the cores, too
WAIT = 0.5  # seconds after which an idle thread looks whether it should end
BUSY_WAIT = 0.004  # seconds between two looks whether a slow tab has taken its picture


class Screen(Protocol):
    """Where the pictures of a tab go."""

    def show(self, drawn: Drawn, final: bool) -> None:
        """Send a picture; `final` where the camera stands still. Must not wait for the browser."""
        ...

    @property
    def busy(self) -> bool:
        """Whether an earlier picture has not left yet."""
        ...

    def complain(self, message: str) -> None:
        """Tell that there is no picture, and why."""
        ...


State = Literal["moving", "still", "done"]


def compute_alone() -> None:
    """Have torch compute in the calling thread alone, as long as it lives.

    Its workers wait for the next operation by spinning. A picture has dozens of short operations, so spinning took as
    much processor time as the picture itself, and the browser and the rasterizer's own threads want the same cores.
    """
    others = torch.get_num_threads()
    torch.set_num_threads(1)  # of this thread and, if nobody says otherwise, of all that begin later
    restore = threading.Thread(target=torch.set_num_threads, args=(others,))
    restore.start()
    restore.join()


@dataclass(eq=False)
class Stream:
    """The pictures of one tab.

    Attributes:
        screen: Where they go.
        shot: What to draw, asked anew for every picture.
        pace: Sizes while the camera moves.
        pictures: How many moving and still ones were sent.
        interrupted: How many still ones were given up because the camera moved.
    """

    screen: Screen
    shot: Callable[[], Shot]
    pace: Pace = field(default_factory=Pace)
    camera: Camera | None = None
    state: State = "done"
    moved_at: float = 0.0
    wanted: int = 0  # grows with every move or change
    shown: int = 0  # value of `wanted` that was drawn small
    drawn: int = 0  # value of `wanted` that was drawn in full
    next_at: float = 0.0  # when the next moving picture may begin
    pictures: dict[str, int] = field(default_factory=lambda: {"moving": 0, "still": 0})
    interrupted: int = 0
    paused: bool = False


class Streamer:
    """Draws for all tabs in turn, in a thread of its own. A tab that takes its pictures slowly is passed over.

    Args:
        clock: Seconds; for tests.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self._streams: list[Stream] = []
        self._wake = threading.Condition()
        self._ended = False
        self._turn = 0
        self._thread = threading.Thread(target=self._work, name="sgwarp-viewer", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread, after the picture at hand."""
        with self._wake:
            self._ended = True
            self._wake.notify_all()
        if self._thread.is_alive():
            self._thread.join(timeout=10)

    def add(self, stream: Stream) -> None:
        """Draw for one more tab."""
        with self._wake:
            self._streams.append(stream)

    def remove(self, stream: Stream) -> None:
        """Draw no more for a tab."""
        with self._wake:
            if stream in self._streams:
                self._streams.remove(stream)
            stream.wanted += 1  # what is being drawn is no longer wanted

    def move(self, stream: Stream, camera: Camera) -> None:
        """The camera of a tab has moved."""
        with self._wake:
            stream.camera = camera
            self._want(stream)

    def change(self, stream: Stream | None = None) -> None:
        """What a tab shows has changed, or what all show; while it goes on changing small pictures are drawn, too."""
        with self._wake:
            for one in self._streams if stream is None else [stream]:
                self._want(one)

    def _want(self, stream: Stream) -> None:
        stream.moved_at, stream.state = self._clock(), "moving"
        stream.wanted += 1
        self._wake.notify_all()

    def _work(self) -> None:
        compute_alone()
        while True:
            with self._wake:
                chosen, wait = self._next()
                if self._ended:
                    return
                if chosen is None:
                    self._wake.wait(wait)
                    continue
            self._draw(chosen)

    def _next(self) -> tuple[Stream | None, float]:
        """The tab whose turn it is, or how long there is nothing to do."""
        now, wait = self._clock(), WAIT
        for offset in range(len(self._streams)):
            at = (self._turn + offset) % len(self._streams)
            stream = self._streams[at]
            if stream.paused or stream.camera is None or stream.drawn == stream.wanted:
                continue
            if stream.screen.busy:
                wait = min(wait, BUSY_WAIT)
                continue
            due = self._due(stream, now)
            if due > now:
                wait = min(wait, due - now)
                continue
            self._turn = at + 1
            return stream, 0.0
        return None, wait

    @staticmethod
    def _due(stream: Stream, now: float) -> float:
        """When the next picture of a tab may begin; a camera that has not moved for a while stands still."""
        still_at = stream.moved_at + STILL
        if now >= still_at:
            stream.state = "still"
            return now
        return still_at if stream.shown == stream.wanted else stream.next_at

    def _draw(self, stream: Stream) -> None:
        """One picture; a still one is given up as soon as another is wanted."""
        with self._wake:
            camera, wanted, moving = stream.camera, stream.wanted, stream.state == "moving"
        assert camera is not None
        start = self._clock()
        stream.next_at = start + SHORTEST
        try:
            shot = stream.shot()
            if moving:
                camera = stream.pace.moving(camera)
                drawn = draw(shot, camera)
            else:
                with interruptible(lambda: stream.wanted != wanted):
                    drawn = draw(shot, camera)
            stream.screen.show(drawn, final=not moving)
        except Interrupted:
            stream.interrupted += 1
            return
        except InputError as error:
            stream.screen.complain(str(error))
        except Exception as error:  # one tab's fault must not end the pictures of the others
            logger.exception("viewer: a picture failed")
            stream.screen.complain(f"{type(error).__name__}: {error}")
        else:
            stream.pictures["moving" if moving else "still"] += 1
            if moving:
                stream.pace.took(self._clock() - start, camera.height)
        self._drawn(stream, wanted, moving)

    def _drawn(self, stream: Stream, wanted: int, moving: bool) -> None:
        with self._wake:
            if moving:
                stream.shown = wanted
            else:
                stream.drawn = wanted
                if stream.wanted == wanted:
                    stream.state = "done"
