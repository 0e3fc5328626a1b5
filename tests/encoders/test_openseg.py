"""OpenSeg on a small SavedModel with the published signature; only where TensorFlow is installed."""

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from sgwarp.encoders.pixels.openseg import OpenSeg
from sgwarp.errors import InputError

CHANNELS = 6


class Text:
    space = "toy-6"

    def encode_text(self, texts):
        return torch.eye(CHANNELS)[: len(texts)]


@pytest.fixture(scope="module")
def saved_model(tmp_path_factory):
    """Pads the decoded image to a square of 64 and gives its colours times a matrix, so the answer is known."""
    tf = pytest.importorskip("tensorflow", reason="needs the extra openseg")
    folder = tmp_path_factory.mktemp("openseg")
    matrix = np.arange(3 * CHANNELS, dtype=np.float32).reshape(3, CHANNELS) - 5

    class Model(tf.Module):
        @tf.function(
            input_signature=[
                tf.TensorSpec([], tf.string, name="inp_image_bytes"),
                tf.TensorSpec([1, None, CHANNELS], tf.float32, name="inp_text_emb"),
            ]
        )
        def run(self, inp_image_bytes, inp_text_emb):
            image = tf.cast(tf.io.decode_image(inp_image_bytes, channels=3, expand_animations=False), tf.float32) / 255
            size = tf.cast(tf.shape(image)[:2], tf.float32)
            scale = 64.0 / tf.reduce_max(size)
            resized = tf.image.resize(image, tf.cast(tf.round(size * scale), tf.int32), method="nearest")
            square = tf.image.pad_to_bounding_box(resized, 0, 0, 64, 64)
            features = tf.ensure_shape(tf.tensordot(square, matrix, 1)[None], [1, 64, 64, CHANNELS])
            info = tf.stack([size, [64.0, 64.0], [scale, scale], [0.0, 0.0]])
            return {
                "ppixel_ave_feat": features + 0.0 * tf.reduce_sum(inp_text_emb),
                "image_embedding_feat": -features,
                "image_info": info,
            }

    model = Model()
    tf.saved_model.save(model, str(folder), signatures={"serving_default": model.run})
    return folder, torch.from_numpy(matrix)


def test_features(saved_model, image):
    folder, matrix = saved_model
    encoder = OpenSeg(str(folder), Text())
    found = encoder.encode_pixels(image)
    assert found.shape == (48, 64, CHANNELS)
    colours = (image * 255).round() / 255
    torch.testing.assert_close(found, normalize(colours @ matrix, dim=2), rtol=1e-4, atol=1e-5)
    opposite = OpenSeg(str(folder), Text(), pooled=False)
    torch.testing.assert_close(opposite.encode_pixels(image), -found, rtol=1e-4, atol=1e-5)
    assert encoder.space == "toy-6"
    assert encoder.encode_text(["a", "b"]).shape == (2, CHANNELS)
    assert encoder.identity != opposite.identity


def test_texts_of_another_length(saved_model):
    class Short(Text):
        def encode_text(self, texts):
            return torch.eye(4)[: len(texts)]

    with pytest.raises(InputError, match="features have 6 channels, phrases in space 'toy-6' have 4"):
        OpenSeg(str(saved_model[0]), Short()).encode_text(["a"])


def test_no_model(tmp_path):
    with pytest.raises(InputError, match="is no folder of a SavedModel"):
        OpenSeg(str(tmp_path), Text())


def test_without_tensorflow(tmp_path, monkeypatch):
    import sys

    (tmp_path / "saved_model.pb").touch()
    monkeypatch.setitem(sys.modules, "tensorflow", None)
    with pytest.raises(InputError, match=r'needs the package tensorflow: pip install "sgwarp\[openseg\]"'):
        OpenSeg(str(tmp_path), Text())
