"""What keeps a network from being loaded is said in one line, wherever in its loading it shows."""

import json
from types import SimpleNamespace

import pytest
import torch

from sgwarp.encoders import weights
from sgwarp.encoders.weights import (
    Preparation,
    channels_first,
    fitted,
    identity_of_weights,
    load_config,
    load_model,
    load_tokenizer,
    require,
)
from sgwarp.errors import InputError

LOADERS = {
    "AutoConfig": lambda path: load_config(path, "clip", ("clip",)),
    "CLIPModel": lambda path: load_model("CLIPModel", path, "clip", "cpu"),
    "AutoTokenizer": lambda path: load_tokenizer(path, "clip"),
}
TROUBLES = {
    "missing file": (OSError("no file\nand a second line"), r"clip: {} cannot be loaded \(no file\)"),
    "wrong value": (ValueError("odd"), r"clip: {} cannot be loaded \(odd\)"),
    "wrong shape": (RuntimeError("shape"), r"clip: {} cannot be loaded \(shape\)"),
    "missing entry": (KeyError("key"), r"clip: {} cannot be loaded \('key'\)"),
    "missing package": (ImportError("needs x"), r"clip: {} cannot be loaded \(needs x\)"),
    "nothing to say": (OSError(), r"clip: {} cannot be loaded \(OSError\)"),
    "damaged": (type("SafetensorError", (Exception,), {"__module__": "safetensors"})("cut"), r"clip: {} is damaged"),
}


@pytest.fixture
def loads(monkeypatch):
    """`loads(loader, path, error)`: a loader while transformers raises an error."""

    def of(loader, path, error):
        def fail(*arguments, **options):
            raise error

        kind = SimpleNamespace(from_pretrained=fail)
        monkeypatch.setattr(weights, "require", lambda *arguments: SimpleNamespace(**{loader: kind}))
        return LOADERS[loader](str(path))

    return of


@pytest.mark.parametrize("trouble", TROUBLES)
@pytest.mark.parametrize("loader", LOADERS)
def test_errors_of_the_library_are_one_line(loads, tmp_path, loader, trouble):
    error, message = TROUBLES[trouble]
    with pytest.raises(InputError, match=message.format(tmp_path)) as found:
        loads(loader, tmp_path, error)
    assert "hf download" not in str(found.value)  # the folder is there


@pytest.mark.parametrize("loader", LOADERS)
def test_a_name_on_the_hub_that_cannot_be_had(loads, loader):
    with pytest.raises(InputError, match="hf download some/model --local-dir DIR"):
        loads(loader, "some/model", OSError("offline"))


@pytest.mark.parametrize("loader", LOADERS)
def test_mistakes_of_ours_are_not_hidden(loads, tmp_path, loader):
    with pytest.raises(ZeroDivisionError):
        loads(loader, tmp_path, ZeroDivisionError())


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", r"preprocessor_config\.json: is not valid JSON"),
        ("[1]", r"holds no preprocessor_config\.json"),
        ('{"size": 3}', r"holds no preprocessor_config\.json"),
        ('{"image_mean": [0.5]}', r"preprocessor_config\.json does not say how to prepare images \(KeyError"),
        ('{"image_mean": ["a"], "image_std": [1]}', "does not say how to prepare images"),
        ('{"image_mean": 1, "image_std": [1]}', "does not say how to prepare images"),
        ('{"image_mean": [0], "image_std": [1], "size": [3]}', "does not say how to prepare images"),
        ('{"image_mean": [0], "image_std": [1], "size": {"height": "x"}}', "does not say how to prepare images"),
    ],
)
def test_preparations_that_are_damaged(tmp_path, content, message):
    (tmp_path / "preprocessor_config.json").write_text(content)
    with pytest.raises(InputError, match=message):
        Preparation.load(str(tmp_path), "encoder x")


