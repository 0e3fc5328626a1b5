"""Files of torch.save: the same tensors as torch reads, and nothing of a hostile file runs."""

import io
import os
import pickle
import struct
import zipfile

import numpy as np
import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.files.pickled import Inert, UnpickleError, read_pickle
from sgwarp.files.torch_files import load_torch


def saved(path, content, **options):
    torch.save(content, path, **options)
    return path


CONTENT = {
    "float": torch.arange(12.0).reshape(3, 4),
    "view": torch.arange(12.0).reshape(3, 4).T[1:],
    "expanded": torch.ones(3).expand(4, 3),
    "half": torch.ones(2, dtype=torch.float16),
    "brain": torch.ones(2, dtype=torch.bfloat16),
    "double": torch.tensor(3.5, dtype=torch.float64),
    "bool": torch.tensor([True, False, True]),
    "complex": torch.tensor([1 + 2j]),
    "unsigned": torch.ones(3).to(torch.uint16),
    "none": torch.empty(0, 3),
    "parameter": torch.nn.Parameter(torch.ones(2)),
    "long": torch.tensor([-1, 2**40]),
}


@pytest.mark.parametrize("archive", [True, False])
def test_tensors_are_those_of_torch(tmp_path, archive):
    path = saved(tmp_path / "a.pt", CONTENT, _use_new_zipfile_serialization=archive)
    found = load_torch(path)
    assert list(found) == list(CONTENT)
    for name, tensor in CONTENT.items():
        assert found[name].dtype == tensor.dtype
        assert torch.equal(found[name], tensor), name


@pytest.mark.parametrize("archive", [True, False])
def test_plain_values_come_back_and_everything_else_is_inert(tmp_path, archive):
    plain = {"a": [1, 2.5, "x", None, True, (1, b"y")], 7: {"size": torch.Size([2, 3])}}
    strange = {"scalar": np.float64(3), "array": np.arange(3), "set": {1}, "type": torch.float32}
    path = saved(tmp_path / "a.pt", plain | strange, _use_new_zipfile_serialization=archive)
    found = load_torch(path)
    assert {key: found[key] for key in plain} == {"a": plain["a"], 7: {"size": (2, 3)}}
    assert all(isinstance(found[key], Inert) for key in strange)


def test_an_optimizer_goes_on_from_it(tmp_path):
    net = torch.nn.Linear(3, 2)
    optimizer = torch.optim.Adam(net.parameters())
    net(torch.ones(3)).sum().backward()
    optimizer.step()
    found = load_torch(saved(tmp_path / "a.pt", {"net": net.state_dict(), "optimizer": optimizer.state_dict()}))
    other = torch.nn.Linear(3, 2)
    other.load_state_dict(found["net"])
    again = torch.optim.Adam(other.parameters())
    again.load_state_dict(found["optimizer"])
    for side, mine in ((net, optimizer), (other, again)):
        mine.zero_grad()
        side(torch.tensor([1.0, 2.0, 3.0])).square().sum().backward()
        mine.step()
    assert torch.equal(net.weight, other.weight)


def test_a_tensor_that_is_changed_leaves_the_file_as_it_is(tmp_path):
    path = saved(tmp_path / "a.pt", {"a": torch.zeros(1000)})
    before = path.read_bytes()
    load_torch(path)["a"].fill_(1.0)
    assert path.read_bytes() == before


def test_tensors_of_one_storage_share_it(tmp_path):
    numbers = torch.arange(6.0)
    found = load_torch(saved(tmp_path / "a.pt", {"all": numbers, "end": numbers[3:]}))
    found["all"][3] = 9.0
    assert found["end"][0] == 9.0


# Hostile pickles. `touch(path)` would be seen: each of them tries to make the file PWNED.

PROTO = b"\x80\x04"


def text(value: str) -> bytes:
    return b"\x8c" + bytes([len(value)]) + value.encode()


def integer(value: int) -> bytes:
    return b"\x8a\x08" + struct.pack("<q", value)


def global_(module: str, name: str) -> bytes:
    return f"c{module}\n{name}\n".encode()


def stack_global(module: str, name: str) -> bytes:
    return text(module) + text(name) + b"\x93"


