"""The clock of a moving scene that plays."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

logger = logging.getLogger("sgwarp")
FRAMES_PER_SECOND = 10


class Player:
    """Calls a function so many times a second, in a thread of its own, until `stop`.

    Args:
        step: Shows the next frame. It may take longer than a frame's time: then frames come later, none is left out.
        rate: Frames a second.
    """

    def __init__(self, step: Callable[[], None], rate: float = FRAMES_PER_SECOND) -> None:
        self._step, self._pause = step, 1.0 / rate
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._work, name="sgwarp-viewer-player", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Call no more."""
        self._ended.set()

    def _work(self) -> None:
        try:
            while not self._ended.wait(self._pause):
                self._step()
        except Exception:
            logger.exception("viewer: playing ended")
