"""Launching kernels: host threads on the CPU, torch's current stream on CUDA; memory is in `memory.py`.

A CPU launch of Warp is one serial loop that releases the interpreter lock. So a launch is cut into chunks, and host
threads take chunks in turn; every kernel writes disjoint memory, so the result does not depend on their number.
"""

from __future__ import annotations

import itertools
import os
import re
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from typing import Any

import torch
import warp as wp
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.ops import kernel_cache
from sgwarp.ops.kernel_cache import mended

CHUNKS_PER_THREAD = 8  # enough to even out tiles of different cost
MAX_THREADS = 512
LEAST_DRIVER = 580  # of NVIDIA, that the wheels of Warp 1.19 take; they are built with CUDA 13
SMALL = 256  # below this many threads of a launch, a second host thread costs more than it saves


def _init_warp() -> None:
    """Start Warp without its banner, and on a machine without a GPU without the warning that there is none."""
    if wp.config.log_level == wp.LOG_INFO:
        wp.config.log_level = wp.LOG_WARNING
    if torch.cuda.is_available():
        kernel_cache.start()
        return
    # The native library writes that warning straight to file descriptor 2, past every setting.
    sys.stderr.flush()
    kept = os.dup(2)
    sink = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(sink, 2)
        kernel_cache.start()
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(sink)


_init_warp()
kernel_cache.tell()


def _available_cores() -> int:
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


_thread_count = _available_cores()
_streams: dict[tuple[int, int], Any] = {}  # torch's streams as Warp's, by device and handle
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
        kernel: Takes `base` (and then `slot`, if `slots`) before `inputs`.
        count: Number of kernel threads.
        slots: Pass the number of the host thread, which names its scratch; less than `get_threads()`.
        chunk: Kernel threads per host launch, by default an eighth of a host thread's share.

    Raises:
        Interrupted: In a block of `interruptible`.
    """
    if count == 0:
        return
    unwanted: Callable[[], bool] = getattr(_local, "unwanted", None) or _never
    if unwanted():
        raise Interrupted
    head = [0, 0] if slots else [0]
    if device.type == "cuda":
        stream = current_stream(device)
        mended(kernel, lambda: wp.launch(kernel, count, [*head, *inputs], outputs, stream=stream))
        return
    threads = 1 if chunk is None and count < SMALL else min(_thread_count, count)
    if threads == 1:
        mended(kernel, lambda: wp.launch(kernel, count, [*head, *inputs], outputs, device="cpu"))
        return
    size = chunk or max(1, -(-count // (threads * CHUNKS_PER_THREAD)))
    ticket = itertools.count()  # next() is atomic under the interpreter lock

    def work(slot: int) -> None:
        command = None
        while (base := next(ticket) * size) < count and not unwanted():
            if command is None:
                first = [base, slot] if slots else [base]
                command = wp.launch(kernel, size, [*first, *inputs], outputs, device="cpu", record_cmd=True)
            command.set_param_at_index(0, base)
            command.set_dim(min(size, count - base))
            command.launch()

    mended(kernel, lambda: kernel.module.load("cpu", block_dim=1))  # once, before several threads ask for it
    helpers = [_executor().submit(work, slot) for slot in range(1, threads)]
    try:
        work(0)
    finally:
        for helper in helpers:
            helper.result()
    if unwanted():  # some chunk may have been left out
        raise Interrupted


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
    if device.type == "cuda":
        stream = current_stream(device)
        tiles = {"dim": list(grid), "inputs": inputs, "outputs": outputs, "block_dim": 256}
        mended(kernel, lambda: wp.launch_tiled(kernel, **tiles, stream=stream))
        return
    previous = wp.config.enable_cpu_blocks
    wp.config.enable_cpu_blocks = True
    try:
        tiles = {"dim": list(grid), "inputs": inputs, "outputs": outputs, "block_dim": 256}
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
    arrays = view(keys, key_type), view(values, wp.int32)
    if not keys.is_cuda:
        wp.utils.radix_sort_pairs(*arrays, count, end_bit=end_bit)
        return
    # Warp sorts on its own current stream of the current device, whatever the arrays' device and torch's stream. That
    # stream is Warp's for all threads, hence the lock.
    with _sorting, wp.ScopedStream(current_stream(keys.device), sync_enter=False):
        wp.utils.radix_sort_pairs(*arrays, count, end_bit=end_bit)


def current_stream(device: torch.device) -> wp.Stream:
    """torch's current stream of a CUDA device, as Warp's.

    One object is kept for each stream. A temporary one would register and forget the stream in each launch, and take
    the memory with it that sorting keeps for the stream.
    """
    stream = torch.cuda.current_stream(device)
    key = (stream.device_index, stream.cuda_stream)
    held = _streams.get(key)
    if held is None:
        require_warp(device)
        held = _streams.setdefault(key, wp.stream_from_torch(stream))
    return held


def warp_device(device: torch.device) -> wp.Device:
    """The device, as Warp's.

    Raises:
        InputError: It is one of CUDA, and Warp has none.
    """
    require_warp(device)
    return wp.device_from_torch(device)


def require_warp(device: torch.device) -> None:
    """Refuse a CUDA device that torch has and Warp has not: it wants a newer driver.

    Raises:
        InputError: Warp has no CUDA device.
    """
    if device.type == "cuda" and not wp.is_cuda_available():
        raise InputError(
            f"device {device}: Warp {wp.__version__} has no CUDA device here, though torch has one: it needs an NVIDIA "
            f"driver of version {LEAST_DRIVER} or newer; update the driver, or compute on the CPU"
        )


def find_device(name: str | torch.device) -> torch.device:
    """The device of this name: "cpu", "cuda" (torch's current one) or "cuda:N".

    Raises:
        InputError: There is no device of this name, or Warp does not drive it.
    """
    match = re.fullmatch(r"cpu|cuda(?::(\d+))?", str(name))
    if match is None:
        raise InputError(f"device {name}: expected cpu, cuda or cuda:N")
    if str(name) == "cpu":
        return torch.device("cpu")
    if not torch.cuda.is_available():
        raise InputError(f"device {name}: this machine or this torch has no CUDA device; use cpu")
    count = torch.cuda.device_count()
    index = torch.cuda.current_device() if match[1] is None else int(match[1])
    if index >= count:
        raise InputError(f"device {name}: there are {count}, cuda:0 to cuda:{count - 1}")
    device = torch.device("cuda", index)
    require_warp(device)
    return device


def view(tensor: Tensor, dtype: Any) -> Any:
    """The tensor's memory as a Warp array, without a copy; vector types take the last dimension."""
    if tensor.is_cuda:
        require_warp(tensor.device)
    if not tensor.numel():  # torch calls any strides of an empty tensor contiguous, Warp does not
        tensor = tensor.new_empty(tensor.shape)
    return wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False)
