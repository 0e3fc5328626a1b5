"""Zstandard streams, by the standard library (Python 3.14) or the package `zstandard`."""

from __future__ import annotations

import os
from typing import Any

from sgwarp.errors import InputError

PIECE = 1 << 20  # bytes


def decompress_zstd(path: str | os.PathLike[str], data: Any, size: int) -> bytes:
    """Exactly `size` bytes of one stream; what it claims of itself is not believed.

    Raises:
        InputError: It is damaged, holds another number of bytes, or no decoder is installed.
    """
    reader, failure = _reader(path, bytes(data))
    # Read in pieces: memory grows with what comes, not with what was promised.
    pieces, missing = [], size
    try:
        while missing and (piece := reader.read(min(PIECE, missing))):
            pieces.append(piece)
            missing -= len(piece)
    except (failure, EOFError) as error:
        raise InputError(f"{path}: a Zstandard stream is damaged ({error}); copy or download it again") from None
    if missing:
        raise InputError(
            f"{path}: a Zstandard stream holds {size - missing} of {size} bytes; copy or download it again"
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


def _reader(path: str | os.PathLike[str], data: bytes) -> tuple[Any, type[Exception]]:
    """A file object of the unpacked bytes, and the error it raises."""
    import io

    try:
        from compression import zstd
    except ImportError:
        package = _package(path)
        return package.ZstdDecompressor(max_window_size=1 << 27).stream_reader(io.BytesIO(data)), package.ZstdError
    return zstd.ZstdFile(io.BytesIO(data)), zstd.ZstdError


def _package(path: str | os.PathLike[str]) -> Any:
    try:
        import zstandard
    except ImportError:
        raise InputError(f'{path}: SPZ version 4 needs zstandard: pip install "sgwarp[cli]"') from None
    return zstandard
