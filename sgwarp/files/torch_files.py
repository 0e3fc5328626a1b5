"""What `torch.save` wrote, read without an unpickler: tensors, containers, plain values; nothing of the file runs.

Both containers are read: the zip archive (since PyTorch 1.6) and the stream of pickles before it. Sizes, strides and
storages are checked against the bytes that are there before a tensor is made of them. Whatever is no tensor, container
or plain value (settings of a trainer, NumPy's scalars, classes of any kind) comes back as `pickled.Inert`.

Source of the layout: torch/serialization.py and torch/_utils.py of PyTorch 2, read for the format only.
"""

from __future__ import annotations

import io
import os
import struct
from collections.abc import Callable, Iterable
from typing import Any, BinaryIO

import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.files.access import open_input
from sgwarp.files.archives import Archive, open_archive
from sgwarp.files.atomic import atomic_path
from sgwarp.files.pickled import PLAIN_KEYS, Name, Table, UnpickleError, read_pickle

ZIP_SIGNATURE = b"PK\x03\x04"
PICKLE_SIGNATURE = b"\x80\x02"  # what the older container begins with
MAGIC = 0x1950A86A20F9469CFC6C  # of the older container
LARGEST_COPIES = 4  # a tensor may name its numbers more than once (stride 0): so often, beyond ALLOWANCE bytes
ALLOWANCE = 64 * 2**20
STORAGES = {
    "DoubleStorage": torch.float64,
    "FloatStorage": torch.float32,
    "HalfStorage": torch.float16,
    "BFloat16Storage": torch.bfloat16,
    "LongStorage": torch.int64,
    "IntStorage": torch.int32,
    "ShortStorage": torch.int16,
    "CharStorage": torch.int8,
    "ByteStorage": torch.uint8,
    "BoolStorage": torch.bool,
    "ComplexFloatStorage": torch.complex64,
    "ComplexDoubleStorage": torch.complex128,
}

Buffers = Callable[[str, int], memoryview]  # bytes of a storage by its key; the second number is how many are claimed


def load_torch(path: str | os.PathLike[str]) -> Any:
    """The content of a file of torch.save; tensors lie on the CPU.

    Raises:
        InputError: The file is missing, cut short, damaged, or was not written by torch.save.
    """
    with open_input(path) as file:
        head = file.read(4)
        size = os.fstat(file.fileno()).st_size
        try:
            if head == ZIP_SIGNATURE:
                with open_archive(path) as archive:
                    return _from_archive(archive, _File(path, file, size))
            if head.startswith(PICKLE_SIGNATURE):
                return _from_stream(_File(path, file, size))
        except UnpickleError as error:
            raise InputError(f"{path}: is not a file of plain tensors, or is damaged ({error})") from None
    what = "is empty" if not size else "is damaged, or was not written by torch.save"
    raise InputError(f"{path}: {what}; give a file of tensors")


def save_torch(path: str | os.PathLike[str], content: Any) -> None:
    """Write what `load_torch` reads, whole or not at all.

    Raises:
        InputError: It cannot be written.
    """
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        try:
            torch.save(content, file)
        except RuntimeError as error:  # of the container's writer, after the disk said no
            if error.__context__ is None or not isinstance(error.__context__, OSError):
                raise
            raise error.__context__ from None


class _File:
    """A file's bytes, by position or one after the other.

    They are read, not mapped: a file that shrinks under a mapping ends the process (SIGBUS).
    """

    def __init__(self, path: str | os.PathLike[str], file: BinaryIO, size: int) -> None:
        self.path, self.size, self._file = path, size, file

    def take(self, start: int, count: int) -> memoryview:
        """`count` bytes from `start` on; what is read next stays what it was.

        Raises:
            InputError: The file ends before.
        """
        if start + count > self.size:
            raise self._short()
        part, place = memoryview(bytearray(count)), self._file.tell()
        self._file.seek(start)
        filled = self._file.readinto(part)  # type: ignore[attr-defined]
        self._file.seek(place)
        if filled != count:
            raise self._short()
        return part

    def read(self, count: int = -1) -> bytes:
        """Up to `count` bytes; a number beyond the end takes no memory."""
        left = max(self.size - self._file.tell(), 0)
        return self._file.read(left if count < 0 else min(count, left))

    def readline(self) -> bytes:
        return self._file.readline()

    def tell(self) -> int:
        return self._file.tell()

    def seek(self, position: int) -> None:
        self._file.seek(position)

    def _short(self) -> InputError:
        return InputError(f"{self.path}: is cut short ({self.size} bytes); copy or download it again")


