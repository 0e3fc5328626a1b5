"""Mutations that know the structure of a file: bytes, numbers in texts, JSON values, members of archives, PNG chunks.

A change inside an archive or a chunk comes with the right checksum, so that it reaches the reader behind it.
"""

import io
import json
import random
import re
import struct
import zipfile
import zlib

NUMBERS = ("0", "-1", "1", "7", "255", "65536", "2147483647", "2147483648", "4294967296", "9223372036854775807",
           "99999999999", "200000000000000000000", "1e400", "-1e400", "nan", "inf", "1e-300", "", "x")  # fmt: skip
VALUES = (
    None,
    True,
    -1,
    0,
    3,
    2**31,
    2**63,
    1e308,
    float("nan"),
    float("inf"),
    "",
    "x",
    "..",
    "\x1b[2J\n",
    [],
    {},
    [[]],
    {"a": 1},
)
INTEGERS = (
    0,
    1,
    2,
    0x7F,
    0x80,
    0xFF,
    0x7FFF,
    0xFFFF,
    0x10000,
    0x7FFFFFFF,
    0x80000000,
    0xFFFFFFFF,
    2**40,
    2**63 - 1,
    2**64 - 1,
)
TOKEN = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
BRACKETS = b"()[]{}<>,:'\" \n\0"


def mutate(data: bytes, chance: random.Random) -> bytes:
    """One to a few changes."""
    for _ in range(1 + min(chance.getrandbits(2), chance.getrandbits(2))):
        data = chance.choice(_kinds(data))(data, chance)
    return data


def _kinds(data: bytes):
    kinds = [change_bytes, change_integer, cut, repeat, change_number, insert]
    if data.startswith(b"PK\x03\x04"):
        kinds += [change_member] * 6
    elif data.startswith(b"\x89PNG"):
        kinds += [change_chunk] * 6
    elif data[:1] in b"{[":
        kinds += [change_json] * 4
    elif data[8:9] == b"{":
        kinds += [change_header] * 4
    elif data.startswith(b"\x93NUMPY"):
        kinds += [change_numpy_header] * 4
    return kinds


def change_bytes(data: bytes, chance: random.Random) -> bytes:
    content = bytearray(data)
    for _ in range(1 + chance.getrandbits(2)):
        if content:
            content[chance.randrange(len(content))] = chance.getrandbits(8)
    return bytes(content)


def change_integer(data: bytes, chance: random.Random) -> bytes:
    width = chance.choice((1, 2, 4, 8))
    if len(data) < width:
        return data
    value = chance.choice(INTEGERS) & ((1 << 8 * width) - 1)
    at = chance.randrange(min(len(data), 400 if chance.random() < 0.5 else len(data)) - width + 1 or 1)
    return data[:at] + value.to_bytes(width, chance.choice(("little", "big"))) + data[at + width :]


def cut(data: bytes, chance: random.Random) -> bytes:
    return data[: chance.randrange(len(data) + 1)]


def repeat(data: bytes, chance: random.Random) -> bytes:
    first, second = sorted(chance.randrange(len(data) + 1) for _ in range(2))
    return data[:second] + data[first : min(second, first + 4096)] + data[second:]


def insert(data: bytes, chance: random.Random) -> bytes:
    at = chance.randrange(len(data) + 1)
    return data[:at] + bytes(chance.choice(BRACKETS) for _ in range(1 + chance.getrandbits(3))) + data[at:]


def change_number(data: bytes, chance: random.Random) -> bytes:
    """Another number in a text, or in the text at the beginning of a binary file."""
    found = list(TOKEN.finditer(data[:4096]))
    if not found:
        return change_bytes(data, chance)
    token = chance.choice(found)
    return data[: token.start()] + chance.choice(NUMBERS).encode() + data[token.end() :]


def change_json(data: bytes, chance: random.Random) -> bytes:
    try:
        content = json.loads(data)
    except (ValueError, RecursionError):
        return change_bytes(data, chance)
    places = [
        (outer, key)
        for outer in _containers(content)
        for key in (outer if isinstance(outer, dict) else range(len(outer)))
    ]
    if not places:
        return insert(data, chance)
    outer, key = chance.choice(places)
    if isinstance(outer, dict) and chance.random() < 0.3:
        outer[chance.choice(("frames", "w", "k1", "__metadata__", "a\n"))] = outer.pop(key)
    else:
        outer[key] = chance.choice(VALUES)
    return json.dumps(content).encode()


def _containers(content):
    if isinstance(content, (dict, list)):
        yield content
        for value in content.values() if isinstance(content, dict) else content:
            yield from _containers(value)


def change_header(data: bytes, chance: random.Random) -> bytes:
    """The JSON header of a safetensors file, with its length put right."""
    length = int.from_bytes(data[:8], "little")
    header = change_json(data[8 : 8 + length], chance)
    return len(header).to_bytes(8, "little") + header + data[8 + length :]


def change_numpy_header(data: bytes, chance: random.Random) -> bytes:
    length = int.from_bytes(data[8:10], "little")
    header = chance.choice((change_number, change_bytes, insert, cut))(data[10 : 10 + length], chance)
    return data[:8] + (len(header) & 0xFFFF).to_bytes(2, "little") + header + data[10 + length :]


def change_member(data: bytes, chance: random.Random) -> bytes:
    """A member of a zip file, packed again with the right checksum; now and then its name."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = [(info.filename, info.compress_type, archive.read(info)) for info in archive.infolist()]
    except Exception:  # a file that an earlier change has broken
        return change_bytes(data, chance)
    if not members:
        return change_bytes(data, chance)
    number = chance.randrange(len(members))
    name, kind, content = members[number]
    if chance.random() < 0.1:
        name = chance.choice((name + "x", "../" + name, "", "a.npy", "archive/data.pkl"))
    elif len(content) < 65536:
        content = chance.choice((change_bytes, change_integer, cut, change_number, change_numpy_header, insert))(
            content, chance
        )
    members[number] = (name, kind, content)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        seen = set()
        for name, kind, content in members:
            if name not in seen:
                archive.writestr(
                    zipfile.ZipInfo(name), content, kind if chance.random() < 0.9 else zipfile.ZIP_DEFLATED
                )
            seen.add(name)
    return buffer.getvalue()


def change_chunk(data: bytes, chance: random.Random) -> bytes:
    """The content of a PNG chunk with the right checksum, or a length that lies."""
    chunks, position = [], 8
    while position + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, position)
        chunks.append([data[position + 4 : position + 8], data[position + 8 : position + 8 + length], None])
        position += 12 + length
    if not chunks:
        return change_bytes(data, chance)
    chosen = chance.choice(chunks)
    if chance.random() < 0.3:
        chosen[2] = chance.choice(INTEGERS) & 0xFFFFFFFF
    elif chance.random() < 0.3:
        chosen[0] = chance.choice(
            (b"IDAT", b"acTL", b"fcTL", b"fdAT", b"iCCP", b"zTXt", b"eXIf", b"tRNS", b"PLTE", b"IHDR", b"IEND")
        )
    else:
        chosen[1] = chance.choice((change_bytes, change_integer, cut, repeat))(chosen[1], chance)
    out = [data[:8]]
    for kind, content, length in chunks:
        out.append(struct.pack(">I", len(content) if length is None else length) + kind + content)
        out.append(struct.pack(">I", zlib.crc32(kind + content)))
    return b"".join(out)
