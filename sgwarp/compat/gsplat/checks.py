"""Checks of arguments: shapes, and arguments of gsplat that are not supported."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from sgwarp.errors import InputError

TILE_SIZE = 16


def expect_shape(name: str, tensor: Any, *shapes: tuple[int | None, ...]) -> None:
    """Raise unless a floating point tensor has one of the shapes; None matches any size.

    Raises:
        InputError: Naming the argument, what it may be, and what it is.
    """
    wanted = " or ".join("[" + ", ".join("any" if s is None else str(s) for s in shape) + "]" for shape in shapes)
    if not isinstance(tensor, Tensor):
        raise InputError(f"{name}: expected a tensor {wanted}, got {type(tensor).__name__}")
    for shape in shapes:
        if len(shape) == tensor.ndim and all(w in (None, s) for w, s in zip(shape, tensor.shape, strict=True)):
            return
    raise InputError(f"{name}: expected shape {wanted}, got {list(tensor.shape)}")


def widen(*tensors: Any) -> tuple[Any, ...]:
    """Half-precision tensors as float32, with gradients in their own type; everything else as it is."""
    return tuple(
        t.to(torch.float32) if isinstance(t, Tensor) and t.dtype in (torch.float16, torch.bfloat16) else t
        for t in tensors
    )


def expect_choice(name: str, value: Any, choices: tuple[str, ...]) -> None:
    """Raise unless the value is one of the choices."""
    if value not in choices:
        raise InputError(f"{name}: expected one of {', '.join(choices)}, got {value!r}")


def refuse(**arguments: Any) -> None:
    """Raise for the first argument that was given (neither None nor False).

    Raises:
        InputError: Naming the argument.
    """
    for name, value in arguments.items():
        if value is not None and value is not False:
            raise InputError(f"{name}: not supported by sgwarp; leave it at its default")


def expect_tile_size(tile_size: int) -> None:
    """Raise unless the tiles are those that the rasterizer works in."""
    if tile_size != TILE_SIZE:
        raise InputError(f"tile_size: expected {TILE_SIZE}, got {tile_size}; other sizes only change the speed")
