"""What keeps a network from being loaded is said in one line, wherever in its loading it shows."""

import json
import sys
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


@pytest.mark.parametrize("shown", [True, False])
def test_the_librarys_bar_is_as_it_was_afterwards(shown):
    logging = pytest.importorskip("transformers").utils.logging
    before = logging.is_progress_bar_enabled()
    try:
        (logging.enable_progress_bar if shown else logging.disable_progress_bar)()
        with weights.no_progress_bar():
            assert not logging.is_progress_bar_enabled()
        assert logging.is_progress_bar_enabled() == shown
    finally:
        (logging.enable_progress_bar if before else logging.disable_progress_bar)()


def test_values_are_normalised_channel_by_channel():
    found = Preparation((0.5, 0.0, 1.0), (0.5, 2.0, 1.0)).normalise(torch.full((1, 3, 1, 1), 0.75))
    assert found.flatten().tolist() == [0.5, 0.375, -0.25]
    images = torch.rand(1, 3, 4, 6)
    assert Preparation().resize(images, 4, 6) is images


def test_preparations_need_their_package(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(InputError, match=r'encoder x needs the package transformers: pip install "sgwarp\[models\]"'):
        Preparation.load(str(tmp_path), "encoder x")


@pytest.mark.parametrize("path", ["/nowhere/at/all", "./nowhere", "../nowhere", "~/nowhere"])
def test_paths_of_folders_are_no_names_on_the_hub(monkeypatch, path):
    monkeypatch.setattr(weights, "require", lambda *given: SimpleNamespace(AutoConfig=None))
    with pytest.raises(InputError, match=f"^clip: {path}: no such folder"):
        load_config(path, "clip", ("clip",))


@pytest.mark.parametrize(
    ("missing", "wrong", "message"),
    [
        (("d", "b", "c", "a"), (), "lacks 4 weights of Net, such as a, b, c$"),
        (("b",), ("a",), "lacks 2 weights of Net, such as b, a$"),
        ((), (), ""),
    ],
)
def test_a_loaded_model_is_complete_and_asked_only(monkeypatch, missing, wrong, message):
    asked, net = [], torch.nn.Sequential(torch.nn.Linear(2, 2), torch.nn.Dropout())
    info = {"missing_keys": set(missing), "mismatched_keys": set(wrong)}
    kind = SimpleNamespace(from_pretrained=lambda path, **options: asked.append((path, options)) or (net, info))
    monkeypatch.setattr(weights, "require", lambda *given: SimpleNamespace(Net=kind))
    if message:
        with pytest.raises(InputError, match=message):
            load_model("Net", "p", "clip", "cpu")
        return
    assert load_model("Net", "p", "clip", "cpu") is net
    assert not net.training
    assert not any(parameter.requires_grad for parameter in net.parameters())
    assert asked == [("p", {"output_loading_info": True, "dtype": torch.float32})]


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
