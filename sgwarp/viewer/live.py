"""Showing what a long run makes while it makes it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from sgwarp.errors import InputError
from sgwarp.viewer.server import Address, Viewer, open_viewer, require_viser
from sgwarp.viewer.workbench import Workbench

LEAST_PAUSE = 1.0  # seconds between two states that are shown
SHARE = 0.05  # of the run's time that copies of its states may take


class Live:
    """A viewer that opens with the first state of a run and follows it. Give `watch` to the run's log.

    Args:
        begin: Makes the workbench of the first state.
        update: Shows a later state.
        address: Where the viewer listens.

    Raises:
        InputError: viser is missing.
    """

    def __init__(
        self,
        begin: Callable[[Any], Workbench],
        update: Callable[[Workbench, Any], None],
        address: Address | None = None,
    ) -> None:
        require_viser()
        self._begin, self._update, self._address = begin, update, address
        self._next_at = 0.0
        self._waiting: Callable[[], Any] | None = None
        self.viewer: Viewer | None = None

    def watch(self, make: Callable[[], Any]) -> None:
        """Take a state, if it is time for one; `make` copies it."""
        self._waiting = make
        if time.monotonic() >= self._next_at:
            self._show()

    def _show(self) -> None:
        if self._waiting is None:
            return
        start = time.monotonic()
        try:
            state = self._waiting()
        except InputError:  # nothing to see yet
            return
        self._waiting = None
        if self.viewer is None:
            self.viewer = open_viewer(self._begin(state), self._address)
        else:
            self._update(self.viewer.bench, state)
        spent = time.monotonic() - start
        self._next_at = time.monotonic() + max(LEAST_PAUSE, spent * (1 - SHARE) / SHARE)

    def finish(self) -> None:
        """Show the last state until Ctrl-C."""
        self._show()
        if self.viewer is None:
            return
        print("viewer: shows the result until Ctrl-C", flush=True)
        try:
            self.viewer.wait()
        except KeyboardInterrupt:  # the way to end it
            print("viewer: ended")
        finally:
            self.close()

    def close(self) -> None:
        """End the viewer, if it was opened."""
        if self.viewer is not None:
            self.viewer.close()
