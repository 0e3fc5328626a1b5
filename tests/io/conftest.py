"""Writers that share nothing with the package: bytes are packed one by one with struct."""

import struct
from collections.abc import Callable, Sequence

import pytest

CODES = {
    "char": "b",
    "uchar": "B",
    "short": "h",
    "ushort": "H",
    "int": "i",
    "uint": "I",
    "float": "f",
    "double": "d",
}
Element = tuple[str, Sequence[tuple[str, str]], Sequence[Sequence[float]]]


def _ply_bytes(elements: Sequence[Element], form: str = "binary_little_endian", newline: str = "\n") -> bytes:
    """A PLY file from (name, [(type, property)], rows) per element."""
    header = ["ply", f"format {form} 1.0", "comment made for a test"]
    body = b""
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}.get(form)
    for name, properties, rows in elements:
        header.append(f"element {name} {len(rows)}")
        header += [f"property {kind} {prop}" for kind, prop in properties]
        for row in rows:
            if order is None:
                body += (" ".join(repr(value) for value in row) + "\n").encode()
            else:
                codes = "".join(CODES[kind] for kind, _ in properties)
                body += struct.pack(order + codes, *row)
    return (newline.join([*header, "end_header"]) + newline).encode() + body


@pytest.fixture(scope="session")
def ply_bytes() -> Callable[..., bytes]:
    return _ply_bytes
