"""Tensors as arguments of kernels: descriptors of their memory. A Warp array would take three times as long to make."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import torch
import warp as wp
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.ops.devices import require_warp, warp_device

Descriptor: Any = type(wp.from_torch(torch.empty(1, device="cpu"), return_ctype=True))  # address, shape, strides


def view(tensor: Tensor, dtype: Any) -> Any:
    """The tensor's memory for a kernel, without a copy; vector types take the last dimension."""
    if tensor.is_cuda:
        require_warp(tensor.device)
    described = Descriptor.from_buffer_copy(_layout(dtype, tensor.dtype, tensor.shape, tensor.stride()))
    described.data, described.dtype = tensor.data_ptr(), dtype
    described._ref = tensor  # the memory lives as long as the descriptor
    return described


@lru_cache(maxsize=4096)
def _layout(dtype: Any, of_tensor: torch.dtype, shape: torch.Size, stride: tuple[int, ...]) -> Any:
    """The descriptor of such a tensor, without its address; a step asks for the same ones again and again."""
    if math.prod(shape):
        tensor = torch.empty_strided(shape, stride, dtype=of_tensor, device="meta")
    else:  # torch calls any strides of an empty tensor contiguous, Warp does not
        tensor = torch.empty(shape, dtype=of_tensor, device="meta")
    return wp.from_torch(tensor, dtype=dtype, requires_grad=False, return_ctype=True)


def view_structs(memory: Tensor, dtype: Any, *shape: int) -> Any:
    """Flat memory as an array of structs, row by row."""
    if memory.is_cuda:
        require_warp(memory.device)
    size = wp.types.type_size_in_bytes(dtype)
    strides = [size * math.prod(shape[k + 1 :]) for k in range(len(shape))]
    described = Descriptor(memory.data_ptr(), 0, len(shape), shape, strides)
    described._ref, described.dtype = memory, dtype
    return described


def as_array(tensor: Tensor, dtype: Any) -> Any:
    """The tensor's memory as a Warp array, without a copy, for what is not a launch."""
    warp_device(tensor.device)
    return wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False)


def require_fitting(kernel: wp.Kernel, arguments: Sequence[Any], device: torch.device) -> None:
    """Refuse descriptors of another type, dimension or device than the launch's; Warp takes them as they are.

    Raises:
        InputError: Some tensor is on another device.
        TypeError: Some argument does not fit its parameter.
    """
    for parameter, value in zip(kernel.adj.args, arguments, strict=False):
        if type(value) is not Descriptor:
            continue
        if value._ref.device != device:
            raise InputError(
                f"{parameter.label} of {kernel.key}: a tensor on {value._ref.device} where others are on {device}; "
                "move all to one device"
            )
        kind: Any = parameter.type
        expected = getattr(kind, "dtype", None)
        same = value.dtype is expected or (expected is not None and wp.types.types_equal(value.dtype, expected))
        if not same or value.ndim != kind.ndim:
            wanted = wp.types.type_repr(kind)
            got = f"{value.dtype.__name__} in {value.ndim} dimensions"
            raise TypeError(f"kernel {kernel.key}, {parameter.label}: expected {wanted}, got {got}")
