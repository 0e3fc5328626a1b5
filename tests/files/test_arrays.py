"""NumPy's files: read as NumPy does, in any byte order, and no memory is taken for what is not there."""

import io
import resource
import zipfile

import numpy as np
import pytest

from sgwarp.errors import InputError
from sgwarp.files.archives import gunzip, open_archive, unpacked_limit
from sgwarp.files.arrays import read_array, read_arrays

ARRAYS = {
    "matrix": np.arange(6, dtype=np.float32).reshape(2, 3),
    "columns first": np.asfortranarray(np.arange(24).reshape(2, 3, 4)),
    "big-endian": np.linspace(0, 1, 5, dtype=">f4"),
    "big-endian ids": np.arange(4, dtype=">u2").reshape(2, 2),
    "number": np.array(5),
    "empty": np.zeros((0, 3), np.int8),
    "bool": np.array([True, False]),
    "half": np.ones(3, np.float16),
}


@pytest.mark.parametrize("name", ARRAYS)
def test_arrays_are_those_of_numpy(tmp_path, name):
    array = ARRAYS[name]
    np.save(tmp_path / "a.npy", array)
    np.savez(tmp_path / "a.npz", first=array, second=array)
    np.savez_compressed(tmp_path / "b.npz", first=array)
    alone, stored, packed = (
        read_array(tmp_path / "a.npy"),
        read_arrays(tmp_path / "a.npz"),
        read_arrays(tmp_path / "b.npz"),
    )
    assert set(stored) == {"first", "second"}
    for found in (alone, *stored.values(), packed["first"]):
        assert np.array_equal(found, array)
        assert found.shape == array.shape
        assert found.dtype == array.dtype.newbyteorder("=")
        assert found.dtype.isnative
        assert found.flags.writeable


def numpy_file(header: str, data: bytes = bytes(64), version: bytes = b"\x01\x00") -> bytes:
    text = header.encode("latin1") + b"\n"
    return b"\x93NUMPY" + version + len(text).to_bytes(2 if version[0] == 1 else 4, "little") + text + data


HEADERS = {
    "bracket": "{'descr':'<f4','fortran_order':False,'shape':((((2,2,3)}",
    "string": "{'descr':'<f4,'fortran_order':False,'shape':(2,)}",
    "larger than an integer": "{'descr':'<f4','fortran_order':False,'shape':(200000000000000000000,)}",
    "larger than the machine": "{'descr':'<f4','fortran_order':False,'shape':(99999999999,)}",
    "product beyond integers": "{'descr':'<f4','fortran_order':False,'shape':(0," + "4611686018427387903," * 2 + ")}",
    "negative": "{'descr':'<f4','fortran_order':False,'shape':(-1,)}",
    "bool": "{'descr':'<f4','fortran_order':False,'shape':(True,)}",
    "one more than there is": "{'descr':'<f4','fortran_order':False,'shape':(17,)}",
    "objects": "{'descr':'|O','fortran_order':False,'shape':(2,)}",
    "texts": "{'descr':'<U4','fortran_order':False,'shape':(2,)}",
    "structure": "{'descr':[('a','<f4')],'fortran_order':False,'shape':(2,)}",
    "type of arrays": "{'descr':('<f4',(100000,)),'fortran_order':False,'shape':(2,)}",
    "type": "{'descr':'<f99999999999','fortran_order':False,'shape':(2,)}",
    "dates": "{'descr':'<M8[s]','fortran_order':False,'shape':(2,)}",
    "no dictionary": "[1, 2]",
    "call": "__import__('os').system('touch PWNED')",
    "deep": "(" * 5000,
    "many axes": "{'descr':'<f4','fortran_order':False,'shape':(" + "1," * 65 + ")}",
    "keys": "{'descr':'<f4','shape':(2,)}",
}


@pytest.mark.parametrize("name", HEADERS)
def test_headers_that_lie_are_refused(tmp_path, name):
    content = numpy_file(HEADERS[name])
    (tmp_path / "a.npy").write_bytes(content)
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", content)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match=r"a\.npy") as first:
        read_array(tmp_path / "a.npy")
    with pytest.raises(InputError, match=r"a\.npz") as second:
        read_arrays(tmp_path / "a.npz")
    assert "\n" not in f"{first.value}{second.value}"
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 64 * 1024  # KiB


