"""Ctrl-C and SIGTERM between two steps instead of in the middle of one."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)  # Ctrl-C, and what batch queues and containers send before they kill
_seen = 0  # the last of them that came


class Terminated(KeyboardInterrupt):
    """SIGTERM came: everything ends as after Ctrl-C, with another exit code."""


@contextmanager
def deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Yield a function that tells whether an interrupt came in the block; coming twice, it interrupts at once.

    Outside the main thread, where Python delivers no signals, nothing changes.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    pressed = False

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal pressed
        if pressed:
            _interrupt(number, frame)
        _note(number)
        pressed = True

    before = {number: signal.signal(number, note) for number in SIGNALS}
    try:
        yield lambda: pressed
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def termination_as_interrupt() -> Iterator[None]:
    """In the block, SIGTERM raises Terminated, so that files are closed and temporary ones removed."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    _note(0)
    before = signal.signal(signal.SIGTERM, _interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def was_terminated() -> bool:
    """Whether the last interrupt was SIGTERM."""
    return _seen == signal.SIGTERM


def _note(number: int) -> None:
    global _seen
    _seen = number


def _interrupt(number: int, frame: FrameType | None) -> None:
    _note(number)
    raise Terminated if number == signal.SIGTERM else KeyboardInterrupt
