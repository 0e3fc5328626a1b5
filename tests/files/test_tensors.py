"""safetensors: files of the library's own format, with the same bytes each time."""

import json
import subprocess
import sys

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from sgwarp.errors import InputError
from sgwarp.files.tensors import CODES, read_tensors, write_tensors

NAMES = {dtype: str(dtype).removeprefix("torch.") for dtype in CODES}


def content() -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    numbers = torch.randn(3, 5, generator=generator) * 3
    tensors = {NAMES[dtype]: numbers.to(dtype) for dtype in CODES}
    return tensors | {"turned": numbers.T, "none": torch.empty(0, 3), "number": torch.tensor(2.5)}


def test_the_library_reads_what_is_written(tmp_path):
    path = tmp_path / "a.safetensors"
    write_tensors(path, content(), {"b": "1", "a": "é\n"})
    found = load_file(path)
    assert set(found) == set(content())
    for name, tensor in content().items():
        assert found[name].dtype == tensor.dtype
        assert torch.equal(found[name], tensor), name
    with safe_open(path, "pt") as file:
        assert file.metadata() == {"b": "1", "a": "é\n"}


def test_what_the_library_writes_is_read(tmp_path):
    path = tmp_path / "a.safetensors"
    save_file({name: tensor.contiguous() for name, tensor in content().items()}, path, {"a": "b"})
    metadata, tensors = read_tensors(path)
    assert metadata == {"a": "b"}
    assert all(torch.equal(tensors[name], tensor) for name, tensor in content().items())
    assert set(read_tensors(path, ("none", "other"))[1]) == {"none"}


def test_the_bytes_depend_on_nothing_else(tmp_path):
    """In another process, with another order of the names and another hash seed."""
    write_tensors(tmp_path / "a.safetensors", content(), {"one": "1", "two": "2", "three": "3"})
    reverse = dict(reversed(content().items()))
    write_tensors(tmp_path / "b.safetensors", reverse, {"three": "3", "two": "2", "one": "1"})
    whole = (tmp_path / "a.safetensors").read_bytes()
    assert whole == (tmp_path / "b.safetensors").read_bytes()
    code = (
        "import torch; from sgwarp.files.tensors import write_tensors as w; t = dict(a=torch.ones(3), b=torch.ones(2));"
        f"w({str(tmp_path / 'c.safetensors')!r}, t, dict(x='1', y='2'))"
    )
    seen = set()
    for seed in "12":
        subprocess.run(
            [sys.executable, "-c", code], check=True, env={"PYTHONHASHSEED": seed, "PYTHONPATH": ":".join(sys.path)}
        )
        seen.add((tmp_path / "c.safetensors").read_bytes())
    assert len(seen) == 1


def test_numbers_are_aligned(tmp_path):
    write_tensors(tmp_path / "a.safetensors", content())
    whole = (tmp_path / "a.safetensors").read_bytes()
    length = int.from_bytes(whole[:8], "little")
    assert length % 8 == 0
    for name, entry in json.loads(whole[8 : 8 + length]).items():
        assert entry["data_offsets"][0] % content()[name].element_size() == 0


def test_every_way_to_cut_a_file_short_is_refused(tmp_path):
    write_tensors(tmp_path / "a.safetensors", {"a": torch.ones(4)})
    whole = (tmp_path / "a.safetensors").read_bytes()
    for length in range(len(whole)):
        (tmp_path / "b.safetensors").write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"b\.safetensors"):
            read_tensors(tmp_path / "b.safetensors")


@pytest.mark.parametrize(
    "entry", [{"dtype": "F8_E9M9"}, {"shape": [2**62, 4]}, {"data_offsets": [0, 2**40]}, {"shape": [-1]}]
)
def test_headers_that_lie_are_refused(tmp_path, entry):
    header = json.dumps({"a": {"dtype": "F32", "shape": [2], "data_offsets": [0, 8]} | entry}).encode()
    (tmp_path / "a.safetensors").write_bytes(len(header).to_bytes(8, "little") + header + bytes(8))
    with pytest.raises(InputError):
        read_tensors(tmp_path / "a.safetensors")
