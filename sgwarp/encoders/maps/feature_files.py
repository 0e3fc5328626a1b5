"""Arrays of 2D features on disk: NumPy, PyTorch and safetensors files, channels first or last."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import torch
from numpy.typing import NDArray
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.files.arrays import read_array, read_arrays
from sgwarp.files.tensors import read_tensors
from sgwarp.files.torch_files import load_torch
from sgwarp.io.undistort import same_shape as same_shape

FEATURE_SUFFIXES = (".npy", ".npz", ".pt", ".pth", ".safetensors")
FEATURE_KEYS = ("features", "feat", "dense", "arr_0")  # of files that hold more than one array
VALID_KEY = "valid"

Layout = Literal["chw", "hwc"]


def load_features(path: Path) -> tuple[Tensor, Tensor | None]:
    """Features of a view as stored, floating point with three axes, and the mask `valid`, bool [h, w], if there is one.

    A file of several arrays keeps the features under one of FEATURE_KEYS.

    Raises:
        InputError: The file is missing, damaged, or holds no such array.
    """
    content = _load_tensors(path)
    valid = content.pop(VALID_KEY, None)
    names = [key for key in FEATURE_KEYS if key in content] or list(content)
    if len(names) != 1:
        raise InputError(f"{path}: holds {', '.join(names) or 'nothing'}; store one array, or name it 'features'")
    features = content[names[0]]
    if features.ndim != 3 or not features.is_floating_point():
        raise InputError(
            f"{path}: expected floating point [C, h, w] or [h, w, C], got {features.dtype} {list(features.shape)}"
        )
    return features, None if valid is None else valid.to(torch.bool)


def channels_last(path: Path, features: Tensor, size: tuple[int, int], layout: Layout | None) -> Tensor:
    """Features as [h, w, C].

    Args:
        path: The file, for the message.
        features: As stored, three axes.
        size: (height, width) of the view; the map may be smaller but has the same shape.
        layout: How they are stored; if None, the two axes that have the shape of the view are taken for h and w.

    Raises:
        InputError: The given layout, or both, or none, have the shape of the view.
    """
    a, b, c = features.shape
    fits = {"chw": same_shape((b, c), size), "hwc": same_shape((a, b), size)}
    view = f"{size[0]} x {size[1]} (h x w)"
    if layout is not None and not fits[layout]:
        raise InputError(f"{path}: {[a, b, c]} read as {layout} does not have the shape of the view, {view}")
    if layout is None and all(fits.values()):
        raise InputError(f"{path}: {[a, b, c]} may be chw or hwc; say which with files:DIR?layout=chw or hwc")
    if not any(fits.values()):
        raise InputError(f"{path}: {[a, b, c]} does not have the shape of the view, {view}, as chw or as hwc")
    return features.movedim(0, 2) if (layout or ("chw" if fits["chw"] else "hwc")) == "chw" else features


def _load_tensors(path: Path) -> dict[str, Tensor]:
    """Every array of a file by name; an unnamed one is called 'features'."""
    if path.suffix == ".npy":
        return {"features": _tensor(path, read_array(path))}
    if path.suffix == ".npz":
        return {name: _tensor(path, array) for name, array in read_arrays(path).items()}
    if path.suffix == ".safetensors":
        return read_tensors(path)[1]
    content = load_torch(path)
    if isinstance(content, Tensor):
        return {"features": content}
    if isinstance(content, Mapping):
        return {str(name): value for name, value in content.items() if isinstance(value, Tensor)}
    raise InputError(f"{path}: holds a {type(content).__name__}; expected a tensor or a dict of tensors")


def _tensor(path: Path, array: NDArray[Any]) -> Tensor:
    try:
        return torch.from_numpy(array)
    except TypeError:
        raise InputError(f"{path}: holds {array.dtype}; expected numbers that PyTorch knows") from None
