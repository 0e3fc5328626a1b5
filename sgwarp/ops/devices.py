"""Devices: Warp's for torch's, those that a user names, and torch's current stream of one."""

from __future__ import annotations

import os
import re
import sys
from typing import Any

import torch
import warp as wp

from sgwarp.errors import InputError
from sgwarp.ops import kernel_cache

LEAST_DRIVER = 580  # of NVIDIA, that the wheels of Warp 1.19 take; they are built with CUDA 13


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


_streams: dict[tuple[int, int], Any] = {}  # torch's streams as Warp's, by device and handle


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
