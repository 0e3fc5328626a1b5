"""Checks and conversions that the scene types share."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sgwarp.errors import InputError


def require(condition: bool, message: str) -> None:
    if not condition:
        raise InputError(message)


def as_tensor(value: Any, dtype: torch.dtype | None = None) -> Tensor:
    """The tensor where it is, anything else as a tensor of the CPU, whatever torch's default device."""
    if isinstance(value, Tensor):
        return value if dtype is None else value.to(dtype)
    return torch.as_tensor(value, dtype=dtype, device="cpu")


def dense(name: str, value: Any) -> Tensor:
    """A tensor as it is, and what NumPy or a list of numbers holds as one.

    Raises:
        InputError: It is neither, or sparse.
    """
    if not isinstance(value, Tensor):
        try:
            array = np.asarray(value)
            require(array.dtype.kind in "biuf", f"{name}: expected a tensor or an array of numbers, got {_kind(value)}")
            value = as_tensor(array if array.flags.writeable else array.copy())
        except (TypeError, ValueError, RuntimeError, OverflowError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"{name}: expected a tensor or an array of numbers, got {_kind(value)}") from None
    require(value.layout == torch.strided, f"{name}: expected a dense tensor, got {value.layout}; call to_dense()")
    return value


def _kind(value: Any) -> str:
    return type(value).__name__


def float32(name: str, value: Any, shape: tuple[int | None, ...]) -> Tensor:
    """Convert to a contiguous float32 tensor of `shape` (None matches any size)."""
    tensor = dense(name, value)
    require(tensor.is_floating_point(), f"{name}: expected floating point values, got {tensor.dtype}")
    fits = tensor.ndim == len(shape) and all(w is None or w == s for w, s in zip(shape, tensor.shape, strict=False))
    wanted = ", ".join("any" if s is None else str(s) for s in shape)
    require(fits, f"{name}: expected shape [{wanted}], got {list(tensor.shape)}")
    return tensor.to(torch.float32).contiguous()


def require_finite(name: str, value: Tensor | float) -> None:
    """Refuse NaN and infinity in what places a whole image: a camera, a background, a setting.

    A tensor on CUDA is not looked at, for that is to wait for the device.
    """
    if isinstance(value, Tensor):
        fine = value.is_cuda or bool(torch.isfinite(value.detach()).all())
    else:
        fine = math.isfinite(value)
    require(fine, f"{name}: holds NaN or infinity")


def version_of(*tensors: Tensor) -> tuple[int, ...]:
    """Changes whenever one of the tensors is written to in place."""
    return tuple(0 if tensor.is_inference() else tensor._version for tensor in tensors)


def require_rows(name: str, bad: Tensor, rule: str, values: Tensor) -> None:
    """Raise naming the first row where `bad` is set."""
    rows = bad.flatten(1).any(dim=1) if bad.ndim > 1 else bad  # reshape(0, -1) is ambiguous
    if bool(rows.any()):
        index = int(rows.nonzero()[0])
        raise InputError(f"{name}[{index}] = {values[index].tolist()}: {rule} ({int(rows.sum())} such rows)")


def require_cameras(viewmats: Tensor, Ks: Tensor) -> None:
    """Refuse cameras that see nothing at all, which would be a black image without a word; not on CUDA.

    Raises:
        InputError: NaN or infinity, a view matrix that has no inverse, or a focal length of zero.
    """
    require_finite("viewmats", viewmats)
    require_finite("Ks", Ks)
    if not viewmats.is_cuda and bool((torch.linalg.det(viewmats.detach().to(torch.float64)) == 0).any()):
        raise InputError("viewmats: a matrix has no inverse; expected world to camera, a rotation and a translation")
    if not Ks.is_cuda and bool((Ks.detach()[..., [0, 1], [0, 1]] == 0).any()):
        raise InputError("Ks: a focal length is zero; expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels")
