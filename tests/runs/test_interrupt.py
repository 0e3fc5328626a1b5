"""What happens to signals around a block that puts interrupts off."""

import os
import signal
import threading

import pytest

from sgwarp.runs.interrupt import SIGNALS, Terminated, deferred_interrupt, termination_as_interrupt


def handlers():
    return [signal.getsignal(number) for number in SIGNALS]


@pytest.mark.parametrize("fails", [False, True])
def test_handlers_are_those_of_before(fails):
    before = handlers()
    try:
        with deferred_interrupt() as interrupted:
            assert not interrupted()
            assert all(now != then for now, then in zip(handlers(), before, strict=True))
            if fails:
                raise ValueError("in the block")
    except ValueError:
        assert fails
    assert handlers() == before
    with termination_as_interrupt():
        assert signal.getsignal(signal.SIGTERM) != before[1]
    assert handlers() == before


def _twice(number):
    with deferred_interrupt() as interrupted:
        os.kill(os.getpid(), number)
        assert interrupted()
        os.kill(os.getpid(), number)
    pytest.fail("went on after the second signal")


@pytest.mark.parametrize(("number", "ends"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, Terminated)])
def test_the_first_signal_is_noted_and_the_second_interrupts(number, ends):
    with pytest.raises(ends):
        _twice(number)


def test_other_threads_leave_signals_alone():
    before, seen = handlers(), []

    def work():
        with deferred_interrupt() as interrupted:
            seen.append((interrupted(), handlers()))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [(False, before)]