def call(callee: bytes, *arguments: bytes) -> bytes:
    return callee + b"(" + b"".join(arguments) + b"tR"


def hostile(code: str) -> dict[str, bytes]:
    """Pickles that would run `code`, or break what a reader relies on, by what they try."""
    run = text(code)
    dotted = stack_global("torch._utils", "_rebuild_tensor.__builtins__.get")
    ordered = global_("collections", "OrderedDict")
    array = call(
        stack_global("numpy._core.multiarray", "_reconstruct"), stack_global("numpy", "ndarray"), b"K\0\x85", text("b")
    )
    flags = call(stack_global("numpy", "dtype"), text("f8"), b"\x89", b"\x88")
    flags += b"(K\x03" + text("<") + b"NNN" + b"J\xff\xff\xff\xff" * 2 + b"K\x3ftb"
    return {
        "eval by a dotted name": call(call(dotted, text("eval")), run),
        "eval by GLOBAL": call(global_("builtins", "eval"), run),
        "exec by STACK_GLOBAL": call(stack_global("builtins", "exec"), run),
        "eval of Python 2": call(global_("__builtin__", "eval"), run),
        "system": call(global_("os", "system"), text("touch PWNED")),
        "INST": b"(" + run + b"ibuiltins\nexec\n",
        "OBJ": b"(" + global_("builtins", "exec") + run + b"o",
        "NEWOBJ": global_("builtins", "exec") + run + b"\x85\x81",
        "NEWOBJ_EX": global_("builtins", "exec") + run + b"\x85}\x92",
        "getattr": call(call(global_("builtins", "getattr"), global_("builtins", "eval"), text("__call__")), run),
        "BUILD of a class": global_("collections", "OrderedDict") + b"}" + text("__reduce__") + run + b"sb",
        "an allowed name of a near module": call(stack_global("torch._utils.os", "system"), run),
        "a name with a dot": call(stack_global("torch", "serialization.os.system"), run),
        "memo swapped": ordered + b"\x940" + global_("builtins", "exec") + b"q\x000h\0" + run + b"\x85R",
        "memo far away": b"Nr\xff\xff\xff\x7f",
        "dtype that holds objects": array + b"(K\x01K\x01\x85" + flags + b"\x89](G\x3f\xf8\0\0\0\0\0\0" + b"etb",
        "torch.load itself": call(stack_global("torch", "load"), text("other.pt")),
        "hub": call(stack_global("torch.hub", "load"), text("other")),
        "extension code": b"\x82\x01",
        "buffer out of band": b"\x97",
        "key that nests": b"})" + b"\x85" * 100_000 + b"Ns",
    }  # fmt: skip


def as_archive(path, program: bytes):
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in (("data.pkl", PROTO + program + b"."), ("version", b"3\n"), ("byteorder", b"little")):
            archive.writestr(f"archive/{name}", content)
    return path


def as_stream(path, program: bytes):
    """The container before PyTorch 1.6."""
    head = b"".join(pickle.dumps(x, 2) for x in (0x1950A86A20F9469CFC6C, 1001, {"little_endian": True}))
    path.write_bytes(head + PROTO + program + b"." + pickle.dumps([], 2))
    return path


@pytest.mark.parametrize("container", [as_archive, as_stream])
@pytest.mark.parametrize("name", hostile(""))
def test_nothing_of_a_hostile_file_runs(tmp_path, monkeypatch, container, name):
    monkeypatch.chdir(tmp_path)
    code = f"__import__('os').system('touch {tmp_path / 'PWNED'}')"
    program = hostile(code)[name]
    path = container(tmp_path / "evil.pt", b"}" + text("state_dict") + program + b"s")
    try:
        content = load_torch(path)
    except InputError:
        pass
    else:
        assert set(content) <= {"state_dict"}
        assert not callable(content.get("state_dict"))
    assert not (tmp_path / "PWNED").exists()


def test_the_payload_would_work(tmp_path, monkeypatch):
    """Against a reader that trusts the file, the first of them does what it tries: the test above can fail."""
    monkeypatch.chdir(tmp_path)
    program = hostile(f"__import__('os').mkdir({str(tmp_path / 'PWNED')!r})")["exec by STACK_GLOBAL"]
    pickle.loads(PROTO + program + b".")
    assert (tmp_path / "PWNED").exists()


