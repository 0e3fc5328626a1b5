"""CLIP, SigLIP and SigLIP 2 on tiny networks of the real classes, against the library's own road and against loops."""

import json

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from sgwarp.encoders.base import TextEncoder
from sgwarp.encoders.images import clip
from sgwarp.encoders.images.clip import JointEncoder
from sgwarp.encoders.prompts import PLAIN
from sgwarp.encoders.weights import Preparation, identity_of_weights, load_model
from sgwarp.errors import InputError


@pytest.fixture(params=["clip", "siglip", "siglip2"])
def kind(request) -> str:
    return request.param


def library_model(folder, kind):
    import transformers

    names = {"clip": "CLIPModel", "siglip": "SiglipModel", "siglip2": "Siglip2Model"}
    return getattr(transformers, names[kind]).from_pretrained(folder).eval()


def test_images_as_the_library_encodes_them(joint_models, kind):
    """Squares of the right size need no resizing, so that only the values and the network count."""
    crops = torch.randint(0, 256, (3, 32, 32, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    found = JointEncoder(str(joint_models[kind])).encode_images(crops)
    values = (crops.float() / 255 - torch.tensor([0.48, 0.45, 0.40])) / torch.tensor([0.26, 0.25, 0.27])
    values = values.permute(0, 3, 1, 2)
    model = library_model(joint_models[kind], kind)
    if kind == "siglip2":
        rows = []
        for image in values:
            patches = [image[:, y : y + 8, x : x + 8] for y in range(0, 32, 8) for x in range(0, 32, 8)]
            rows.append(torch.stack([patch.permute(1, 2, 0).flatten() for patch in patches]))
        inputs = {
            "pixel_values": torch.stack(rows),
            "pixel_attention_mask": torch.ones(3, 16, dtype=torch.int64),
            "spatial_shapes": torch.tensor([[4, 4]] * 3),
        }
    else:
        inputs = {"pixel_values": values}
    with torch.no_grad():
        wanted = normalize(model.get_image_features(**inputs).pooler_output, dim=1)
    torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-5)
    assert (found @ found.T).fill_diagonal_(0).max() < 1 - 1e-6


def test_texts(joint_models, kind):
    encoder = JointEncoder(str(joint_models[kind]), PLAIN)
    assert isinstance(encoder, TextEncoder)
    found = encoder.encode_text(["couch", "teddy bear"])
    model = library_model(joint_models[kind], kind)
    tokens = [[101, 200, 102], [101, 210, 211, 102]]
    if kind == "siglip2":  # whose own class of tokenizers cuts words in its own way
        from transformers import AutoTokenizer

        padded = {"padding": "max_length", "max_length": 16}
        tokens = AutoTokenizer.from_pretrained(joint_models[kind])(["couch", "teddy bear"], **padded)["input_ids"]
    for vector, row in zip(found, tokens, strict=True):
        if kind == "clip":
            asked = {"input_ids": torch.tensor([row]), "attention_mask": torch.ones(1, len(row), dtype=torch.int64)}
        else:  # SigLIP's phrases are padded, and the padding is looked at
            asked = {"input_ids": torch.tensor([row + [0] * (16 - len(row))])}
        with torch.no_grad():
            wanted = normalize(model.get_text_features(**asked).pooler_output, dim=1)[0]
        torch.testing.assert_close(vector, wanted, rtol=1e-4, atol=1e-5)


def test_the_vectors_of_prompts_count_alike(joint_models):
    """They are made unit vectors before they are averaged; the tokenizer is loaded once for all of them."""
    encoder = JointEncoder(str(joint_models["clip"]), ("{}", "a photo of the semantic cup of a {}"))
    loads = []
    load = clip.load_tokenizer
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(clip, "load_tokenizer", lambda *given: loads.append(given) or load(*given))
        found = torch.cat([encoder.encode_text(["couch"]), encoder.encode_text(["lamp"])])
    assert len(loads) == 1
    model = library_model(joint_models["clip"], "clip")
    for vector, word in zip(found, (200, 201), strict=True):
        parts = []
        for row in ([101, word, 102], [101, 207, 208, 209, 203, 206, 202, 209, 207, word, 102]):
            asked = {"input_ids": torch.tensor([row]), "attention_mask": torch.ones(1, len(row), dtype=torch.int64)}
            with torch.no_grad():
                parts.append(model.get_text_features(**asked).pooler_output[0])
        assert (parts[0].norm() / parts[1].norm() - 1).abs() > 0.01  # else nothing would tell
        wanted = normalize(sum(normalize(part, dim=0) for part in parts), dim=0)
        torch.testing.assert_close(vector, wanted, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_dense_maps_have_the_shape_of_the_image(joint_models, kind, image):
    found = JointEncoder(str(joint_models[kind]), longest=64).encode_pixels(image)
    assert found.shape == (6, 8, 24 if kind == "clip" else 32)
    torch.testing.assert_close(found.norm(dim=2), torch.ones(6, 8))


def test_clip_patches_are_its_values_without_attention(joint_models, image):
    """If the last layer looked at one patch alone, its attention would be 1 there: the value of that patch."""
    folder = joint_models["clip"]
    square = image[:48, :48]
    found = JointEncoder(str(folder), longest=32).encode_pixels(square)
    model = library_model(folder, "clip")
    small = torch.nn.functional.interpolate(
        square.permute(2, 0, 1)[None], (32, 32), mode="bicubic", antialias=True, align_corners=False
    ).clamp(0, 1)
    values = (small - torch.tensor([0.48, 0.45, 0.40])[:, None, None]) / torch.tensor([0.26, 0.25, 0.27])[:, None, None]
    layers = model.vision_model.encoder.layers
    inputs = {}
    layers[-1].register_forward_hook(lambda module, arguments, output: inputs.setdefault("x", arguments[0]))
    with torch.no_grad():
        model.vision_model(pixel_values=values)
        tokens = inputs["x"]
        for number in range(16):
            alone = torch.full((17, 17), float("-inf"))
            alone[:, number + 1] = 0.0  # every query sees this patch alone
            attended, _ = layers[-1].self_attn(layers[-1].layer_norm1(tokens), attention_mask=alone[None, None])
            wanted = model.visual_projection(model.vision_model.post_layernorm(attended[0, number + 1]))
            torch.testing.assert_close(found.flatten(0, 1)[number], normalize(wanted, dim=0), rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("siglip", ["siglip", "siglip2"])
def test_siglip_patches_are_pooled_alone(joint_models, siglip, image):
    encoder = JointEncoder(str(joint_models[siglip]), longest=32)
    found = encoder.encode_pixels(image[:48, :48]).flatten(0, 1)
    vision = encoder.model.vision_model
    images = encoder.preparation.resize(image[:48, :48].permute(2, 0, 1)[None], 32, 32)
    with torch.no_grad():
        tokens = vision(**encoder._inputs(images)).last_hidden_state[0]
        for number in (0, 7, 15):
            wanted = normalize(vision.head(tokens[None, number : number + 1])[0], dim=0)
            torch.testing.assert_close(found[number], wanted, rtol=1e-3, atol=1e-5)


def test_siglip2_is_given_patches_row_by_row(joint_models):
    """As the library's processor lays them out: values of a patch, whether it is there, and the grid."""
    encoder = JointEncoder(str(joint_models["siglip2"]))
    images = torch.rand(2, 3, 16, 40, generator=torch.Generator().manual_seed(0))
    found = encoder._inputs(images)
    values = (images - torch.tensor([0.48, 0.45, 0.40])[:, None, None]) / torch.tensor([0.26, 0.25, 0.27])[
        :, None, None
    ]
    assert found["pixel_values"].shape == (2, 2 * 5, 8 * 8 * 3)
    torch.testing.assert_close(found["pixel_values"][1, 7], values[1, :, 8:16, 16:24].permute(1, 2, 0).flatten())
    assert torch.equal(found["pixel_attention_mask"], torch.ones(2, 10, dtype=torch.int64))
    assert found["spatial_shapes"].tolist() == [[2, 5]] * 2


def test_space_is_that_of_the_weights_of_the_text_side(joint_models, tmp_path):
    from shutil import copytree

    first = JointEncoder(str(joint_models["clip"]))
    copytree(joint_models["clip"], tmp_path / "elsewhere")
    assert JointEncoder(str(tmp_path / "elsewhere")).space == first.space
    assert first.space.startswith("clip-24-")
    assert first.space in first.identity
    assert JointEncoder(str(joint_models["clip"]), longest=40).identity != first.identity
    assert len({JointEncoder(str(folder)).space for folder in joint_models.values()}) == 3


def test_preparation_equals_the_librarys_processor(joint_models, image):
    """transformers' own processor with Pillow, where Pillow is installed: the same values up to its 8 bits."""
    pytest.importorskip("PIL")
    from transformers.models.clip.image_processing_pil_clip import CLIPImageProcessorPil

    mean, deviation = [0.48, 0.45, 0.40], [0.26, 0.25, 0.27]
    processor = CLIPImageProcessorPil(
        size={"height": 32, "width": 32}, do_center_crop=False, image_mean=mean, image_std=deviation
    )
    pixels = (image * 255).round().to(torch.uint8)
    wanted = processor(pixels.numpy(), return_tensors="np")["pixel_values"][0]
    preparation = Preparation.load(str(joint_models["clip"]), "test")
    found = preparation.normalise(preparation.resize(pixels.permute(2, 0, 1)[None].float() / 255, 32, 32))[0]
    np.testing.assert_allclose(found, wanted, atol=1.1 / 255 / 0.25)


def test_newer_preparation_files(joint_models, tmp_path):
    content = json.loads((joint_models["clip"] / "preprocessor_config.json").read_text())
    content["size"], content["resample"] = 48, 2
    (tmp_path / "processor_config.json").write_text(json.dumps({"image_processor": content}))
    found = Preparation.load(str(tmp_path), "test")
    assert (found.side, found.way, found.mean) == (48, "bilinear", (0.48, 0.45, 0.40))
    (tmp_path / "processor_config.json").unlink()
    with pytest.raises(InputError, match=r"holds no preprocessor_config\.json"):
        Preparation.load(str(tmp_path), "test")


def test_missing_weights_are_not_replaced_by_random_ones(joint_models, tmp_path):
    from safetensors.torch import load_file, save_file

    folder = joint_models["clip"]
    for path in folder.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    weights = load_file(folder / "model.safetensors")
    weights.pop("visual_projection.weight")
    save_file(weights, tmp_path / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(InputError, match=r"lacks 1 weights of CLIPModel, such as visual_projection\.weight"):
        JointEncoder(str(tmp_path))
    (tmp_path / "model.safetensors").write_bytes(b"\x10" * 100)
    with pytest.raises(InputError, match=f"encoder clip:{tmp_path}"):
        JointEncoder(str(tmp_path))


def test_no_network_says_what_to_do():
    pytest.importorskip("transformers")
    with pytest.raises(InputError, match="hf download nobody/nothing --local-dir DIR"):
        JointEncoder("nobody/nothing")


def test_identity_of_weights_sees_every_tensor(joint_models):
    model = load_model("CLIPModel", str(joint_models["clip"]), "test", "cpu")
    before = identity_of_weights(model)
    with torch.no_grad():
        model.logit_scale += 1
    assert identity_of_weights(model) != before
    assert identity_of_weights(model, ("text_model.",)) == identity_of_weights(
        load_model("CLIPModel", str(joint_models["clip"]), "test", "cpu"), ("text_model.",)
    )
