"""LSeg, the paper's encoder for segmentation: its network and CLIP's text tower, both out of `demo_e200.ckpt`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from sgwarp.encoders.base import MapSource
from sgwarp.encoders.building import Request, some, source_of_pixels
from sgwarp.encoders.names import Member, Part
from sgwarp.encoders.pixels.lseg_network import LSegNetwork, LSegShape
from sgwarp.encoders.prompts import PLAIN, Phrases
from sgwarp.encoders.weights import Preparation, channels_first, fitted, identity_of_weights, load_tokenizer, require
from sgwarp.errors import InputError
from sgwarp.files.torch_files import load_torch

TOKENIZER = "openai/clip-vit-base-patch32"  # name on the hub of a model with CLIP's tokenizer
BEGINNING = "net."  # of the network's parameters in the checkpoint
TEXT = "clip_pretrained."
# Parameters of the published network that its features do not depend on.
UNUSED = (
    "pretrained.model.norm.",
    "pretrained.model.head.",
    "pretrained.model.head_dist.",
    "clip_pretrained.",
    "scratch.head_block.",
    "scratch.output_conv.",
    "auxlayer.",
    "logit_scale",
)
HALF = Preparation()  # mean and deviation 0.5


class LSeg:
    """A PixelEncoder and TextEncoder.

    Args:
        path: The checkpoint.
        tokenizer: Folder, or name on the hub, of any model with CLIP's tokenizer.
        templates: Prompts of the text side.
        device: Where it runs.
        longest: Longest side of the image that it sees [pixels].

    Raises:
        InputError: The checkpoint cannot be read, or does not hold this network.
    """

    def __init__(
        self,
        path: str,
        tokenizer: str = TOKENIZER,
        templates: Sequence[str] = PLAIN,
        device: str | torch.device = "cpu",
        longest: int = 480,
    ) -> None:
        self.device = torch.device(device)
        weights = read_checkpoint(path)
        self.network = load_network(path, weights).to(self.device)
        shape = self.network.pretrained.shape
        self.patch = shape.patch
        self.longest = longest
        if longest < 2 * self.patch:
            raise InputError(f"encoder lseg:{path}: longest side {longest} is less than {2 * self.patch} pixels")
        text = {name[len(TEXT) :]: value.float() for name, value in weights.items() if name.startswith(TEXT)}
        self.space = f"lseg-{shape.channels}-{identity_of_weights(text, TEXT_WEIGHTS)}"
        self.identity = f"{self.space}, {identity_of_weights(self.network)}, {longest}"
        self._path, self._tokenizer_path = path, tokenizer
        self._text_weights: dict[str, Tensor] | None = text
        self._text: Any = None
        self._phrases = Phrases(self.space, self._embed_prompts, templates)

    def encode_pixels(self, image: Tensor) -> Tensor:
        """Unit vectors, float32 [h, w, C], at half the resolution that the network sees."""
        height, width = fitted(image.shape[0], image.shape[1], self.longest, 2 * self.patch)
        images = HALF.normalise(HALF.resize(channels_first(image, self.device), height, width))
        with torch.no_grad():
            return normalize(self.network(images)[0].permute(1, 2, 0), dim=2).cpu()

    def encode_text(self, texts: Sequence[str]) -> Tensor:
        """Unit vectors, float32 [Q, C], one per phrase."""
        return self._phrases.encode_text(texts)

    def _embed_prompts(self, prompts: list[str]) -> Tensor:
        if self._text is None:
            assert self._text_weights is not None
            tokenizer = load_tokenizer(self._tokenizer_path, f"text of encoder lseg:{self._path}")
            self._text = tokenizer, clip_text_tower(self._path, self._text_weights).to(self.device)
            self._text_weights = None
        tokenizer, tower = self._text
        limit = tower.config.max_position_embeddings
        tokens = tokenizer(prompts, padding=True, truncation=True, max_length=limit, return_tensors="pt")
        with torch.no_grad():
            found = tower(**{name: tokens[name].to(self.device) for name in ("input_ids", "attention_mask")})
        return normalize(found.text_embeds, dim=1)


def read_checkpoint(path: str) -> dict[str, Tensor]:
    """The tensors of a Lightning checkpoint whose names begin with `net.`, without that beginning.

    Raises:
        InputError: The file is missing, damaged, or holds no such tensors.
    """
    # Lightning keeps its settings beside the weights, as objects of its own; they come back inert.
    content = load_torch(path)
    state = content.get("state_dict", content) if isinstance(content, Mapping) else {}
    if not isinstance(state, Mapping):
        state = {}
    weights = {
        name[len(BEGINNING) :]: value
        for name, value in state.items()
        if isinstance(value, Tensor) and str(name).startswith(BEGINNING)
    }
    if not weights:
        raise InputError(f"{path}: holds no parameters named {BEGINNING}*; give LSeg's demo_e200.ckpt")
    return weights


def load_network(path: str, weights: Mapping[str, Tensor]) -> LSegNetwork:
    """The image side of LSeg.

    Raises:
        InputError: Parameters are missing, left over or of another shape; the message names some of each.
    """
    try:
        network = LSegNetwork(LSegShape.of(weights))
    except (KeyError, IndexError) as error:
        raise InputError(f"{path}: is no LSeg with a ViT backbone; it lacks net.{error.args[0]}") from None
    own = network.state_dict()
    given = {name: value for name, value in weights.items() if not name.startswith(UNUSED)}
    missing = sorted(own.keys() - given.keys())
    left = sorted(given.keys() - own.keys())
    differs = [
        f"{name} is {list(given[name].shape)}, not {list(own[name].shape)}"
        for name in sorted(own.keys() & given.keys())
        if own[name].shape != given[name].shape
    ]
    problems = [
        f"{len(names)} {what}: {', '.join(names[:3])}"
        for what, names in (("missing", missing), ("left over", left), ("of another shape", differs))
        if names
    ]
    if problems:
        raise InputError(f"{path}: does not hold this LSeg ({'; '.join(problems)})")
    network.load_state_dict({name: value.to(torch.float32) for name, value in given.items()})
    return network.eval().requires_grad_(False)


TEXT_WEIGHTS = ("token_embedding.", "positional_embedding", "transformer.", "ln_final.", "text_projection")


def clip_text_tower(path: str, weights: Mapping[str, Tensor]) -> Any:
    """CLIP's text tower in transformers' form, from weights under the names that OpenAI published it with.

    Raises:
        InputError: Parameters are missing.
    """
    transformers = require("transformers", "models", f"text of encoder lseg:{path}")
    try:
        vocabulary, width = weights["token_embedding.weight"].shape
        layers = {name.split(".")[2] for name in weights if name.startswith("transformer.resblocks.")}
        config = transformers.CLIPTextConfig(
            vocab_size=vocabulary,
            hidden_size=width,
            intermediate_size=weights["transformer.resblocks.0.mlp.c_fc.weight"].shape[0],
            num_hidden_layers=len(layers),
            num_attention_heads=max(1, width // 64),
            max_position_embeddings=weights["positional_embedding"].shape[0],
            projection_dim=weights["text_projection"].shape[1],
            # The phrase is read off at its end token, which has the largest number of all.
            eos_token_id=2,
            bos_token_id=0,
            pad_token_id=1,
        )
        tower = transformers.CLIPTextModelWithProjection(config)
        tower.load_state_dict(_as_transformers(weights, len(layers)))
    except (KeyError, RuntimeError) as error:
        line = (str(error).strip().splitlines() or ["?"])[0]
        raise InputError(f"{path}: holds no text tower of CLIP ({line})") from None
    return tower.eval().requires_grad_(False)


def _as_transformers(weights: Mapping[str, Tensor], layers: int) -> dict[str, Tensor]:
    named = {
        "text_model.embeddings.token_embedding.weight": weights["token_embedding.weight"],
        "text_model.embeddings.position_embedding.weight": weights["positional_embedding"],
        "text_model.final_layer_norm.weight": weights["ln_final.weight"],
        "text_model.final_layer_norm.bias": weights["ln_final.bias"],
        "text_projection.weight": weights["text_projection"].T,
    }
    pairs = {"ln_1": "layer_norm1", "ln_2": "layer_norm2", "mlp.c_fc": "mlp.fc1", "mlp.c_proj": "mlp.fc2"}
    for number in range(layers):
        old, new = f"transformer.resblocks.{number}.", f"text_model.encoder.layers.{number}."
        for kind in ("weight", "bias"):
            for theirs, ours in pairs.items():
                named[f"{new}{ours}.{kind}"] = weights[f"{old}{theirs}.{kind}"]
            named[f"{new}self_attn.out_proj.{kind}"] = weights[f"{old}attn.out_proj.{kind}"]
            thirds = weights[f"{old}attn.in_proj_{kind}"].chunk(3)
            for letter, third in zip("qkv", thirds, strict=True):
                named[f"{new}self_attn.{letter}_proj.{kind}"] = third
    return named


def make_source(member: Member, request: Request) -> MapSource:
    """Features of every pixel."""
    return source_of_pixels(make_text(member.source, request), member.masks, request)


def make_text(part: Part, request: Request) -> LSeg:
    """Image and text side are one network."""
    options = some(part, "longest", "tokenizer") | request.templates_of(part)
    return LSeg(part.argument, device=request.device, **options)