def _from_archive(archive: Archive, pages: _File) -> Any:
    pickles = [name for name in archive.members if name.endswith("/data.pkl") or name == "data.pkl"]
    if len(pickles) != 1:
        raise InputError(f"{archive.path}: was not written by torch.save (holds no data.pkl); give a file of tensors")
    root = pickles[0].removesuffix("data.pkl")
    if f"{root}byteorder" in archive.members and archive.read(f"{root}byteorder") != b"little":
        raise InputError(f"{archive.path}: was written on a big-endian machine; save it again on this kind")

    def buffer(key: str, claimed: int) -> memoryview:
        name = f"{root}data/{key}"
        start = archive.position(name)
        content = memoryview(archive.read(name)) if start is None else None
        there = archive.members[name].file_size
        if claimed != there:
            raise UnpickleError(f"storage {key!r} should have {claimed} bytes, has {there}")
        return content if content is not None else pages.take(start or 0, there)

    return _read(io.BytesIO(bytes(archive.read(pickles[0]))), buffer, archive.size)


def _from_stream(pages: _File) -> Any:
    """The older container: magic number, version, machine, the object, keys of the storages, and those one by one."""
    stream = pages
    stream.seek(0)

    def nothing(key: str, claimed: int) -> memoryview:
        raise _LaterError(key, claimed)

    if _read(stream, nothing, 0) != MAGIC:
        raise InputError(f"{pages.path}: was not written by torch.save; give a file of tensors")
    version, machine = _read(stream, nothing, 0), _read(stream, nothing, 0)
    if version != 1001 or not isinstance(machine, dict) or machine.get("little_endian") is not True:
        raise InputError(f"{pages.path}: is of a version or machine that is not read; save it again with torch.save")
    begin = stream.tell()
    sizes: dict[str, int] = {}
    read_pickle(stream, {}, lambda identity: _note(sizes, identity))  # type: ignore[arg-type]
    keys = _read(stream, nothing, 0)
    if not isinstance(keys, list) or not all(isinstance(key, str) for key in keys):
        raise UnpickleError("malformed (its list of storages)")
    position = stream.tell()
    places: dict[str, int] = {}
    for key in keys:
        (count,) = struct.unpack("<q", pages.take(position, 8))
        claimed = sizes.get(key, -1)
        if claimed < 0 or count < 0 or (count and claimed % count):
            raise UnpickleError(f"storage {key!r} has {count} numbers, which fits nothing")
        places[key] = position + 8
        position += 8 + claimed

    def buffer(key: str, claimed: int) -> memoryview:
        if key not in places:
            raise UnpickleError(f"storage {key!r} is not there")
        return pages.take(places[key], claimed)

    stream.seek(begin)
    return _read(stream, buffer, pages.size)


class _LaterError(UnpickleError):
    """A storage where there can be none."""

    def __init__(self, key: str, claimed: int) -> None:
        super().__init__(f"malformed (storage {key!r} of {claimed} bytes in the wrong place)")


def _note(sizes: dict[str, int], identity: Any) -> None:
    key, dtype, count = _storage_identity(identity)
    sizes[key] = count * dtype.itemsize


class _Storage:
    """A run of numbers that tensors lie in."""

    def __init__(self, dtype: torch.dtype, flat: Tensor) -> None:
        self.dtype, self.flat = dtype, flat


def _storage_identity(identity: Any) -> tuple[str, torch.dtype, int]:
    """Key, type and count of a persistent id."""
    if not isinstance(identity, tuple) or len(identity) not in (5, 6) or identity[0] != "storage":
        raise UnpickleError("malformed (a reference that is no storage)")
    _, kind, key, _, count, *rest = identity
    if not isinstance(kind, Name) or not isinstance(key, str) or type(count) is not int or not 0 <= count < 2**48:
        raise UnpickleError("malformed (a storage without type, key or size)")
    if rest and rest[0] is not None:
        raise UnpickleError("uses views of storages, as PyTorch 0.3 did; save it again with a newer one")
    module, name = kind.key
    if kind.key == ("torch.storage", "UntypedStorage"):
        return key, torch.uint8, count
    if module not in ("torch", "torch.cuda") or name not in STORAGES:
        raise UnpickleError(f"has a storage of type {module}.{name}, which is not read")
    return key, STORAGES[name], count


