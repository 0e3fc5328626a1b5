import json
import struct
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sgwarp.errors import InputError
from sgwarp.io.store import load_semantics, read_notes, save_semantics
from sgwarp.scene import Gaussians, Semantics


def scene(count=20, seed=0):
    gen = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.randn(count, 3, generator=gen),
        quats=torch.randn(count, 4, generator=gen),
        scales=torch.rand(count, 3, generator=gen),
        opacities=torch.rand(count, generator=gen),
        sh=torch.randn(count, 1, 3, generator=gen),
    )


def semantics(gaussians, channels=5, labels=None, scale=1.0):
    gen = torch.Generator().manual_seed(1)
    features = torch.nn.functional.normalize(torch.randn(len(gaussians), channels, generator=gen), dim=1) * scale
    return Semantics(
        features=features,
        weight=torch.rand(len(gaussians), generator=gen) * 100,
        effective_views=torch.rand(len(gaussians), generator=gen) * 9,
        space="conse-minilm-384",
        fingerprint=gaussians.fingerprint,
        labels=labels,
    )


def header(path):
    """The JSON in front of the tensors, read by the definition of the safetensors format."""
    data = path.read_bytes()
    (size,) = struct.unpack_from("<Q", data)
    return json.loads(data[8 : 8 + size])


def test_round_trip(tmp_path):
    g = scene()
    before = semantics(g, labels=("floor", "wall, painted", "Stuhl", "é", "5"))
    save_semantics(before, tmp_path / "deep" / "s.safetensors", notes={"encoder": "x", "views": 12})
    after = load_semantics(tmp_path / "deep" / "s.safetensors", g)
    assert after.features.dtype == torch.float16
    torch.testing.assert_close(after.features.float(), before.features, rtol=2**-11, atol=2**-25)
    assert torch.equal(after.weight, before.weight)
    assert torch.equal(after.effective_views, before.effective_views)
    assert (after.space, after.fingerprint, after.labels) == (before.space, before.fingerprint, before.labels)
    assert read_notes(tmp_path / "deep" / "s.safetensors") == {"encoder": "x", "views": 12}


def test_what_the_file_holds(tmp_path):
    save_semantics(semantics(scene()), tmp_path / "s.safetensors")
    content = header(tmp_path / "s.safetensors")
    metadata = content.pop("__metadata__")
    assert {name: (entry["dtype"], entry["shape"]) for name, entry in content.items()} == {
        "features": ("F16", [20, 5]),
        "weight": ("F32", [20]),
        "effective_views": ("F32", [20]),
    }
    assert (metadata["format"], metadata["version"], metadata["dtype"]) == ("sgwarp-semantics", "1", "float16")
    assert (metadata["space"], metadata["fingerprint"]) == ("conse-minilm-384", scene().fingerprint)
    assert (metadata["labels"], metadata["notes"]) == ("null", "{}")


def test_no_labels_and_no_notes(tmp_path):
    save_semantics(semantics(scene()), tmp_path / "s.safetensors")
    assert load_semantics(tmp_path / "s.safetensors").labels is None
    assert read_notes(tmp_path / "s.safetensors") == {}


@pytest.mark.parametrize(("scale", "kind"), [(1e6, "float32"), (1e-6, "float32"), (6e4, "float16"), (0.0, "float16")])
def test_range_of_half_precision(tmp_path, scale, kind):
    before = semantics(scene(), scale=scale)
    save_semantics(before, tmp_path / "s.safetensors")
    after = load_semantics(tmp_path / "s.safetensors")
    assert str(after.features.dtype) == f"torch.{kind}"
    assert header(tmp_path / "s.safetensors")["__metadata__"]["dtype"] == kind
    torch.testing.assert_close(after.features.float(), before.features, rtol=2**-11, atol=1e-6 * scale)


def test_half_precision_stays_as_it_is(tmp_path):
    before = semantics(scene())
    before = replace(before, features=before.features.half())
    save_semantics(before, tmp_path / "s.safetensors")
    assert torch.equal(load_semantics(tmp_path / "s.safetensors").features, before.features)


def test_features_that_are_not_contiguous(tmp_path):
    before = semantics(scene())
    before = replace(before, features=before.features.T.contiguous().T)
    save_semantics(before, tmp_path / "s.safetensors")
    assert torch.equal(load_semantics(tmp_path / "s.safetensors").features, before.features.half())


def test_another_scene(tmp_path):
    g = scene()
    save_semantics(semantics(g), tmp_path / "s.safetensors")
    for other in (scene(seed=2), g.subset(torch.arange(19, -1, -1)), g.subset(torch.arange(10))):
        with pytest.raises(InputError, match=rf"s\.safetensors: semantics belong to scene {g.fingerprint}, this scene"):
            load_semantics(tmp_path / "s.safetensors", other)
    assert len(load_semantics(tmp_path / "s.safetensors", g)) == 20


def test_error_while_writing_leaves_the_old_file(tmp_path):
    save_semantics(semantics(scene()), tmp_path / "s.safetensors")
    old = (tmp_path / "s.safetensors").read_bytes()
    with pytest.raises(InputError, match=r"s\.safetensors: notes must be JSON"):
        save_semantics(semantics(scene()), tmp_path / "s.safetensors", notes={"x": object()})
    assert (tmp_path / "s.safetensors").read_bytes() == old
    with pytest.raises(InputError, match=r"s\.npz: semantics are written as \.safetensors"):
        save_semantics(semantics(scene()), tmp_path / "s.npz")
    assert [p.name for p in tmp_path.iterdir()] == ["s.safetensors"]


