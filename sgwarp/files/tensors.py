"""safetensors files: read without mapping them, written so that the same tensors give the same bytes.

The library itself maps files, and its writer puts the metadata in an order that changes from run to run.
Source of the layout: huggingface/safetensors, README, read for the format only.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Collection, Mapping, Sequence
from typing import Any, BinaryIO, TypeGuard

import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.files.access import open_input
from sgwarp.files.atomic import atomic_path
from sgwarp.files.documents import parse_json

ALIGNMENT = 8  # bytes; the format asks for it
CODES = {
    torch.float64: "F64",
    torch.float32: "F32",
    torch.float16: "F16",
    torch.bfloat16: "BF16",
    torch.int64: "I64",
    torch.int32: "I32",
    torch.int16: "I16",
    torch.int8: "I8",
    torch.uint8: "U8",
    torch.bool: "BOOL",
}
TYPES = {code: dtype for dtype, code in CODES.items()} | {
    "U16": torch.uint16,
    "U32": torch.uint32,
    "U64": torch.uint64,
    "F8_E4M3": torch.float8_e4m3fn,
    "F8_E5M2": torch.float8_e5m2,
    "C64": torch.complex64,
}
LONGEST_HEADER = 100_000_000  # bytes, as the library has it
MOST_AXES = 64


def read_tensors(
    path: str | os.PathLike[str], names: Collection[str] | None = None
) -> tuple[dict[str, str], dict[str, Tensor]]:
    """Metadata and tensors of a safetensors file.

    The numbers are read, not mapped: a file that shrinks under a mapping ends the process (SIGBUS).

    Args:
        path: The file.
        names: Only these tensors, as far as they are there; all of them if None.

    Raises:
        InputError: The file is missing, cut short or of another kind.
    """
    with open_input(path) as file:
        size = os.fstat(file.fileno()).st_size
        length = int.from_bytes(file.read(8), "little")
        if size < 8 or length > min(size - 8, LONGEST_HEADER):
            raise _damaged(path, f"{size} bytes, its header should have {length}")
        metadata, places = _header(path, file.read(length), size - 8 - length)
        found = {}
        for name, (dtype, shape, begin) in places.items():
            if names is None or name in names:
                file.seek(8 + length + begin)
                found[name] = _tensor(path, file, name, dtype, shape)
    return metadata, found


def _header(
    path: str | os.PathLike[str], text: bytes, there: int
) -> tuple[dict[str, str], dict[str, tuple[torch.dtype, list[int], int]]]:
    """Metadata, and type, shape and first byte of every tensor; together they fill the `there` bytes behind."""
    try:
        header = parse_json(path, text)
    except InputError:
        header = None
    if not isinstance(header, dict):
        raise _damaged(path, "its header is no JSON object")
    metadata = header.pop("__metadata__", None) or {}
    if not isinstance(metadata, dict) or not all(isinstance(value, str) for value in metadata.values()):
        raise _damaged(path, "its metadata are no texts")
    places, ends = {}, []
    for name, entry in header.items():
        if not isinstance(entry, dict):
            raise _damaged(path, f"tensor {name[:80]!r} is not described")
        dtype, shape, offsets = (entry.get(key) for key in ("dtype", "shape", "data_offsets"))
        if not isinstance(dtype, str) or dtype not in TYPES:
            raise _damaged(path, f"tensor {name[:80]!r} is of type {str(dtype)[:20]!r}, which is not read")
        if not _whole(shape) or len(shape) > MOST_AXES or not _whole(offsets) or len(offsets) != 2:
            raise _damaged(path, f"tensor {name[:80]!r} has no shape or place")
        if math.prod(shape) * TYPES[dtype].itemsize != offsets[1] - offsets[0]:
            raise _damaged(path, f"tensor {name[:80]!r} has {offsets[1] - offsets[0]} bytes, which is not its shape")
        places[name] = TYPES[dtype], shape, offsets[0]
        ends.append((offsets[0], offsets[1]))
    end = 0
    for first, last in sorted(ends):  # one behind the other: none is read twice, and no byte means nothing
        if first != end:
            raise _damaged(path, "its tensors overlap, or leave gaps")
        end = last
    if end != there:
        raise _damaged(path, f"its tensors need {end} bytes, there are {there}")
    return metadata, places


def _whole(values: Any) -> TypeGuard[list[int]]:
    return isinstance(values, list) and all(type(value) is int and 0 <= value < 2**62 for value in values)


def _tensor(
    path: str | os.PathLike[str], file: BinaryIO, name: str, dtype: torch.dtype, shape: Sequence[int]
) -> Tensor:
    """The next numbers of the file."""
    tensor = torch.empty(shape, dtype=torch.uint8 if dtype == torch.bool else dtype)
    if tensor.numel():
        view = tensor.reshape(-1).view(torch.uint8).numpy().data
        if file.readinto(view) != len(view):  # type: ignore[attr-defined]
            raise _damaged(path, f"it ends in tensor {name[:80]!r}")
    # A byte that is neither 0 nor 1 is no bool, to any library.
    return tensor != 0 if dtype == torch.bool else tensor


def _damaged(path: str | os.PathLike[str], why: str) -> InputError:
    return InputError(f"{path}: is not a safetensors file, or is cut short ({why})")


def write_tensors(
    path: str | os.PathLike[str], tensors: Mapping[str, Tensor], metadata: Mapping[str, str] | None = None
) -> None:
    """Write a safetensors file, whole or not at all; its bytes depend on nothing but the arguments.

    Args:
        path: The file.
        tensors: By name, of the types in CODES, on any device.
        metadata: Texts by name.

    Raises:
        InputError: It cannot be written.
    """
    order = sorted(tensors, key=lambda name: (-tensors[name].element_size(), name))  # wide numbers first: all aligned
    header: dict[str, object] = {"__metadata__": dict(sorted((metadata or {}).items()))} if metadata else {}
    position = 0
    for name in order:
        tensor = tensors[name]
        end = position + tensor.numel() * tensor.element_size()
        header[name] = {
            "dtype": CODES[tensor.dtype],
            "shape": list(tensor.shape),
            "data_offsets": [position, end],
        }
        position = end
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % ALIGNMENT)
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write(len(text).to_bytes(8, "little") + text)
        for name in order:
            flat = tensors[name].detach().to("cpu").contiguous().reshape(-1)
            if flat.numel():
                file.write(flat.view(torch.uint8).numpy().data)
