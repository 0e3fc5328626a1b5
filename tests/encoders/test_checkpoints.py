"""What is taken out of a checkpoint of LSeg, and what is said about the rest; small tensors of the published names."""

import pytest
import torch

from sgwarp.encoders.pixels.lseg import clip_text_tower, load_network, read_checkpoint
from sgwarp.encoders.pixels.lseg_network import LSegNetwork, LSegShape
from sgwarp.errors import InputError


def save(folder, content) -> str:
    torch.save(content, folder / "x.ckpt")
    return str(folder / "x.ckpt")


STATE = {"net.a": torch.ones(2), "net.b.net.c": torch.zeros(1), "other.net.d": torch.ones(1), "net.name": "text"}


@pytest.mark.parametrize("content", [STATE, {"state_dict": STATE, "net.e": torch.ones(1)}])
def test_tensors_below_net(tmp_path, content):
    found = read_checkpoint(save(tmp_path, content))
    assert sorted(found) == ["a", "b.net.c"]
    assert found["a"].tolist() == [1, 1]


@pytest.mark.parametrize("content", [[torch.ones(1)], torch.ones(2), {"state_dict": [1]}, {"state_dict": {}}, {3: "x"}])
def test_files_without_them(tmp_path, content):
    with pytest.raises(InputError, match=r"x\.ckpt: holds no parameters named net\.\*"):
        read_checkpoint(save(tmp_path, content))


@pytest.fixture
def weights() -> dict[str, torch.Tensor]:
    return dict(LSegNetwork(LSegShape(64, 4, 1, 8, 2, (4, 4, 4, 4), 4, 3)).state_dict())


def test_weights_reach_the_network(weights):
    """Also from half precision, and beside parameters that features do not depend on."""
    noise = torch.Generator().manual_seed(0)
    halves = {
        name: torch.randn(value.shape, generator=noise).half() if value.is_floating_point() else value + 3
        for name, value in weights.items()
    }
    unused = {
        name: torch.ones(1) for name in ("auxlayer.x", "clip_pretrained.y", "logit_scale", "scratch.output_conv.z")
    }
    network = load_network("x", halves | unused)
    assert not network.training
    assert not any(parameter.requires_grad for parameter in network.parameters())
    for name, value in network.state_dict().items():
        assert torch.equal(value, halves[name].to(value.dtype)), name


def test_of_many_problems_some_are_named(weights):
    missing = sorted(name for name in weights if name.startswith("scratch.refinenet2."))
    changed = {name: value for name, value in weights.items() if name not in missing}
    changed |= {f"scratch.odd{k}": torch.ones(1) for k in range(5)}
    with pytest.raises(InputError) as error:
        load_network("x", changed)
    named = ", ".join(missing[:3])
    assert f"{len(missing)} missing: {named}; 5 left over: scratch.odd0, scratch.odd1, scratch.odd2)" in str(
        error.value
    )


def text_weights(width: int, layers: int = 2) -> dict[str, torch.Tensor]:
    names = {"token_embedding.weight": (20, width), "positional_embedding": (7, width), "text_projection": (width, 5)}
    names |= {"ln_final.weight": (width,), "ln_final.bias": (width,)}
    for k in range(layers):
        parts = {"attn.in_proj_": (3 * width, width), "attn.out_proj.": (width, width)}
        parts |= {"mlp.c_fc.": (9, width), "mlp.c_proj.": (width, 9), "ln_1.": (width,), "ln_2.": (width,)}
        for part, shape in parts.items():
            names[f"transformer.resblocks.{k}.{part}weight"] = shape
            names[f"transformer.resblocks.{k}.{part}bias"] = shape[:1]
    noise = torch.Generator().manual_seed(0)
    return {name: torch.randn(shape, generator=noise) for name, shape in names.items()}


@pytest.mark.parametrize(("width", "heads"), [(32, 1), (64, 1), (128, 2), (192, 3)])
def test_clips_heads_have_64_channels(width, heads):
    pytest.importorskip("transformers")
    tower = clip_text_tower("x", text_weights(width))
    config = tower.config
    assert (config.num_attention_heads, config.num_hidden_layers, config.intermediate_size) == (heads, 2, 9)
    assert (config.vocab_size, config.max_position_embeddings, config.projection_dim) == (20, 7, 5)
    assert not tower.training
    assert not any(parameter.requires_grad for parameter in tower.parameters())


def test_text_towers_of_something_else():
    pytest.importorskip("transformers")
    for change in ({"ln_final.weight": torch.ones(3)}, {"transformer.resblocks.1.ln_2.bias": torch.ones(3)}):
        with pytest.raises(InputError, match="x: holds no text tower of CLIP"):
            clip_text_tower("x", text_weights(32) | change)
