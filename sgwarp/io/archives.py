"""Arrays in .npz archives, read slice by slice: a sequence of frames never lies in memory as a whole."""

from __future__ import annotations

import io
import os
import struct
import zipfile
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from sgwarp.errors import InputError
from sgwarp.files.access import reading
from sgwarp.files.archives import DAMAGES, unpacked_limit
from sgwarp.files.arrays import LONGEST_HEADER, read_header

LOCAL_HEADER = 30  # bytes of a zip member's local header before its name
CHUNK = 1 << 20  # skipped at once in a compressed member [bytes]


class StackedArray:
    """One array of an archive; `row(t)` reads its t-th slice along the first axis.

    Stored members are read where they lie. Compressed ones are read forward from where the last slice ended, and from
    the start where an earlier slice is asked for.

    Attributes:
        shape: Of the whole array.
        dtype: A floating point or integer type.
    """

    def __init__(self, path: Path, archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> None:
        self.path, self.name = path, member.filename.removesuffix(".npy")
        self._archive, self._member = archive, member
        self._stream: IO[bytes] | None = None
        with archive.open(member) as stream:
            head = io.BytesIO(stream.read(LONGEST_HEADER))
        self.shape, self.dtype = self._header(head)
        self._start = head.tell()
        self._at = 0  # of the stream, behind the header
        self._check_size()

    def _header(self, head: io.BytesIO) -> tuple[tuple[int, ...], np.dtype[Any]]:
        dtype, shape, fortran = read_header(f"{self.path}: array '{self.name}'", head)
        if fortran and len(shape) > 1:
            raise InputError(f"{self.path}: array '{self.name}' is in Fortran order; save it with order C")
        return shape, dtype

    def _check_size(self) -> None:
        wanted = self._start + int(np.prod(self.shape, dtype=object)) * self.dtype.itemsize
        if self._member.file_size != wanted:
            held = self._member.file_size
            raise InputError(
                f"{self.path}: array '{self.name}' of shape {list(self.shape)} needs {wanted} bytes, the archive holds "
                f"{held}; copy or download it again"
            )
        size = os.path.getsize(self.path)
        stored = self._member.compress_type == zipfile.ZIP_STORED
        if wanted > (size if stored else unpacked_limit(size)):
            raise InputError(
                f"{self.path}: array '{self.name}' claims {wanted} bytes in a file of {size}; store it uncompressed"
            )

    @property
    def row_bytes(self) -> int:
        return int(np.prod(self.shape[1:], dtype=object)) * self.dtype.itemsize

    def row(self, index: int) -> NDArray[Any]:
        """Slice `index` along the first axis.

        Raises:
            InputError: The archive is damaged or cut short there.
        """
        if not 0 <= index < self.shape[0]:
            raise IndexError(f"{self.path}: '{self.name}' has {self.shape[0]} slices, there is none of number {index}")
        return self._read(index * self.row_bytes, self.row_bytes).reshape(self.shape[1:])

    def whole(self) -> NDArray[Any]:
        """The whole array."""
        return self._read(0, self.row_bytes * self.shape[0]).reshape(self.shape)

    def _read(self, start: int, count: int) -> NDArray[Any]:
        try:
            with reading(self.path):
                stored = self._member.compress_type == zipfile.ZIP_STORED
                data = self._stored(start, count) if stored else self._compressed(start, count)
        except InputError:
            raise
        except DAMAGES as error:
            raise InputError(f"{self.path}: array '{self.name}' is damaged ({error}); download it again") from None
        if len(data) != count:
            raise InputError(f"{self.path}: array '{self.name}' is cut short; copy or download it again")
        return np.frombuffer(data, self.dtype)

    def _stored(self, start: int, count: int) -> bytes:
        with open(self.path, "rb") as file:
            file.seek(self._member.header_offset)
            head = file.read(LOCAL_HEADER)
            if len(head) < LOCAL_HEADER:
                return b""
            name, extra = struct.unpack_from("<HH", head, 26)
            file.seek(self._member.header_offset + LOCAL_HEADER + name + extra + self._start + start)
            return file.read(count)

    def _compressed(self, start: int, count: int) -> bytes:
        if self._stream is None or start < self._at:
            self.close()
            self._stream, self._at = self._archive.open(self._member), 0
            self._stream.read(self._start)
        while self._at < start:
            skipped = len(self._stream.read(min(CHUNK, start - self._at)))
            if not skipped:
                return b""
            self._at += skipped
        data = self._stream.read(count)
        self._at += len(data)
        return data

    def close(self) -> None:
        """Let go of the compressed stream."""
        if self._stream is not None:
            self._stream.close()
            self._stream = None


def open_stacks(path: str | os.PathLike[str]) -> dict[str, StackedArray]:
    """The arrays of an .npz archive by name, none of them read.

    Raises:
        InputError: The file is missing, no archive of arrays, damaged, or holds pickled objects.
    """
    path = Path(path)
    try:
        with reading(path):
            archive = zipfile.ZipFile(path)
            members = [member for member in archive.infolist() if member.filename.endswith(".npy")]
            arrays = [StackedArray(path, archive, member) for member in members]
    except InputError:
        raise
    except DAMAGES as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: is not an .npz archive of arrays ({reason})") from None
    return {array.name: array for array in arrays}
