"""The container of a glTF file: JSON, buffers, buffer views and accessors (glTF 2.0, sections 3.6 and 4)."""

from __future__ import annotations

import base64
import os
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from sgwarp.errors import InputError
from sgwarp.files.access import read_bytes
from sgwarp.files.documents import parse_json

MAGIC, JSON, BIN = b"glTF", 0x4E4F534A, 0x004E4942
COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
MOST_USES, ALLOWANCE = 4, 1 << 20  # of each byte; bytes beyond, for small files
# Extensions that pack the numbers of accessors; without them other numbers, or none, would be read.
PACKINGS = ("EXT_meshopt_compression", "KHR_meshopt_compression", "MESHOPT_compression", "KHR_draco_mesh_compression")
UNPACK = "export it without compression"
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


@dataclass(frozen=True)
class Document:
    """A glTF file.

    Attributes:
        path: The file.
        meta: Its JSON.
        buffers: The bytes of each buffer.
        taken: Bytes that were decoded so far, in its only item.
    """

    path: Path
    meta: Mapping[str, Any]
    buffers: list[memoryview]
    taken: list[int] = field(default_factory=lambda: [0])

    def take(self, count: int) -> None:
        """Note that `count` bytes of the buffers are decoded.

        Raises:
            InputError: They are all decoded again and again: a small file could name one array a million times.
        """
        self.taken[0] += count
        if self.taken[0] > MOST_USES * sum(len(data) for data in self.buffers) + ALLOWANCE:
            raise InputError(f"{self.path}: refers to its data more than {MOST_USES} times; export the scene again")

    def rows(self, key: str) -> list[Any]:
        """A list of the JSON, empty if it is not there."""
        rows = self.meta.get(key, [])
        return rows if isinstance(rows, list) else []

    def row(self, key: str, index: Any) -> Mapping[str, Any]:
        """One object of such a list.

        Raises:
            InputError: There is none.
        """
        rows = self.rows(key)
        if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < len(rows):
            raise InputError(f"{self.path}: refers to {key}[{index}], which it does not hold; it is damaged")
        if not isinstance(rows[index], dict):
            raise InputError(f"{self.path}: {key}[{index}] is no object; it is damaged")
        return dict(rows[index])

    def view(self, index: Any) -> memoryview:
        """The bytes of a buffer view.

        Raises:
            InputError: It does not lie within its buffer.
        """
        view = self.row("bufferViews", index)
        buffer = view.get("buffer")
        if not isinstance(buffer, int) or not 0 <= buffer < len(self.buffers):
            raise InputError(f"{self.path}: bufferViews[{index}] refers to buffer {buffer}, which it does not hold")
        data = self.buffers[buffer]
        start, size = self._whole(view, "byteOffset", 0), self._whole(view, "byteLength", -1)
        if size < 0 or start + size > len(data):
            raise InputError(f"{self.path}: bufferViews[{index}] lies outside its buffer; it is cut short or damaged")
        return data[start : start + size]

    def accessor(self, index: Any, width: int, name: str) -> NDArray[np.float32]:
        """The values of an accessor, float32 [N, width]; normalized integers become fractions.

        Raises:
            InputError: It has another width, is sparse, or does not lie within its buffer.
        """
        accessor = self.row("accessors", index)
        code = accessor.get("componentType")
        kind = COMPONENTS.get(code) if isinstance(code, int) else None
        if kind is None or WIDTHS.get(str(accessor.get("type"))) != width or "sparse" in accessor:
            raise InputError(f"{self.path}: attribute {name} must hold {width} numbers a row, not sparse")
        data, dtype = self.view(accessor.get("bufferView")), np.dtype(kind)
        count, start = self._whole(accessor, "count", -1), self._whole(accessor, "byteOffset", 0)
        row = width * dtype.itemsize
        stride = self._whole(self.row("bufferViews", accessor["bufferView"]), "byteStride", row)
        if count < 1 or stride < row or start + (count - 1) * stride + row > len(data):
            raise InputError(f"{self.path}: attribute {name} ({count} rows) lies outside its buffer; it is cut short")
        self.take(count * row)
        rows: NDArray[Any] = np.ndarray((count, width), dtype, data, start, (stride, dtype.itemsize))
        values = rows.astype(np.float32)
        if accessor.get("normalized") is True and dtype.kind in "iu":
            values = np.maximum(values / np.float32(np.iinfo(dtype).max), -1)
        return values

    def _whole(self, row: Mapping[str, Any], key: str, default: int) -> int:
        value = row.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int) or not -1 <= value < 1 << 40:
            raise InputError(f"{self.path}: '{key}' must be a whole number of bytes or rows, got {value!r}")
        return value


def read_document(path: str | os.PathLike[str]) -> Document:
    """Read a .glb or .gltf with its buffers.

    Raises:
        InputError: A file is missing or damaged.
    """
    path, data = Path(path), read_bytes(path)
    text, body = (data, None) if data[:4] != MAGIC else _chunks(path, data)
    meta = parse_json(path, text)
    if not isinstance(meta, dict) or not isinstance(meta.get("asset"), dict):
        raise InputError(f"{path}: is not a glTF file (no 'asset' in its JSON)")
    required = meta.get("extensionsRequired")
    packed = [name for name in required if name in PACKINGS] if isinstance(required, list) else []
    if packed:
        raise InputError(f"{path}: its data are packed ({packed[0]}), which is not read; {UNPACK}")
    buffers = []
    files: dict[str, memoryview] = {}  # each is read once, however often it is named
    listed = meta.get("buffers", [])
    for index, buffer in enumerate(listed if isinstance(listed, list) else []):
        uri = buffer.get("uri") if isinstance(buffer, dict) else None
        if uri is None and index == 0 and body is not None:
            buffers.append(body)
        else:
            if str(uri) not in files:
                files[str(uri)] = memoryview(_read_buffer(path, uri))
            buffers.append(files[str(uri)])
    return Document(path, meta, buffers)


def _chunks(path: Path, data: bytes) -> tuple[bytes, memoryview | None]:
    """JSON and binary chunk of a .glb."""
    if len(data) < 20 or struct.unpack_from("<I", data, 4)[0] != 2:
        raise InputError(f"{path}: is not binary glTF of version 2, or is cut short")
    chunks: dict[int, memoryview] = {}
    position = 12
    while position + 8 <= len(data):
        size, kind = struct.unpack_from("<II", data, position)
        if position + 8 + size > len(data):
            raise InputError(f"{path}: is cut short: a chunk of {size} bytes does not fit; copy or download it again")
        chunks.setdefault(kind, memoryview(data)[position + 8 : position + 8 + size])
        position += 8 + size + -size % 4
    if JSON not in chunks:
        raise InputError(f"{path}: has no JSON chunk; it is damaged")
    return bytes(chunks[JSON]), chunks.get(BIN)


def _read_buffer(path: Path, uri: Any) -> bytes:
    if not isinstance(uri, str):
        raise InputError(f"{path}: a buffer has neither 'uri' nor the binary chunk of a .glb; it is damaged")
    if uri.startswith("data:"):
        try:
            return base64.b64decode(uri.partition(",")[2], validate=True)
        except ValueError as error:  # of binascii, or of a text that is not ASCII
            raise InputError(f"{path}: a buffer's data are damaged ({error})") from None
    name = Path(unquote(uri))
    if name.is_absolute() or ".." in name.parts or "://" in uri:
        raise InputError(f"{path}: its buffer {uri[:80]!r} lies outside its folder; only files beside it are read")
    return read_bytes(path.parent / name)
