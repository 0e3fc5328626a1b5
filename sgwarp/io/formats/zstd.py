"""Zstandard streams, by the standard library (Python 3.14) or the package `zstandard`."""

from __future__ import annotations

import os
from typing import Any

from sgwarp.errors import InputError

PIECE = 1 << 20  # bytes


class ZstdStream:
    """The unpacked bytes of one stream, some at a time; what it claims of itself is not believed."""

    def __init__(self, path: str | os.PathLike[str], data: Any, size: int) -> None:
        self.path, self._data, self._size = path, data, size
        self._given = 0
        self._reader: Any = None
        self._failure: type[Exception] = Exception

    def read(self, count: int) -> bytes:
        """Exactly `count` bytes.

        Raises:
            InputError: The stream is damaged, ends before, or no decoder is installed.
        """
        if self._reader is None:
            self._reader, self._failure = _reader(self.path, self._data)
        # Read in pieces: memory grows with what comes, not with what was promised.
        pieces, missing = [], count
        try:
            while missing and (piece := self._reader.read(min(PIECE, missing))):
                pieces.append(piece)
                missing -= len(piece)
        except (self._failure, EOFError) as error:
            raise InputError(
                f"{self.path}: a Zstandard stream is damaged ({error}); copy or download it again"
            ) from None
        self._given += count - missing
        if missing:
            raise InputError(
                f"{self.path}: a Zstandard stream holds {self._given} of {self._size} bytes; copy or download it again"
            )
        return b"".join(pieces)


def compress_zstd(path: str | os.PathLike[str], data: bytes) -> bytes:
    """One stream.

    Raises:
        InputError: No encoder is installed.
    """
    try:
        from compression import zstd
    except ImportError:
        return bytes(_package(path).ZstdCompressor().compress(data))
    return bytes(zstd.compress(data))


class _Packed:
    """A part of a file as a file object; `io.BytesIO` would copy it."""

    def __init__(self, data: Any) -> None:
        self._data, self._at = memoryview(data), 0

    def read(self, count: int = -1) -> bytes:
        piece = bytes(self._data[self._at :] if count < 0 else self._data[self._at : self._at + count])
        self._at += len(piece)
        return piece


def _reader(path: str | os.PathLike[str], data: Any) -> tuple[Any, type[Exception]]:
    """A file object of the unpacked bytes, and the error it raises."""
    try:
        from compression import zstd
    except ImportError:
        package = _package(path)
        return package.ZstdDecompressor(max_window_size=1 << 27).stream_reader(_Packed(data)), package.ZstdError
    return zstd.ZstdFile(_Packed(data)), zstd.ZstdError


def _package(path: str | os.PathLike[str]) -> Any:
    try:
        import zstandard
    except ImportError:
        raise InputError(f'{path}: SPZ version 4 needs zstandard: pip install "sgwarp[cli]"') from None
    return zstandard
