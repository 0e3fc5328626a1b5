"""What keeps a network from being loaded is said in one line, wherever in its loading it shows."""

from types import SimpleNamespace

import pytest

from sgwarp.encoders import weights
from sgwarp.encoders.weights import load_config, load_model, load_tokenizer, require
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