@pytest.mark.parametrize("version", [b"\x03\x00", b"\x09\x09"])
def test_other_versions_are_refused(tmp_path, version):
    (tmp_path / "a.npy").write_bytes(numpy_file("{'descr':'<f4','fortran_order':False,'shape':(2,)}", version=version))
    with pytest.raises(InputError):
        read_array(tmp_path / "a.npy")


@pytest.mark.parametrize("suffix", ["npy", "npz"])
def test_every_way_to_cut_a_file_short_is_refused(tmp_path, suffix):
    path = tmp_path / f"a.{suffix}"
    (np.save if suffix == "npy" else np.savez)(path, np.arange(20.0))
    whole = path.read_bytes()
    for length in range(0, len(whole), 5):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError):
            (read_array if suffix == "npy" else read_arrays)(path)


def test_a_bool_that_is_none_becomes_one(tmp_path):
    (tmp_path / "a.npy").write_bytes(numpy_file("{'descr':'|b1','fortran_order':False,'shape':(4,)}", b"\0\1\2\xff"))
    assert read_array(tmp_path / "a.npy").view(np.uint8).tolist() == [0, 1, 1, 1]


def test_an_archive_unpacks_only_as_far_as_its_size_allows(tmp_path):
    path = tmp_path / "bomb.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("a.npy", "w") as member:
        for _ in range(90):
            member.write(bytes(2**20))
    assert unpacked_limit(path.stat().st_size) < 90 * 2**20
    with pytest.raises(InputError, match="store it uncompressed"):
        read_arrays(path)


def test_members_that_lie_about_their_size_are_refused(tmp_path):
    path = tmp_path / "a.npz"
    np.savez_compressed(path, a=np.zeros(1000))
    whole = bytearray(path.read_bytes())
    at = whole.rfind(b"PK\x01\x02")
    for claim in (10, 8000, 9000):
        whole[at + 24 : at + 28] = claim.to_bytes(4, "little")
        path.write_bytes(whole)
        with pytest.raises(InputError):
            read_arrays(path)


@pytest.mark.parametrize("kind", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_other_compressions_are_refused(tmp_path, kind):
    with zipfile.ZipFile(tmp_path / "a.zip", "w", kind) as archive:
        archive.writestr("a", b"x")
    with pytest.raises(InputError, match="neither stored nor deflated"), open_archive(tmp_path / "a.zip"):
        pass


def test_gzip_is_unpacked_within_a_limit(tmp_path):
    import gzip
    import zlib

    data = np.random.default_rng(0).integers(0, 9, 5_000_000, np.uint8).tobytes()
    assert gunzip("a", gzip.compress(data)) == data
    assert gunzip("a", gzip.compress(data[:100]) + gzip.compress(data[100:])) == data
    assert gunzip("a", zlib.compress(data)) == data
    bomb = gzip.compress(bytes(100 * 2**20))
    with pytest.raises(InputError, match="unpacks to more"):
        gunzip("a", bomb)
    with pytest.raises(InputError, match="unpacks to more than 10"):
        gunzip("a", gzip.compress(data), limit=10)
    packed = gzip.compress(data[:1000])
    for length in range(1, len(packed), 11):
        with pytest.raises(InputError):
            gunzip("a", packed[:length])
    assert gunzip("a", b"") == b""


def test_a_member_is_found_where_it_lies(tmp_path):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("a", b"hello")
        archive.writestr("b", b"world", zipfile.ZIP_DEFLATED)
    (tmp_path / "a.zip").write_bytes(buffer.getvalue())
    with open_archive(tmp_path / "a.zip") as archive:
        start = archive.position("a")
        assert buffer.getvalue()[start : start + 5] == b"hello" == archive.read("a")
        assert archive.position("b") is None
        with pytest.raises(InputError, match="no member 'c'"):
            archive.read("c")
