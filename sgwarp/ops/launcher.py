"""Launching kernels: host threads on the CPU, torch's current stream on CUDA.

Their arguments are in `arguments.py`, their memory in `memory.py`, devices in `devices.py`.

A CPU launch of Warp is one serial loop that releases the interpreter lock. So a launch is cut into chunks, and host
threads take chunks in turn; every kernel writes disjoint memory, so the result does not depend on their number.
"""

from __future__ import annotations

import ctypes
import itertools
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import lru_cache
from typing import Any
from weakref import WeakKeyDictionary

import torch
import warp as wp
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.ops.arguments import as_array, require_fitting
from sgwarp.ops.devices import current_stream
from sgwarp.ops.kernel_cache import mended

CHUNKS_PER_THREAD = 8  # enough to even out tiles of different cost
SMALLEST_CHUNK = 8  # so much smaller is the last chunk, which the other threads wait for
MAX_THREADS = 512
MOST_BOUNDS = 4096  # lengths of launches that are kept
SMALL = 256  # below this many threads of a launch, a second host thread costs more than it saves


def _available_cores() -> int:
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


_thread_count = _available_cores()
_sorting = threading.Lock()
_pool: ThreadPoolExecutor | None = None
_pool_lock = threading.Lock()
_local = threading.local()


def _after_fork() -> None:
    """In a forked process: threads and locks of the parent do not exist here.

    torch's own threads are gone as well, and its OpenMP would wait for them: it works with one, as in a DataLoader.
    """
    global _pool, _pool_lock, _local
    _pool, _pool_lock, _local = None, threading.Lock(), threading.local()
    _compilers.clear()
    torch.set_num_threads(1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def get_threads() -> int:
    """Host threads that a CPU launch uses."""
    return _thread_count


def set_threads(count: int) -> None:
    """Use `count` host threads from now on; the results do not depend on it.

    Raises:
        InputError: `count` is not positive, or far beyond any machine.
    """
    global _thread_count, _pool
    if not 1 <= count <= MAX_THREADS:
        raise InputError(f"threads: expected at least 1 and at most {MAX_THREADS}, got {count}")
    with _pool_lock:
        if count != _thread_count and _pool is not None:
            _pool.shutdown(wait=True)
            _pool = None
        _thread_count = count


def _executor() -> ThreadPoolExecutor:
    global _pool
    with _pool_lock:
        if _pool is None:
            _pool = ThreadPoolExecutor(max_workers=max(_thread_count - 1, 1), thread_name_prefix="sgwarp")
        return _pool


class Interrupted(Exception):
    """What a block of `interruptible` was doing is no longer wanted."""


@contextmanager
def interruptible(unwanted: Callable[[], bool]) -> Iterator[None]:
    """Launches of this thread in the block stop soon after `unwanted()` is true, and raise Interrupted.

    It is asked before each launch, and on the CPU before each chunk of one, by several threads. What the launch has
    written so far is worth nothing.
    """
    before = getattr(_local, "unwanted", None)
    _local.unwanted = unwanted
    try:
        yield
    finally:
        _local.unwanted = before


def _never() -> bool:
    return False


def launch(
    kernel: wp.Kernel,
    count: int,
    inputs: Sequence[Any],
    outputs: Sequence[Any],
    *,
    device: torch.device,
    slots: bool = False,
    chunk: int | None = None,
) -> None:
    """Run a kernel whose first argument is the first index of the launch.

    Args:
        kernel: Takes arguments named `base` (and then `slot`, if `slots`) before `inputs`.
        count: Number of kernel threads.
        slots: Pass the number of the host thread, which names its scratch; less than `get_threads()`.
        chunk: Kernel threads per host launch, by default an eighth of a host thread's share, and less at the end.

    Raises:
        Interrupted: In a block of `interruptible`.
    """
    if count == 0:
        return
    unwanted: Callable[[], bool] = getattr(_local, "unwanted", None) or _never
    if unwanted():
        raise Interrupted
    arguments = [*([0, 0] if slots else [0]), *inputs, *outputs]
    require_fitting(kernel, arguments, device)
    if device.type == "cuda":
        stream = current_stream(device)
        mended(kernel, lambda: wp.launch(kernel, count, arguments, stream=stream))
        return
    threads = 1 if chunk is None and count < SMALL else min(_thread_count, count)
    if threads == 1:
        mended(kernel, lambda: wp.launch(kernel, count, arguments, device="cpu"))
        return
    chunks = _chunks(count, threads, chunk)
    ticket = itertools.count()  # next() is atomic under the interpreter lock
    recorded = mended(kernel, lambda: wp.launch(kernel, count, arguments, device="cpu", record_cmd=True))
    # Warp's own `Launch.launch` packs every argument anew for each chunk, for which all host threads wait. This calls
    # the compiled function as that does, with the arguments packed once.
    run, packed = recorded.hooks.forward, _structure(recorded)(*recorded.params[1:])
    bounds = [_bounds(recorded, size) for _, size in chunks]

    stopped: list[BaseException] = []

    def work(slot: int, _alive: Any = arguments) -> None:  # the packed arguments are addresses only
        own = type(packed).from_buffer_copy(packed)
        if slots:
            own.slot = slot
        pointer = ctypes.byref(own)
        while (number := next(ticket)) < len(chunks) and not stopped and not unwanted():
            own.base = chunks[number][0]
            run(bounds[number], pointer)

    helpers = [_executor().submit(work, slot) for slot in range(1, threads)]
    try:
        work(0)
    except BaseException as error:
        stopped.append(error)
    while helpers:  # also after an interrupt: they still write to the caller's memory
        try:
            helpers[-1].result()
        except BaseException as error:
            stopped.append(error)
        if helpers[-1].done():
            helpers.pop()
    if stopped:
        raise stopped[0]
    if unwanted():  # some chunk may have been left out
        raise Interrupted


_structures: WeakKeyDictionary[wp.Kernel, Any] = WeakKeyDictionary()


def _structure(recorded: Any) -> Any:
    """The arguments of a kernel as its compiled function takes them: one behind the other, each of Warp's type."""
    held = _structures.get(recorded.kernel)
    if held is None:
        labels = (argument.label for argument in recorded.kernel.adj.args)
        fields = list(zip(labels, map(type, recorded.params[1:]), strict=True))  # behind the bounds
        held = _structures[recorded.kernel] = type("Arguments", (ctypes.Structure,), {"_fields_": fields})
    return held


_bounds_of: dict[tuple[int, int], Any] = {}  # by dimensions and length of a launch, as compiled functions take them


def _bounds(recorded: Any, size: int) -> Any:
    key = (recorded.kernel.adj.kernel_dim, size)
    held = _bounds_of.get(key)
    if held is None:
        recorded.set_dim(size)
        if len(_bounds_of) >= MOST_BOUNDS:
            _bounds_of.clear()
        held = _bounds_of[key] = ctypes.byref(recorded.bounds)
    return held


@lru_cache(maxsize=256)
def _chunks(count: int, threads: int, chunk: int | None) -> tuple[tuple[int, int], ...]:
    """First index and length of each host launch, one behind the other.

    Without a `chunk`, of a thread's share each takes an eighth, and towards the end less and less, down to an eighth
    of that: a thread that comes last leaves the others little to wait for.
    """
    largest = chunk or max(1, -(-count // (threads * CHUNKS_PER_THREAD)))
    smallest = chunk or max(1, largest // SMALLEST_CHUNK)
    chunks, base = [], 0
    while base < count:
        rest = count - base
        size = min(rest, max(smallest, min(largest, rest // (2 * threads))))
        chunks.append((base, size))
        base += size
    return tuple(chunks)


_loaded: set[str] = set()  # modules that `load_together` has seen
_compilers: dict[str, ThreadPoolExecutor] = {}  # a thread for each set of compiler options


def load_together(kernels: Sequence[wp.Kernel]) -> None:
    """Load the modules of these kernels on the CPU, side by side; what is not in the cache is compiled.

    Modules of the same compiler options are loaded by one thread, which is kept: Warp compiles its headers once for
    each thread and set of options, and that takes longer than several modules. The second time this costs nothing.
    """
    unseen = list({k.module.name: k.module for k in kernels if k.module.name not in _loaded}.values())
    if not unseen:
        return
    _loaded.update(module.name for module in unseen)
    if _thread_count == 1:
        return  # the launch does it
    alike: dict[str, list[Any]] = {}
    for module in unseen:
        alike.setdefault(str(module.options["cpu_compiler_flags"]), []).append(module)
    loading = [_compiler(flags).submit(_load, modules) for flags, modules in alike.items()]
    for done in loading:
        # What fails here fails again at the launch, which mends the cache or says what is wrong with it.
        with suppress(Exception):
            done.result()


def _compiler(flags: str) -> ThreadPoolExecutor:
    with _pool_lock:
        if flags not in _compilers:
            _compilers[flags] = ThreadPoolExecutor(max_workers=1, thread_name_prefix="sgwarp-compiler")
        return _compilers[flags]


def _load(modules: list[Any]) -> None:
    wp.force_load("cpu", modules=modules, block_dim=1, max_workers=1)


def launch_blocks(
    kernel: wp.Kernel, grid: Sequence[int], inputs: Sequence[Any], outputs: Sequence[Any], *, device: torch.device
) -> None:
    """Run a block-schedule kernel with 256 threads per block; on the CPU the threads are cooperative fibers."""
    arguments = [*inputs, *outputs]
    require_fitting(kernel, arguments, device)
    tiles: dict[str, Any] = {"dim": list(grid), "inputs": arguments, "block_dim": 256}
    if device.type == "cuda":
        stream = current_stream(device)
        mended(kernel, lambda: wp.launch_tiled(kernel, **tiles, stream=stream))
        return
    previous = wp.config.enable_cpu_blocks
    wp.config.enable_cpu_blocks = True
    try:
        mended(kernel, lambda: wp.launch_tiled(kernel, **tiles, device="cpu"))
    finally:
        wp.config.enable_cpu_blocks = previous


def launch_plain(
    kernel: wp.Kernel,
    count: int | tuple[int, int],
    inputs: Sequence[Any],
    outputs: Sequence[Any],
    *,
    device: torch.device,
) -> None:
    """Run a kernel that takes no `base`, in one launch."""
    if count == 0 or (isinstance(count, tuple) and 0 in count):
        return
    require_fitting(kernel, [*inputs, *outputs], device)
    if device.type == "cuda":
        stream = current_stream(device)
        mended(kernel, lambda: wp.launch(kernel, count, inputs, outputs, stream=stream))
    else:
        mended(kernel, lambda: wp.launch(kernel, count, inputs, outputs, device="cpu"))


def sort_pairs(keys: Tensor, values: Tensor, count: int, key_type: Any, *, end_bit: int | None = None) -> None:
    """Sort pairs by key, stable, in place.

    Args:
        keys: Keys, with as much room again behind them, [2 count].
        values: int32, [2 count].
        count: How many pairs there are.
        key_type: Warp's type of the keys.
        end_bit: The first bit that no key has set.
    """
    if not count:
        return
    arrays = as_array(keys, key_type), as_array(values, wp.int32)
    if not keys.is_cuda:
        wp.utils.radix_sort_pairs(*arrays, count, end_bit=end_bit)
        return
    # Warp sorts on its own current stream of the current device, whatever the arrays' device and torch's stream. That
    # stream is Warp's for all threads, hence the lock.
    with _sorting, wp.ScopedStream(current_stream(keys.device), sync_enter=False):
        wp.utils.radix_sort_pairs(*arrays, count, end_bit=end_bit)