def test_foreign_files(tmp_path):
    from safetensors.torch import save_file

    path = tmp_path / "s.safetensors"
    with pytest.raises(InputError, match=r"s\.safetensors: no such file"):
        load_semantics(path)
    with pytest.raises(InputError, match=r"is a folder|cannot be read"):
        load_semantics(tmp_path)
    path.write_bytes(b"PK\x03\x04 something else entirely")
    with pytest.raises(InputError, match=r"s\.safetensors: is not a safetensors file, or is cut short"):
        load_semantics(path)
    save_file({"weight": torch.zeros(3)}, path)
    with pytest.raises(InputError, match=r"s\.safetensors: holds no lifted semantics"):
        load_semantics(path)
    save_file({"weight": torch.zeros(3)}, path, metadata={"format": "sgwarp-semantics", "version": "2"})
    with pytest.raises(InputError, match="has version 2, this program reads 1"):
        load_semantics(path)
    good = {"format": "sgwarp-semantics", "version": "1"}
    save_file({"weight": torch.zeros(3)}, path, metadata=good)
    with pytest.raises(InputError, match="lacks the tensors effective_views, features"):
        load_semantics(path)
    tensors = {"weight": torch.zeros(3), "effective_views": torch.zeros(3), "features": torch.zeros(3, 2)}
    save_file(tensors, path, metadata=good)
    with pytest.raises(InputError, match="its metadata is damaged"):
        load_semantics(path)
    save_file(tensors, path, metadata={**good, "labels": '["a"]', "space": "x", "fingerprint": "f"})
    with pytest.raises(InputError, match=r"s\.safetensors: labels: expected 2, got 1"):
        load_semantics(path)
    save_file(
        {**tensors, "weight": torch.zeros(4)},
        path,
        metadata={**good, "labels": "null", "space": "x", "fingerprint": "f"},
    )
    with pytest.raises(InputError, match=r"s\.safetensors: weight: expected shape \[3\], got \[4\]"):
        load_semantics(path)
    save_file(tensors, path, metadata={**good, "notes": "[1"})
    with pytest.raises(InputError, match="its notes: is not valid JSON"):
        read_notes(path)


def test_cut_short_anywhere(tmp_path):
    path = tmp_path / "s.safetensors"
    save_semantics(semantics(scene(3)), path)
    data = path.read_bytes()
    for length in range(0, len(data), 7):
        path.write_bytes(data[:length])
        with pytest.raises(InputError, match=r"s\.safetensors: is not a safetensors file, or is cut short"):
            load_semantics(path)


@settings(deadline=None, max_examples=100)
@given(position=st.integers(0, 10_000), value=st.integers(0, 255))
def test_damaged_anywhere(tmp_path_factory, allow_input_error, position, value):
    path = tmp_path_factory.getbasetemp() / "damaged.safetensors"
    save_semantics(semantics(scene(2), labels=("a", "b", "c", "d", "e")), path, notes={"n": 1})
    data = bytearray(path.read_bytes())
    data[position % len(data)] = value
    path.write_bytes(bytes(data))
    with allow_input_error(path):
        load_semantics(path)
    with allow_input_error(path):
        read_notes(path)


@pytest.mark.parametrize("name", ["features", "weight", "effective_views"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1.0])
def test_numbers_no_query_survives(tmp_path, name, value):
    from sgwarp.files.tensors import write_tensors

    tensors = {"features": torch.ones(3, 2), "weight": torch.ones(3), "effective_views": torch.ones(3)}
    good = {"format": "sgwarp-semantics", "version": "1", "labels": "null", "space": "x", "fingerprint": "f"}
    write_tensors(tmp_path / "s.safetensors", tensors, good)
    assert load_semantics(tmp_path / "s.safetensors").features.shape == (3, 2)
    tensors[name][1] = value
    write_tensors(tmp_path / "s.safetensors", tensors, good)
    if name == "features" and value == -1.0:
        assert load_semantics(tmp_path / "s.safetensors").features[1].tolist() == [-1, -1]
        return
    with pytest.raises(InputError, match=rf"its {name} hold NaN.*first in row 1; lift the scene again"):
        load_semantics(tmp_path / "s.safetensors")


def test_no_channels(tmp_path):
    from sgwarp.files.tensors import write_tensors

    tensors = {"features": torch.ones(3, 0), "weight": torch.ones(3), "effective_views": torch.ones(3)}
    good = {"format": "sgwarp-semantics", "version": "1", "labels": "null", "space": "x", "fingerprint": "f"}
    write_tensors(tmp_path / "s.safetensors", tensors, good)
    with pytest.raises(InputError, match="its features have no channels"):
        load_semantics(tmp_path / "s.safetensors")


@pytest.mark.parametrize("entry", ["labels", "notes"])
def test_deep_metadata(tmp_path, entry):
    from sgwarp.files.tensors import write_tensors

    tensors = {"features": torch.ones(3, 2), "weight": torch.ones(3), "effective_views": torch.ones(3)}
    about = {"format": "sgwarp-semantics", "version": "1", "labels": "null", "space": "x", "fingerprint": "f"}
    write_tensors(tmp_path / "s.safetensors", tensors, about | {entry: "[" * 100_000})
    with pytest.raises(InputError, match="is nested deeper"):
        (load_semantics if entry == "labels" else read_notes)(tmp_path / "s.safetensors")


def test_the_same_semantics_are_the_same_bytes(tmp_path):
    numbers = torch.rand(5, 3, generator=torch.Generator().manual_seed(0))
    for name in "ab":
        semantics = Semantics(numbers, torch.ones(5), torch.ones(5), "mine", "0")
        save_semantics(semantics, tmp_path / f"{name}.safetensors", {"encoder": "x", "views": 3})
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()
