"""Arrays of 2D features on disk: NumPy, PyTorch and safetensors files, channels first or last."""

from __future__ import annotations

import pickle
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.files.access import reading
from sgwarp.io.undistort import same_shape as same_shape

FEATURE_SUFFIXES = (".npy", ".npz", ".pt", ".pth", ".safetensors")
FEATURE_KEYS = ("features", "feat", "dense", "arr_0")  # of files that hold more than one array
VALID_KEY = "valid"

Layout = Literal["chw", "hwc"]


def load_array(path: Path) -> NDArray[Any]:
    """The array in a .npy file.

    Raises:
        InputError: The file is missing, damaged or holds Python objects.
    """
    with reading(path), open(path, "rb") as file:
        try:
            return np.lib.format.read_array(file, allow_pickle=False)
        except (ValueError, EOFError) as error:
            raise InputError(f"{path}: is not a NumPy array of numbers, or is cut short ({_line(error)})") from None


def load_archive(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays in an .npz file by name.

    Raises:
        InputError: The file is missing, damaged or holds Python objects.
    """
    with reading(path), open(path, "rb") as file:
        try:
            with np.load(file, allow_pickle=False) as content:
                if not isinstance(content, np.lib.npyio.NpzFile):
                    raise InputError(f"{path}: holds a single array; expected an .npz of arrays")
                return {name: content[name] for name in content.files}
        except (ValueError, EOFError, KeyError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"{path}: is not an .npz of arrays, or is damaged ({_line(error)})") from None


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
        return {"features": _tensor(path, load_array(path))}
    if path.suffix == ".npz":
        return {name: _tensor(path, array) for name, array in load_archive(path).items()}
    with reading(path), open(path, "rb") as file:
        try:
            if path.suffix == ".safetensors":
                return _load_safetensors(path)
            content = torch.load(file, map_location="cpu", weights_only=True)
        except (ValueError, EOFError, KeyError, RuntimeError, zipfile.BadZipFile, pickle.UnpicklingError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"{path}: is not a {path.suffix} file of arrays, or is damaged ({_line(error)})") from None
    if isinstance(content, Tensor):
        return {"features": content}
    if isinstance(content, Mapping):
        return {str(name): value for name, value in content.items() if isinstance(value, Tensor)}
    raise InputError(f"{path}: holds a {type(content).__name__}; expected a tensor or a dict of tensors")


def _load_safetensors(path: Path) -> dict[str, Tensor]:
    try:
        from safetensors import SafetensorError
        from safetensors.torch import load_file
    except ImportError:
        raise InputError(f'{path}: reading it needs safetensors: pip install "sgwarp[cli]"') from None
    try:
        return load_file(path)
    except SafetensorError as error:
        raise InputError(f"{path}: is not a safetensors file, or is damaged ({_line(error)})") from None


def _tensor(path: Path, array: NDArray[Any]) -> Tensor:
    try:
        return torch.from_numpy(array)
    except TypeError:
        raise InputError(f"{path}: holds {array.dtype}; expected numbers that PyTorch knows") from None


def _line(error: BaseException) -> str:
    """The first line of a library's message."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