def test_preparations_without_a_size(tmp_path):
    content = '{"image_mean": [0.5, 0.4, 0.3], "image_std": [0.1, 0.2, 0.3]%s}'
    for size in ("", ', "size": null', ', "size": {"height": null}'):
        (tmp_path / "preprocessor_config.json").write_text(content % size)
        found = Preparation.load(str(tmp_path), "encoder x")
        assert found == Preparation((0.5, 0.4, 0.3), (0.1, 0.2, 0.3), (), "bicubic")
        assert found.side is None


@pytest.mark.parametrize(
    ("resample", "way"), [(0, "nearest-exact"), (1, "bicubic"), (2, "bilinear"), (3, "bicubic"), (None, "bicubic")]
)
def test_ways_of_resizing(tmp_path, resample, way):
    """Pillow's numbers; a size may be one number."""
    content = {"image_mean": [0], "image_std": [1], "size": 7} | ({} if resample is None else {"resample": resample})
    (tmp_path / "processor_config.json").write_text(json.dumps({"image_processor": content}))
    found = Preparation.load(str(tmp_path), "encoder x")
    assert (found.way, found.side) == (way, 7)
    small = found.resize(torch.eye(6).expand(1, 3, 6, 6), 2, 2)
    if way == "nearest-exact":
        assert small[0, 0].tolist() == [[1, 0], [0, 1]]
    else:
        assert 0 < small[0, 0, 0, 0] < 1  # antialiased


def test_sizes_of_inputs():
    """The longest side as asked, both rounded to a multiple, and neither to nothing."""
    assert fitted(48, 64, 128, 16) == (96, 128)
    assert fitted(64, 48, 128, 16) == (128, 96)
    assert fitted(50, 64, 128, 32) == (96, 128)
    assert fitted(1, 640, 64, 16) == (16, 64)
    assert fitted(48, 64, 32, 1) == (24, 32)


def test_images_of_every_kind_are_numbers_from_0_to_1():
    pixels = torch.tensor([[[0, 51, 255]] * 4] * 2, dtype=torch.uint8)
    wanted = torch.tensor([0.0, 0.2, 1.0])[:, None, None].expand(1, 3, 2, 4)
    for images in (pixels, pixels[None], pixels.double() / 255):
        found = channels_first(images, "cpu")
        assert found.dtype == torch.float32
        torch.testing.assert_close(found, wanted)


def test_the_identity_of_weights_knows_names_shapes_and_numbers():
    """Small tensors number by number; the order in which they are listed does not matter."""
    small, large = torch.arange(10.0), torch.arange(6400.0)
    first = identity_of_weights({"a": small, "b": large})
    assert len(first) == 12
    assert identity_of_weights({"b": large.clone(), "a": small.double()}) == first
    others = {
        first,
        identity_of_weights({"a": small, "c": large}),
        identity_of_weights({"a": small.view(2, 5), "b": large}),
    }
    for number in range(10):
        changed = small.clone()
        changed[number] = -1
        others.add(identity_of_weights({"a": changed, "b": large}))
    for number in range(0, 6400, 100):  # 64 of them
        changed = large.clone()
        changed[number] = -1
        others.add(identity_of_weights({"a": small, "b": changed}))
    assert len(others) == 3 + 10 + 64
    assert identity_of_weights({"a": small, "b": large}, ("a",)) == identity_of_weights({"a": small})


def test_the_package_that_is_missing_is_named(tmp_path, monkeypatch):
    """Which may be one that the package asked for needs in turn."""
    (tmp_path / "sgwarp_test_outer.py").write_text("import sgwarp_test_inner")
    monkeypatch.syspath_prepend(tmp_path)
    remedy = r'pip install "sgwarp\[models\]"'
    with pytest.raises(InputError, match=rf"^clip needs the package sgwarp_test_inner: {remedy}"):
        require("sgwarp_test_outer", "models", "clip")
    with pytest.raises(InputError, match=rf"^clip needs the package sgwarp_test_none: {remedy}"):
        require("sgwarp_test_none", "models", "clip")
    assert require("math", "models", "clip").pi > 3
