"""Cutting a launch into chunks: every kernel thread runs once, whatever the number of host threads."""

from collections.abc import Iterator

import pytest
import torch
import warp as wp

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
    whole, flat = torch.zeros(4, dtype=torch.int32), view(torch.zeros(4), wp.float32)
    square = view(torch.zeros(2, 2, dtype=torch.int32), wp.int32)
    for wrong, message in (
        (flat, "visits: expected int32 in 1 dimensions, got float32"),
        (square, "got int32 in 2 dim"),
    ):
        with pytest.raises(TypeError, match=message):
            launch(visit, 4, [], [wrong, view(whole, wp.int32)], device=CPU, slots=True)
