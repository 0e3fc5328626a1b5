"""Compressed files, unpacked only as far as their size allows.

Deflate can make a thousand bytes out of one. An archive may unpack to `LARGEST_RATIO` times its own size plus
`ALLOWANCE`, which id maps and masks of real views stay within; what claims more is refused before it is unpacked.
"""

from __future__ import annotations

import os
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager

from sgwarp.errors import InputError
from sgwarp.files.access import open_input

LARGEST_RATIO = 256
ALLOWANCE = 64 * 2**20  # bytes
PIECE = 2**20  # bytes unpacked at a time
LOCAL_HEADER = 30  # bytes of a member's own header, before its name


def unpacked_limit(size: int) -> int:
    """How many bytes a compressed file of `size` bytes may unpack to."""
    return LARGEST_RATIO * size + ALLOWANCE


# What zipfile and zlib object to; a member that asks for a password is a RuntimeError.
DAMAGES = (zipfile.BadZipFile, zlib.error, EOFError, OverflowError, RuntimeError, ValueError, struct.error)


class Archive:
    """A zip file whose members have been checked: none encrypted, sizes plausible, together within the limit.

    Attributes:
        path: For messages.
        size: Bytes of the file.
        members: What it holds, by name; of two with one name the last.
    """

    def __init__(self, path: str | os.PathLike[str], size: int, file: zipfile.ZipFile) -> None:
        self.path, self.size, self._file = path, size, file
        self.members = {info.filename: info for info in file.infolist() if info.filename[-1:] not in ("", "/")}
        total = sum(info.file_size for info in file.infolist())
        if total > unpacked_limit(size):
            raise InputError(
                f"{path}: claims to unpack to {total} bytes, more than {LARGEST_RATIO} times its {size}; store it "
                "uncompressed"
            )
        for info in file.infolist():
            stored = info.compress_type == zipfile.ZIP_STORED
            if not stored and info.compress_type != zipfile.ZIP_DEFLATED:
                raise InputError(f"{path}: member {info.filename!r} is neither stored nor deflated; pack it again")
            if info.flag_bits & 1:
                raise InputError(f"{path}: member {info.filename!r} is encrypted; store it without a password")
            if info.compress_size > size or (stored and info.file_size != info.compress_size):
                raise InputError(f"{path}: is cut short or damaged (member {info.filename!r}); copy it again")

    def read(self, name: str) -> bytearray:
        """The content of a member, unpacked piece by piece into memory of the size it claims.

        Raises:
            InputError: There is no such member, or it is damaged.
        """
        info = self.members.get(name)
        if info is None:
            raise InputError(f"{self.path}: has no member {name!r}; write it again")
        content = bytearray(info.file_size)
        filled = 0
        with _damages(self.path), self._file.open(info) as member:
            while filled < len(content) and (piece := member.read(PIECE)):
                content[filled : filled + len(piece)] = piece
                filled += len(piece)
            member.read(1)  # the checksum is compared at the end
        if filled != info.file_size:
            raise InputError(f"{self.path}: member {name!r} is cut short; copy it again")
        return content

    def position(self, name: str) -> int | None:
        """Where the bytes of a stored member begin in the file, None if it is compressed.

        Raises:
            InputError: There is no such member, or it lies beyond the end.
        """
        info = self.members.get(name)
        if info is None:
            raise InputError(f"{self.path}: has no member {name!r}; write it again")
        if info.compress_type != zipfile.ZIP_STORED:
            return None
        stream = self._file.fp
        assert stream is not None
        stream.seek(info.header_offset)
        header = stream.read(LOCAL_HEADER)
        if len(header) < LOCAL_HEADER or not header.startswith(b"PK\x03\x04"):
            raise InputError(f"{self.path}: is damaged (member {name!r}); copy it again")
        start = info.header_offset + LOCAL_HEADER + sum(struct.unpack_from("<HH", header, 26))
        if start + info.file_size > self.size:
            raise InputError(f"{self.path}: is cut short (member {name!r}); copy it again")
        return int(start)


@contextmanager
def open_archive(path: str | os.PathLike[str]) -> Iterator[Archive]:
    """Open a zip file.

    Raises:
        InputError: The file is missing or no zip file, or one of the things that `Archive` refuses.
    """
    with open_input(path) as file:
        size = os.fstat(file.fileno()).st_size
        with _damages(path):
            content = zipfile.ZipFile(file)
        with content:
            yield Archive(path, size, content)


def gunzip(path: str | os.PathLike[str], data: bytes, limit: int | None = None) -> bytes:
    """Unpack gzip or zlib data.

    Args:
        path: For messages.
        data: Compressed.
        limit: Refuse more bytes than this; `unpacked_limit` of the data if None.

    Raises:
        InputError: The data are damaged, cut short, or unpack to more.
    """
    largest = unpacked_limit(len(data)) if limit is None else limit
    pieces: list[bytes] = []
    total = 0
    rest = data
    with _damages(path):
        while rest:  # gzip files may be joined
            machine = zlib.decompressobj(wbits=47)
            piece = machine.decompress(rest, PIECE)
            while piece or not machine.eof:
                total += len(piece)
                if total > largest:
                    raise InputError(f"{path}: unpacks to more than {largest} bytes from {len(data)}; it is damaged")
                if not piece and not machine.unconsumed_tail:
                    raise InputError(f"{path}: is cut short; copy or download it again")
                pieces.append(piece)
                piece = machine.decompress(machine.unconsumed_tail, PIECE)
            rest = machine.unused_data if machine.unused_data.startswith(b"\x1f\x8b") else b""
    return b"".join(pieces)


@contextmanager
def _damages(path: str | os.PathLike[str]) -> Iterator[None]:
    """Turn what zipfile and zlib object to into an InputError."""
    try:
        yield
    except InputError:
        raise
    except DAMAGES as error:
        raise InputError(f"{path}: is no archive, or is damaged ({_line(error)}); copy it again") from None


def _line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
