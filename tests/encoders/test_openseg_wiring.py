"""What OpenSeg's model is given and what becomes of its answer, with a TensorFlow that is made up here."""

import os
import shutil
import sys
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from sgwarp.encoders.pixels.openseg import OpenSeg
from sgwarp.errors import InputError

CHANNELS = 6
MATRIX = np.arange(3 * CHANNELS, dtype=np.float32).reshape(3, CHANNELS) - 5
TEXT = SimpleNamespace(space="toy-6", encode_text=lambda texts: torch.eye(CHANNELS)[: len(texts)])


class Array:
    def __init__(self, values):
        self.values = np.asarray(values)

    def numpy(self):
        return self.values


class Model:
    """Halves the decoded image, pads it to a square of 32, and gives its colors times a matrix."""

    def __init__(self):
        names = {"ppixel_ave_feat": (1, 32, 32, CHANNELS), "image_embedding_feat": (1, 32, 32, CHANNELS)}
        self.structured_outputs = {name: SimpleNamespace(shape=shape) for name, shape in names.items()}
        self.structured_outputs["image_info"] = SimpleNamespace(shape=(4, 2))
        self.signatures = {"serving_default": self}

    def __call__(self, inp_image_bytes, inp_text_emb):
        assert inp_text_emb.shape == (1, 1, CHANNELS)
        assert not inp_text_emb.any()
        image = cv2.imdecode(np.frombuffer(inp_image_bytes, np.uint8), cv2.IMREAD_COLOR)[::2, ::2, ::-1] / 255.0
        high, wide = image.shape[:2]
        square = np.ones((1, 32, 32, CHANNELS), np.float64)
        square[0, :high, :wide] = image @ MATRIX
        info = [[2 * high, 2 * wide], [32, 32], [0.5, 0.5], [0, 0]]
        return {
            "ppixel_ave_feat": Array(square),
            "image_embedding_feat": Array(-square),
            "image_info": Array(np.float32(info)),
        }


@pytest.fixture
def model(monkeypatch):
    """The model that the pretended TensorFlow loads; `model.asked` is how."""
    made = Model()
    made.asked = []

    def load(path, tags):
        made.asked.append((path, tags))
        return made

    module = SimpleNamespace(
        saved_model=SimpleNamespace(load=load), convert_to_tensor=lambda content: content, zeros=np.zeros
    )
    monkeypatch.setitem(sys.modules, "tensorflow", module)
    monkeypatch.setenv("TF_CPP_MIN_LOG_LEVEL", "x")
    return made


@pytest.fixture
def folder(tmp_path):
    made = tmp_path / "model"
    (made / "variables").mkdir(parents=True)
    (made / "saved_model.pb").write_bytes(b"graph")
    (made / "variables" / "data").write_bytes(b"numbers")
    return made


@pytest.mark.parametrize("pooled", [True, False])
def test_features_of_the_part_that_the_image_fills(model, folder, image, pooled):
    encoder = OpenSeg(str(folder), TEXT, **({} if pooled else {"pooled": False}))
    assert model.asked == [(str(folder), ["serve"])]
    assert (encoder.space, encoder.channels) == ("toy-6", CHANNELS)
    found = encoder.encode_pixels(image)
    colors = ((image * 255).round() / 255)[::2, ::2]
    wanted = normalize(colors @ torch.from_numpy(MATRIX), dim=2) * (1 if pooled else -1)
    assert found.shape == (24, 32, CHANNELS)
    torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-5)
    assert torch.equal(encoder.encode_text(["a", "b"]), torch.eye(CHANNELS)[:2])


def test_its_identity_is_that_of_its_files(model, folder, tmp_path):
    def identity(**options) -> str:
        return OpenSeg(str(folder), TEXT, **options).identity

    seen = [identity()]
    shutil.copytree(folder, tmp_path / "elsewhere")
    assert OpenSeg(str(tmp_path / "elsewhere"), TEXT).identity == seen[0]
    assert seen[0].startswith("openseg, ")
    assert len(seen[0].split(", ")[1]) == 12
    seen.append(identity(pooled=False))
    for change in (
        lambda: (folder / "saved_model.pb").write_bytes(b"Graph"),
        lambda: (folder / "variables" / "data").write_bytes(b"Numbers"),
        lambda: (folder / "variables" / "data").rename(folder / "variables" / "other"),
        lambda: (folder / "variables" / "other").write_bytes(bytes(1 << 20) + b"a"),
        lambda: (folder / "variables" / "other").write_bytes(bytes(1 << 20) + b"ab"),  # by its size
    ):
        change()
        seen.append(identity())
    assert len(set(seen)) == 7


@pytest.mark.parametrize("name", ["ppixel_ave_feat", "image_info"])
def test_a_model_without_an_output(model, folder, name):
    del model.structured_outputs[name]
    left = ", ".join(sorted(model.structured_outputs))
    with pytest.raises(InputError, match=f"has no output {name}; its outputs are {left}"):
        OpenSeg(str(folder), TEXT)
    if name == "ppixel_ave_feat":
        assert OpenSeg(str(folder), TEXT, pooled=False).channels == CHANNELS


@pytest.mark.parametrize(
    ("error", "line"), [(OSError("no\nmore"), "no"), (ValueError("odd"), "odd"), (OSError(), "OSError")]
)
def test_a_model_that_cannot_be_loaded(model, folder, monkeypatch, error, line):
    def fail(path, tags):
        raise error

    monkeypatch.setattr(sys.modules["tensorflow"].saved_model, "load", fail)
    with pytest.raises(InputError, match=rf"cannot be loaded as an OpenSeg SavedModel \({line}\)"):
        OpenSeg(str(folder), TEXT)


def test_a_model_without_the_signature(model, folder):
    model.signatures = {}
    with pytest.raises(InputError, match="cannot be loaded as an OpenSeg SavedModel"):
        OpenSeg(str(folder), TEXT)


def test_tensorflow_is_quiet_unless_told_otherwise(model, folder, monkeypatch):
    OpenSeg(str(folder), TEXT)
    assert os.environ["TF_CPP_MIN_LOG_LEVEL"] == "x"
    monkeypatch.delenv("TF_CPP_MIN_LOG_LEVEL")
    OpenSeg(str(folder), TEXT)
    assert os.environ["TF_CPP_MIN_LOG_LEVEL"] == "3"
