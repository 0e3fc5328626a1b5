"""A PLY file is compared with its header before memory is taken for it."""

import os
import sys
import time

import pytest

from sgwarp.errors import InputError
from sgwarp.io.ply_header import LONGEST, check_ply
from sgwarp.io.scenes import load_gaussians

BINARY, ASCII = "binary_little_endian", "ascii"


def ply(path, rows: int, body: bytes, form: str = BINARY, properties: str = "property float x\n", newline: str = "\n"):
    header = f"ply\nformat {form} 1.0\nelement vertex {rows}\n{properties}end_header\n"
    path.write_bytes(header.replace("\n", newline).encode() + body)
    return path


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_files_that_are_long_enough_pass(tmp_path, newline):
    check_ply(ply(tmp_path / "a.ply", 3, bytes(12), newline=newline))
    check_ply(ply(tmp_path / "a.ply", 3, b"1\n2\n3", ASCII, newline=newline))
    lists = "property list uchar int a\n"
    check_ply(ply(tmp_path / "a.ply", 3, bytes(3), properties=lists, newline=newline))
    check_ply(ply(tmp_path / "a.ply", 0, b"", newline=newline))


@pytest.mark.parametrize(
    ("rows", "body", "form"),
    [(4, bytes(15), BINARY), (10**9, bytes(100), BINARY), (10**30, bytes(100), BINARY), (10**9, b"1\n" * 9, ASCII)],
)
def test_files_that_are_cut_short_are_refused_at_once(tmp_path, rows, body, form):
    began = time.process_time()
    with pytest.raises(InputError, match=rf"is cut short: element 'vertex' should hold {rows} rows"):
        load_gaussians(ply(tmp_path / "a.ply", rows, body, form))
    assert time.process_time() - began < 1


@pytest.mark.parametrize("properties", ["", "property float x\n"])
def test_fewer_than_no_rows_are_refused(tmp_path, properties):
    """Without properties such an element ends the process in NumPy."""
    with pytest.raises(InputError, match=r"a\.ply: is not a valid PLY file \(its element 'vertex' has -1 rows\)"):
        check_ply(ply(tmp_path / "a.ply", -1, bytes(12), properties=properties))


def test_a_header_without_end_is_refused_at_once(tmp_path):
    path = tmp_path / "a.ply"
    path.write_bytes(b"ply\n" + b"comment" * LONGEST)
    began = time.process_time()
    with pytest.raises(InputError, match="its header does not end within"):
        load_gaussians(path)
    assert time.process_time() - began < 1


def test_without_plyfile_the_package_works_until_a_ply_is_opened(tmp_path, monkeypatch):
    import sgwarp.io.scenes  # noqa: F401

    monkeypatch.setitem(sys.modules, "plyfile", None)
    path = ply(tmp_path / "a.ply", 3, bytes(12))
    with pytest.raises(
        InputError, match=r"a\.ply: PLY files need plyfile, which is under the GPL: pip install plyfile"
    ):
        load_gaussians(path)


def test_a_pipe_is_refused(tmp_path):
    os.mkfifo(tmp_path / "a.ply")
    with pytest.raises(InputError, match="is a pipe or a device"):
        load_gaussians(tmp_path / "a.ply")