def tensor_program(count=4, offset=0, size=(4,), stride=(1,), kind="FloatStorage", key="0") -> bytes:
    storage = b"(" + text("storage") + global_("torch", kind) + text(key) + text("cpu") + integer(count) + b"tQ"
    axes = [b"(" + b"".join(integer(n) for n in numbers) + b"t" for numbers in (size, stride)]
    hooks = call(global_("collections", "OrderedDict"))
    return call(global_("torch._utils", "_rebuild_tensor_v2"), storage, integer(offset), *axes, b"\x89", hooks)


def with_storage(path, program: bytes, data: bytes = bytes(16)):
    as_archive(path, program)
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("archive/data/0", data)
    return path


def test_the_crafted_tensor_is_read_when_it_is_right(tmp_path):
    data = np.arange(4, dtype="<f4").tobytes()
    assert load_torch(with_storage(tmp_path / "a.pt", tensor_program(), data)).tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize(
    "wrong",
    [
        {"count": 1_000_000},
        {"count": 3},
        {"size": (1_000_000,)},
        {"size": (2**40, 2**40), "stride": (0, 0)},
        {"offset": 1},
        {"offset": -1},
        {"stride": (2,)},
        {"stride": (-1,)},
        {"size": (2, 2)},
        {"size": (-4,)},
        {"kind": "QInt8Storage"},
        {"kind": "Storage.__class__"},
        {"key": "1"},
        {"key": "../../data.pkl"},
        {"size": (1_600_000_000_000,), "stride": (0,)},
    ],
    ids=str,
)
def test_a_tensor_that_does_not_fit_its_storage_is_refused(tmp_path, wrong):
    path = with_storage(tmp_path / "a.pt", tensor_program(**wrong))
    with pytest.raises(InputError, match=r"a\.pt"):
        load_torch(path)


def test_bytes_that_are_no_bool_become_one(tmp_path):
    program = tensor_program(kind="BoolStorage", count=16, size=(16,))
    found = load_torch(with_storage(tmp_path / "a.pt", program, bytes(range(16))))
    assert found.view(torch.uint8).tolist() == [0] + [1] * 15


@pytest.mark.parametrize("archive", [True, False])
def test_every_way_to_cut_a_file_short_is_refused(tmp_path, archive):
    whole = saved(tmp_path / "a.pt", {"a": torch.ones(3)}, _use_new_zipfile_serialization=archive).read_bytes()
    path = tmp_path / "short.pt"
    for length in range(0, len(whole), 7):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"short\.pt"):
            load_torch(path)


@pytest.mark.parametrize("content", [b"", b"hello", pickle.dumps({"a": 1}, 2), pickle.dumps(1), b"PK\x03\x04"])
def test_other_files_are_refused(tmp_path, content):
    path = tmp_path / "a.pt"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"a\.pt"):
        load_torch(path)


def test_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe.pt")
    with pytest.raises(InputError, match="pipe or a device"):
        load_torch(tmp_path / "pipe.pt")


@pytest.mark.parametrize("protocol", range(6))
def test_plain_data_of_every_protocol(protocol):
    data = {"a": [1, -2.5, "é", b"x", None, True, 2**70, (1, 2, 3, 4)], "b": {"c": ()}, 3: [[], {}]}
    assert read_pickle(io.BytesIO(pickle.dumps(data, protocol)), {("_codecs", "encode"): str.encode}, None) == data


def test_a_pickle_that_refers_to_itself():
    loop: list = [1]
    loop.append(loop)
    found = read_pickle(io.BytesIO(pickle.dumps(loop)), {}, None)
    assert found[1] is found


@pytest.mark.parametrize("stream", [b".", b"0.", b"h\x05.", b"(.", b"K", b"\x8e" + b"\xff" * 8, b"R.", b"s.", b"\xff"])
def test_a_malformed_pickle_is_one_error(stream):
    with pytest.raises(UnpickleError):
        read_pickle(io.BytesIO(stream), {}, None)