def _read(stream: Any, buffers: Buffers, size: int) -> Any:
    storages: dict[str, _Storage] = {}

    def persistent(identity: Any) -> _Storage:
        key, dtype, count = _storage_identity(identity)
        if key not in storages:
            data = buffers(key, count * dtype.itemsize)
            flat = torch.frombuffer(data, dtype=torch.uint8) if len(data) else torch.empty(0, dtype=torch.uint8)
            storages[key] = _Storage(dtype, flat)
        return storages[key]

    return read_pickle(stream, _table(LARGEST_COPIES * size + ALLOWANCE), persistent)


def _table(largest: int) -> Table:
    """What stands in for the functions that torch.save names; every other name stays inert.

    Args:
        largest: Bytes of a tensor, written out, at most.
    """

    def strided(storage: Any, offset: Any, size: Any, stride: Any, *_: Any) -> Tensor:
        if not isinstance(storage, _Storage):
            raise UnpickleError("malformed (a tensor without storage)")
        return _strided(storage.flat, storage.dtype, offset, size, stride, largest)

    def strided_typed(storage: Any, offset: Any, size: Any, stride: Any, _: Any, __: Any, dtype: Any, *___: Any) -> Any:
        if not isinstance(storage, _Storage) or not isinstance(dtype, Name) or dtype.key[0] != "torch":
            raise UnpickleError("malformed (a tensor without storage or type)")
        known = getattr(torch, dtype.key[1], None) if dtype.key[1].isidentifier() else None
        if not isinstance(known, torch.dtype) or known.itemsize < 1:
            raise UnpickleError(f"has a tensor of type {dtype.key[1]}, which is not read")
        return _strided(storage.flat, known, offset, size, stride, largest)

    def parameter(tensor: Any, *_: Any) -> Tensor:
        if not isinstance(tensor, Tensor):
            raise UnpickleError("malformed (a parameter that is no tensor)")
        return tensor

    def of_type(function: Any, _: Any, arguments: Any, __: Any) -> Tensor:
        build = table.get(function.key) if isinstance(function, Name) else None
        if build not in (strided, strided_typed, parameter) or not isinstance(arguments, tuple):
            raise UnpickleError("has a tensor of a class that is not read")
        return build(*arguments)

    table: dict[tuple[str, str], Callable[..., Any]] = {
        ("torch._utils", "_rebuild_tensor"): strided,
        ("torch._utils", "_rebuild_tensor_v2"): strided,
        ("torch._utils", "_rebuild_tensor_v3"): strided_typed,
        ("torch._utils", "_rebuild_parameter"): parameter,
        ("torch._utils", "_rebuild_parameter_with_state"): parameter,
        ("torch._tensor", "_rebuild_from_type_v2"): of_type,
        ("torch", "Size"): lambda sizes=(): tuple(sizes),
        ("collections", "OrderedDict"): _ordered,
        ("_codecs", "encode"): _latin,
    }
    return table


def _ordered(pairs: Iterable[Any] = ()) -> dict[Any, Any]:
    """What fills an OrderedDict when it is made; usually nothing, and its items follow."""
    found = {}
    for pair in pairs:
        if isinstance(pair, (list, tuple)) and len(pair) == 2 and isinstance(pair[0], PLAIN_KEYS):
            found[pair[0]] = pair[1]
    return found


def _latin(text: Any, encoding: Any) -> bytes:
    """Bytes, which protocol 2 stores as text."""
    if not isinstance(text, str) or encoding != "latin1":
        raise UnpickleError("malformed (bytes)")
    return text.encode("latin1")


def _strided(flat: Tensor, dtype: torch.dtype, offset: Any, size: Any, stride: Any, largest: int) -> Tensor:
    """A tensor in a storage, if all of it lies inside."""
    axes = isinstance(size, tuple) and isinstance(stride, tuple) and len(size) == len(stride) <= 64
    if not axes or not all(type(n) is int and 0 <= n < 2**48 for n in (offset, *size, *stride)):
        raise UnpickleError("malformed (size or stride of a tensor)")
    numbers = 1
    for extent in size:
        numbers *= extent
    if numbers * dtype.itemsize > largest:
        raise UnpickleError(
            f"has a tensor {list(size)} of {numbers * dtype.itemsize} bytes, more than the file can hold"
        )
    last = offset + sum((extent - 1) * step for extent, step in zip(size, stride, strict=True))
    there = len(flat) // dtype.itemsize
    if numbers and last >= there:
        raise UnpickleError(f"has a tensor {list(size)} that reaches beyond its storage of {there} numbers")
    if not numbers:
        return torch.empty(size, dtype=dtype)
    if dtype == torch.bool:
        flat = (flat != 0).to(torch.uint8)  # any other byte is no bool, to any library
    return flat[: there * dtype.itemsize].view(dtype).as_strided(size, stride, offset)
