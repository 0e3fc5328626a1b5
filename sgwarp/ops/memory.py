"""Memory of kernels: scratch that is used again, large pages, and large images that were left by others."""

from __future__ import annotations

import math
import mmap
import os
import threading
import weakref
from collections import deque
from contextlib import suppress
from typing import Any

import numpy as np
import torch
from torch import Tensor

MOST_COUNTERS = 4096  # that a launch needs, as a rule
HUGE = 2 * 2**20  # bytes of a large page; smaller scratch lies in ordinary ones
LARGE = 4 * 2**20  # what is larger pays for pages: cleared anew each time, or small ones to look up
MAX_IDLE = 2  # large images that are kept for the next one of their size

_local = threading.local()


class _Lent(np.ndarray):
    """Memory of a tensor that was given away; unlike a plain array it can be watched for its end."""


_idle: deque[np.ndarray] = deque(maxlen=MAX_IDLE)


def _after_fork() -> None:
    """In a forked process: memory of the parent's threads is a copy that nobody needs."""
    global _local
    _local = threading.local()
    _idle.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def scratch(name: str, count: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """A flat tensor of at least `count` elements, reused by the next call with this name, thread and CUDA stream.

    Fresh memory costs more than most kernels that write it: the operating system clears every page.
    """
    store: dict[tuple[str, torch.dtype, torch.device, int], Tensor] = _local.__dict__.setdefault("store", {})
    stream = torch.cuda.current_stream(device).cuda_stream if device.type == "cuda" else 0
    key = (name, dtype, device, stream)
    held = store.get(key)
    if held is None or held.numel() < count:
        with torch.inference_mode(False):  # a tensor made under it could never be written to outside again
            held = _scratch_memory(max(count + count // 4, 1), dtype, device)
        store[key] = held
    return held[:count]


def _scratch_memory(count: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Uninitialised; on Linux in large pages, if it fills some: kernels jump about in it, and pages are looked up."""
    size = count * dtype.itemsize
    if device.type != "cpu" or size < HUGE or not hasattr(mmap, "MADV_HUGEPAGE"):
        return torch.empty(count, dtype=dtype, device=device)
    # Not shared, as Python's default is: a forked process would write into this one's memory.
    memory = mmap.mmap(-1, size + HUGE, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    with suppress(OSError):  # a kernel without them
        memory.madvise(mmap.MADV_HUGEPAGE)
    start = -np.frombuffer(memory, np.uint8).ctypes.data % HUGE
    return torch.frombuffer(memory, dtype=dtype, count=count, offset=start)


def counters(count: int, device: torch.device) -> Tensor:
    """int32 zeros that the blocks of a kernel count in (`comes_last`); they are zero again after each launch.

    As scratch, they belong to a thread and a stream, whose launches follow each other.
    """
    store: dict[Any, Tensor] = _local.__dict__.setdefault("counters", {})
    key = (device, torch.cuda.current_stream(device).cuda_stream if device.type == "cuda" else 0)
    held = store.get(key)
    if held is None or len(held) < count:
        with torch.inference_mode(False):
            held = store[key] = torch.zeros(max(count, MOST_COUNTERS), dtype=torch.int32, device=device)
    return held


def fresh(*shape: int, device: torch.device) -> Tensor:
    """An uninitialised float32 tensor for the caller to keep; large ones on the CPU use again what others left.

    Clearing the pages of 64 channels takes about as long as compositing them.
    """
    count = math.prod(shape)
    if device.type != "cpu" or 4 * count <= LARGE:
        return torch.empty(shape, device=device)
    owner = _left_over(count)
    return _lend(_scratch_memory(count, torch.float32, device).numpy() if owner is None else owner, shape)


def _left_over(count: int) -> np.ndarray | None:
    for _ in range(MAX_IDLE):
        try:
            owner = _idle.popleft()
        except IndexError:  # none is left, or another thread took it
            return None
        if len(owner) == count:
            return owner
        _idle.append(owner)
    return None


def _lend(owner: np.ndarray, shape: tuple[int, ...]) -> Tensor:
    lent = owner.view(_Lent)
    weakref.finalize(lent, _idle.append, owner).atexit = False
    return torch.from_numpy(lent).view(shape)


def release_scratch() -> None:
    """Give the calling thread's scratch memory back, and what large images left."""
    _local.__dict__.pop("store", None)
    _local.__dict__.pop("counters", None)
    _idle.clear()
