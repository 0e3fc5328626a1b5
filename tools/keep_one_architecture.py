"""Zero the machine code of other GPUs in a native library: keep_one_architecture.py LIBRARY ARCHITECTURE

The file keeps its size and layout, and compresses to a third. Fat binaries lie in the ELF section .nv_fatbin, one after
the other: a header (magic, version, size of the header, bytes that follow), then entries (kind, version, size of the
header, bytes of code), whose header holds the architecture at byte 28. PTX is zeroed too.
"""

from __future__ import annotations

import struct
import sys
from pathlib import Path

MAGIC = 0xBA55ED50
PTX, MACHINE_CODE = 1, 2
ARCHITECTURE_AT = 28


def section(data: bytes, name: bytes) -> tuple[int, int]:
    """First byte and size of a section of a 64-bit ELF file."""
    (table,) = struct.unpack_from("<Q", data, 0x28)
    entry, count, names = struct.unpack_from("<HHH", data, 0x3A)
    rows = [struct.unpack_from("<IIQQQQ", data, table + k * entry) for k in range(count)]
    for row in rows:
        start = rows[names][4] + row[0]
        if data[start : data.index(b"\0", start)] == name:
            return row[4], row[5]
    raise SystemExit(f"no section {name.decode()}: not a library with code for GPUs")


def keep(data: bytearray, architecture: int) -> int:
    """Zero what is for other architectures; the number of entries that stay."""
    at, size = section(data, b".nv_fatbin")
    end, kept = at + size, 0
    while at < end - 16:
        magic, _, header, length = struct.unpack_from("<IHHQ", data, at)
        if magic != MAGIC:
            at += 8  # padding
            continue
        entry, last = at + header, at + header + length
        while entry < last:
            kind, _, head, payload = struct.unpack_from("<HHIQ", data, entry)
            if kind not in (PTX, MACHINE_CODE):
                break
            if kind == MACHINE_CODE and struct.unpack_from("<I", data, entry + ARCHITECTURE_AT)[0] == architecture:
                kept += 1
            else:
                data[entry + head : entry + head + payload] = bytes(payload)
            entry += head + payload
        at = last
    return kept


def main() -> None:
    path, architecture = Path(sys.argv[1]), int(sys.argv[2])
    data = bytearray(path.read_bytes())
    kept = keep(data, architecture)
    if not kept:
        raise SystemExit(f"{path}: holds no machine code for sm_{architecture}")
    path.write_bytes(data)
    print(f"{path.name}: {kept} pieces of code for sm_{architecture} kept")


if __name__ == "__main__":
    main()
