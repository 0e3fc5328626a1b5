"""Cutting a launch into chunks: every kernel thread runs once, whatever the number of host threads."""

import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future

import pytest
import torch
import warp as wp

from sgwarp.errors import InputError
from sgwarp.ops import launcher
from sgwarp.ops.arguments import view
from sgwarp.ops.launcher import get_threads, launch, set_threads

CPU = torch.device("cpu")


@wp.kernel
def visit(base: int, slot: int, visits: wp.array[int], slots: wp.array[int]):
    i = base + wp.tid()
    visits[i] += 1
    slots[i] = slot


@pytest.fixture(autouse=True)
def _threads() -> Iterator[None]:
    before = get_threads()
    yield
    set_threads(before)


@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("count", [1, 2, 255, 256, 257, 5000])
@pytest.mark.parametrize("chunk", [None, 1, 7])
def test_every_kernel_thread_runs_once(threads: int, count: int, chunk: int | None) -> None:
    set_threads(threads)
    visits, slots = torch.zeros(count, dtype=torch.int32), torch.full((count,), -1, dtype=torch.int32)
    launch(visit, count, [], [view(visits, wp.int32), view(slots, wp.int32)], device=CPU, slots=True, chunk=chunk)
    assert (visits == 1).all()
    assert slots.min() >= 0
    assert slots.max() < threads


@pytest.mark.parametrize("threads", [2, 3, 16])
@pytest.mark.parametrize("count", [256, 1200, 6250, 1_000_003])
def test_chunks_shrink_towards_the_end(threads: int, count: int) -> None:
    chunks = launcher._chunks(count, threads, None)
    sizes = [size for _, size in chunks]
    assert [base for base, _ in chunks] == [sum(sizes[:k]) for k in range(len(sizes))]
    assert sum(sizes) == count
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[0] <= -(-count // (8 * threads))  # no thread takes more than an eighth of its share at once
    assert sizes[-1] <= max(1, count // (60 * threads))  # for the last one nobody waits long
    assert len(sizes) <= 24 * threads  # each costs some microseconds


def test_chunks_of_a_given_length_keep_it() -> None:
    assert launcher._chunks(10, 2, 4) == ((0, 4), (4, 4), (8, 2))


def test_arguments_of_another_type_are_refused() -> None:
    whole = view(torch.zeros(4, dtype=torch.int32), wp.int32)
    flat, square = view(torch.zeros(4), wp.float32), view(torch.zeros(2, 2, dtype=torch.int32), wp.int32)
    for wrong, message in ((flat, "visits: expected .*int32.*, got float32"), (square, "got int32 in 2 dimensions")):
        with pytest.raises(TypeError, match=message):
            launch(visit, 4, [], [wrong, whole], device=CPU, slots=True)
    with pytest.raises(TypeError, match="slot: expected int32, got int32 in 1 dimensions"):
        launch(visit, 4, [whole], [whole], device=CPU)


def test_tensors_of_another_device_are_refused() -> None:
    elsewhere = torch.zeros(4, dtype=torch.int32, device="meta")
    with pytest.raises(InputError, match="visits of visit: a tensor on meta where others are on cpu"):
        launch(visit, 4, [], [view(elsewhere, wp.int32)] * 2, device=CPU, slots=True)


class Raised(Exception):
    pass


@pytest.mark.parametrize("at", ["work", "wait"])
def test_nobody_writes_after_an_exception(at: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """What interrupts a launch is raised when every host thread has stopped, and the rest of the chunks are left."""
    set_threads(2)
    count = 64
    visits, slots = torch.zeros(count, dtype=torch.int32), torch.zeros(count, dtype=torch.int32)
    busy, main = [], threading.get_ident()

    class Pool:
        def submit(self, work, slot):
            return Helper(work, slot)

    class Helper(Future):
        def __init__(self, work, slot):
            super().__init__()
            self.waits = 0
            self.thread = threading.Thread(target=self.run, args=(work, slot))
            self.thread.start()

        def run(self, work, slot):
            work(slot)
            busy.append(slot)
            self.set_result(None)

        def result(self, timeout=None):
            self.waits += 1
            if at == "wait" and self.waits == 1:
                raise Raised  # as a signal handler may
            return super().result(timeout)

    def unwanted() -> bool:
        if threading.get_ident() != main:
            time.sleep(0.01)
        elif at == "work" and visits.any():
            raise Raised
        return False

    monkeypatch.setattr(launcher, "_executor", Pool)
    with launcher.interruptible(unwanted), pytest.raises(Raised):
        launch(visit, count, [], [view(visits, wp.int32), view(slots, wp.int32)], device=CPU, slots=True, chunk=1)
    assert busy == [1], "the helper has ended before the exception comes out"
    assert visits.max() == 1
    if at == "work":
        assert not visits.all()
