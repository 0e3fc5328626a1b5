"""safetensors files: read with the library's checks, written so that the same tensors give the same bytes.

The library's own writer puts the metadata in an order that changes from run to run.
"""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Mapping

import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.files.access import open_input, reading
from sgwarp.files.atomic import atomic_path

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


def read_tensors(
    path: str | os.PathLike[str], names: Collection[str] | None = None
) -> tuple[dict[str, str], dict[str, Tensor]]:
    """Metadata and tensors of a safetensors file.

    Args:
        path: The file.
        names: Only these tensors, as far as they are there; all of them if None.

    Raises:
        InputError: The file is missing, cut short or of another kind, or safetensors is not installed.
    """
    try:
        from safetensors import SafetensorError, safe_open
    except ImportError:
        raise InputError(f'{path}: reading it needs safetensors: pip install "sgwarp[cli]"') from None
    try:
        with open_input(path):  # says what is wrong with a folder or a missing file; safe_open does not
            pass
        with reading(path), safe_open(os.fspath(path), framework="pt") as content:
            kept = [name for name in content.keys() if names is None or name in names]  # noqa: SIM118
            return dict(content.metadata() or {}), {name: content.get_tensor(name) for name in kept}
    # Of a type that PyTorch has not, or with a shape that overflows.
    except (SafetensorError, ValueError, TypeError, KeyError, OverflowError, RuntimeError, AttributeError) as error:
        if isinstance(error, InputError):
            raise
        line = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise InputError(f"{path}: is not a safetensors file, or is cut short ({line})") from None


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
