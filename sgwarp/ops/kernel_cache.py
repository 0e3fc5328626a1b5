"""Where Warp keeps compiled kernels: a place that can be written to, and objects that can be loaded.

Compiling takes minutes and happens once per machine. The environment variable WARP_CACHE_PATH names the folder; by
default it lies in the user's cache folder (~/.cache/warp on Linux).
"""

from __future__ import annotations

import atexit
import logging
import os
import shutil
import tempfile
from collections.abc import Callable
from typing import Any, TypeVar

import warp as wp

from sgwarp.errors import InputError

VARIABLE = "WARP_CACHE_PATH"
BROKEN = ("Failed to load CPU module", "Failed to load CUDA module", "Expecting value")
LITTLE = 32 * 2**20  # bytes; a module takes a few megabytes

Result = TypeVar("Result")


_reason = ""  # why kernels cannot be kept


def start() -> None:
    """`wp.init()`; where its cache cannot be made, with one for this process alone, which `tell` then says."""
    global _reason
    try:
        wp.init()
        return
    except OSError as error:
        _reason = error.strerror or str(error)
    folder = tempfile.mkdtemp(prefix="sgwarp-kernels-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    wp.config.kernel_cache_dir = folder
    wp.init()


def tell() -> None:
    """Say that kernels cannot be kept, if they cannot."""
    if _reason:
        logging.getLogger("sgwarp").warning(
            "Warp cannot keep compiled kernels (%s), and compiles them anew in each run; set %s to a folder that can "
            "be written to",
            _reason,
            VARIABLE,
        )


def mended(kernel: wp.Kernel, run: Callable[[], Result]) -> Result:
    """What `run`, which loads or launches the kernel, returns; a broken object in the cache is built again.

    Raises:
        InputError: The cache has to be written to, and cannot.
    """
    try:
        return run()
    except OSError as error:
        raise _unwritable(error.strerror or str(error)) from None
    except Exception as error:
        if not str(error).startswith(BROKEN):
            if _is_full():
                raise _unwritable("No space left on device") from None
            raise
    discard(kernel.module)
    try:
        return run()
    except OSError as error:
        raise _unwritable(error.strerror or str(error)) from None


def discard(module: Any) -> None:
    """Remove what the cache holds of a module."""
    for block_dim in (1, 256):
        name = module.get_module_identifier(block_dim)
        shutil.rmtree(os.path.join(_folder(), name), ignore_errors=True)


def _folder() -> str:
    return str(wp.config.kernel_cache_dir)


def _is_full() -> bool:
    try:
        return shutil.disk_usage(_folder()).free < LITTLE
    except OSError:
        return False


def _unwritable(reason: str) -> InputError:
    return InputError(
        f"Warp's cache of compiled kernels {_folder()}: cannot be written ({reason}); set {VARIABLE} to one that can"
    )
