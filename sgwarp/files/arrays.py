"""NumPy's files, read after a look at their size: .npy and .npz with numbers, in either byte order."""

from __future__ import annotations

import io
import math
import os
from typing import Any, BinaryIO

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from sgwarp.errors import InputError
from sgwarp.files.access import open_input, reading
from sgwarp.files.archives import open_archive

NUMBERS = "biufc"  # kinds of dtype: bool, signed, unsigned, floating, complex
LAST_CODE = 0x10FFFF  # of Unicode
MOST_AXES = 32  # of any NumPy
LONGEST_HEADER = npy.MAGIC_LEN + 4 + (1 << 16)  # that is read [bytes]


def read_array(path: str | os.PathLike[str]) -> NDArray[Any]:
    """The array in a .npy file, in the byte order of this machine.

    Raises:
        InputError: The file is missing, damaged or cut short, or holds something other than numbers.
    """
    with open_input(path) as file:
        dtype, shape, fortran = read_header(path, file)
        begin, end = file.tell(), os.fstat(file.fileno()).st_size
        _check_size(path, dtype, shape, end - begin)
        with reading(path):
            values = np.fromfile(file, dtype, math.prod(shape))
    return _shaped(path, values, shape, fortran)


def read_arrays(path: str | os.PathLike[str], texts: bool = False) -> dict[str, NDArray[Any]]:
    """The arrays in an .npz file by name; with `texts`, arrays of strings too.

    Raises:
        InputError: The file is missing, damaged or cut short, holds something other than numbers, or unpacks to more
            than `archives.unpacked_limit`.
    """
    arrays = {}
    with open_archive(path) as archive:
        for name in archive.members:
            if name.endswith(".npy"):
                arrays[name.removesuffix(".npy")] = parse_array(f"{path}: {name!r}", archive.read(name), texts)
    return arrays


def parse_array(where: str, data: bytes | bytearray, texts: bool = False) -> NDArray[Any]:
    """The array in the bytes of a .npy file; it shares their memory if they can be written to.

    Raises:
        InputError: As `read_array`.
    """
    # Only the header goes through a stream, which would copy the rest.
    stream = io.BytesIO(bytes(data[:LONGEST_HEADER]))
    dtype, shape, fortran = read_header(where, stream, texts)
    _check_size(where, dtype, shape, len(data) - stream.tell())
    values = np.frombuffer(data, dtype, math.prod(shape), stream.tell())
    return _shaped(where, values if isinstance(data, bytearray) else values.copy(), shape, fortran)


def read_header(
    where: str | os.PathLike[str], stream: BinaryIO, texts: bool = False
) -> tuple[np.dtype[Any], tuple[int, ...], bool]:
    """Type, shape and whether columns come first, of a .npy file; the stream is left at the first number.

    Raises:
        InputError: It is damaged, or describes something other than numbers.
    """
    try:
        version = npy.read_magic(stream)
        if version == (1, 0):
            shape, fortran, dtype = npy.read_array_header_1_0(stream)
        elif version == (2, 0):
            shape, fortran, dtype = npy.read_array_header_2_0(stream)
        else:
            raise ValueError(f"version {version[0]}.{version[1]}, which arrays of numbers do not have")
    # The header is a Python literal: tokenizer, parser and dtype() object in many ways, all to the same effect.
    except Exception as error:
        raise InputError(f"{where}: is not a NumPy array of numbers, or is damaged ({_line(error)})") from None
    if dtype.kind not in NUMBERS + "U" * texts or not dtype.itemsize or dtype.names or dtype.shape:
        raise InputError(f"{where}: holds {dtype}; expected numbers")
    if len(shape) > MOST_AXES or not all(type(n) is int and 0 <= n < 2**62 for n in shape):
        raise InputError(f"{where}: is damaged (shape {_line(shape)}); write it again")
    return dtype, shape, fortran


def _check_size(where: str | os.PathLike[str], dtype: np.dtype[Any], shape: tuple[int, ...], there: int) -> None:
    needed = math.prod(shape) * dtype.itemsize
    if needed > there:
        raise InputError(
            f"{where}: is cut short: {dtype} {list(shape)} needs {needed} bytes, there are {there}; copy it again"
        )


def _shaped(where: str | os.PathLike[str], values: NDArray[Any], shape: tuple[int, ...], fortran: bool) -> NDArray[Any]:
    if values.dtype.kind == "b":
        values = values.view(np.uint8) != 0  # a byte that is neither 0 nor 1 is no bool, to any library
    if not values.dtype.isnative:
        values = values.astype(values.dtype.newbyteorder("="))
    if values.dtype.kind == "U" and bool((values.view(np.uint32) > LAST_CODE).any()):
        raise InputError(f"{where}: holds texts that are none; write it again")
    try:
        return values.reshape(shape[::-1]).T if fortran else values.reshape(shape)
    except ValueError:
        raise InputError(f"{where}: is cut short or damaged (shape {_line(shape)}); write it again") from None


def _line(error: object) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
