"""What the header of a PLY file claims, compared with the file before memory is taken for it."""

from __future__ import annotations

import os
from dataclasses import dataclass, field

from sgwarp.errors import InputError
from sgwarp.files.access import open_input

LONGEST = 1 << 20  # bytes of a header; that of a 3DGS scene has 1,500
END = b"end_header"
SIZES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "float", "int32", "uint32", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}


@dataclass
class _Element:
    name: str
    count: int
    sizes: list[int] = field(default_factory=list)  # bytes of a property in a row, at least
    lists: bool = False


def check_ply(path: str | os.PathLike[str]) -> None:
    """Refuse a PLY file that is shorter than its header says, or whose header does not end.

    Headers that are malformed in another way are left to the reader behind it, which says how.

    Raises:
        InputError: The file is missing, cut short, or is none.
    """
    with open_input(path) as file:
        head = file.read(LONGEST)
        size = os.fstat(file.fileno()).st_size
    if not head.startswith(b"ply"):
        raise InputError(f"{path}: is not a valid PLY file (it does not begin with 'ply')")
    at = head.find(END)
    if at < 0 and size > LONGEST:
        raise InputError(f"{path}: is not a valid PLY file (its header does not end within {LONGEST} bytes)")
    mark = b"\r" if _line_end(head) == b"\r" else b"\n"
    newline = head.find(mark, at)
    if at < 0 or newline < 0:
        return
    end = newline + 1
    text, elements = _elements(head[:at])
    rest = size - end
    for element in elements:
        if element.count < 0:  # without properties NumPy would divide by 0, which ends the process (SIGFPE)
            raise InputError(f"{path}: is not a valid PLY file (its element '{element.name}' has {element.count} rows)")
        # In ascii a number takes a digit and a separator, the last one of the file only a digit.
        row = 2 * len(element.sizes) if text else sum(element.sizes)
        if element.count * row > rest + text:
            fits = 0 if row == 0 else max(rest, 0) // row
            needed = f"{element.count} rows"
            if not element.lists and not text:
                needed += f" ({element.count * row} bytes in binary)"
            raise InputError(
                f"{path}: is cut short: element '{element.name}' should hold {needed}, the file ends after "
                f"{fits} rows ({size} bytes in all); copy or download it again"
            )
        rest -= element.count * row


def _line_end(head: bytes) -> bytes:
    """What ends the lines of a header, as its first line says."""
    return b"\r\n" if head[3:5] == b"\r\n" else head[3:4]


def tidied(path: str | os.PathLike[str]) -> bytes | None:
    """The file without what readers trip over: comments, which may hold any bytes, and blank lines.

    Returns:
        Its whole content, or None if there is nothing to leave out or its header does not end.
    """
    with open_input(path) as file:
        data = file.read()
    ending, at, lines = _line_end(data), 0, list[bytes]()
    while lines[-1:] != [END]:
        stop = data.find(ending, at) if ending in (b"\n", b"\r", b"\r\n") else -1
        if not 0 <= stop < LONGEST:
            return None
        line, at = data[at:stop].strip(), stop + len(ending)
        if line and line.split()[0] not in (b"comment", b"obj_info"):
            lines.append(line)
    body = data[at:]
    if any(line.split()[:2] == [b"format", b"ascii"] for line in lines):
        body = b"".join(row.strip() + b"\n" for row in body.splitlines() if row.strip())
    tidy = b"\n".join(lines) + b"\n" + body
    return None if tidy == data else tidy


def _elements(header: bytes) -> tuple[bool, list[_Element]]:
    """Whether rows are text, and the elements up to the first line that is not understood."""
    text, elements = False, list[_Element]()
    for line in header.decode("ascii", "replace").splitlines():
        words = line.split()
        try:
            if words[:1] == ["format"]:
                text = words[1] == "ascii"
            elif words[:1] == ["element"]:
                elements.append(_Element(words[1], int(words[2])))
            elif words[:2] == ["property", "list"]:
                elements[-1].sizes.append(SIZES[words[2]])
                elements[-1].lists = True
            elif words[:1] == ["property"]:
                elements[-1].sizes.append(SIZES[words[1]])
        except (IndexError, KeyError, ValueError):
            break
    return text, elements
