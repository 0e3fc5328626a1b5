"""CLIP, SigLIP and SigLIP 2 through transformers: vectors of images, of every patch of an image, and of phrases.

Of a dense map every cell has the vector that the network's pooling would give if it looked at this patch alone: for
CLIP the value path of the last attention (Zhou et al., Extract Free Dense Labels from CLIP, 2022), for SigLIP its
pooling head applied to the one token.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from sgwarp.encoders.base import MapSource
from sgwarp.encoders.building import Request, some, source_of_images, source_of_pixels
from sgwarp.encoders.names import Member, Part
from sgwarp.encoders.prompts import PHOTO, Phrases
from sgwarp.encoders.weights import (
    Preparation,
    channels_first,
    fitted,
    identity_of_weights,
    load_config,
    load_model,
    load_tokenizer,
)
from sgwarp.errors import InputError

CLASSES = {"clip": "CLIPModel", "siglip": "SiglipModel", "siglip2": "Siglip2Model"}
TEXT_WEIGHTS = ("text_model.", "text_projection.")
SIGLIP_LENGTH = 64  # tokens that SigLIP's phrases are padded to; it was trained so


class JointEncoder:
    """An ImageEncoder, PixelEncoder and TextEncoder in one; the model's type decides which of the three it is.

    The space is named after the text side, so that networks that share it (such as OpenSeg with CLIP) can be compared.

    Args:
        path: Folder with config.json, weights, tokenizer and preprocessor_config.json, or a name on the hub.
        templates: Prompts of the text side.
        device: Where it runs.
        longest: Longest side of the image that dense maps are made from [pixels]; twice the model's own if None.

    Raises:
        InputError: The model cannot be loaded.
    """

    def __init__(
        self,
        path: str,
        templates: Sequence[str] = PHOTO,
        device: str | torch.device = "cpu",
        longest: int | None = None,
    ) -> None:
        what = f"encoder clip:{path}"
        config = load_config(path, what, tuple(CLASSES))
        self.kind: str = config.model_type
        self.device = torch.device(device)
        self.model = load_model(CLASSES[self.kind], path, what, device)
        self.preparation = Preparation.load(path, what)
        self.patch = int(config.vision_config.patch_size)
        grid = round(getattr(config.vision_config, "num_patches", 256) ** 0.5)
        self.side = int(getattr(config.vision_config, "image_size", None) or grid * self.patch)
        self.longest = longest or 2 * self.side
        if self.longest < self.patch:
            raise InputError(f"{what}: longest side {self.longest} is less than one patch of {self.patch} pixels")
        self._tokenizer: Any = None
        self._path, self._what = path, what
        probe = self._embed_size(config)
        self.space = f"{self.kind}-{probe}-{identity_of_weights(self.model, TEXT_WEIGHTS)}"
        self.identity = f"{self.space}, {identity_of_weights(self.model)}, {self.preparation}, {self.longest}"
        self._phrases = Phrases(self.space, self._embed_prompts, templates)

    @staticmethod
    def _embed_size(config: Any) -> int:
        return int(getattr(config, "projection_dim", 0) or config.text_config.hidden_size)

    def encode_text(self, texts: Sequence[str]) -> Tensor:
        """Unit vectors, float32 [Q, C], one per phrase."""
        return self._phrases.encode_text(texts)

    def _embed_prompts(self, prompts: list[str]) -> Tensor:
        self._tokenizer = self._tokenizer or load_tokenizer(self._path, self._what)
        length = self.model.config.text_config.max_position_embeddings
        if self.kind == "clip":
            padding: dict[str, Any] = {"padding": True, "max_length": length}
        else:
            padding = {"padding": "max_length", "max_length": min(SIGLIP_LENGTH, length)}
        tokens = self._tokenizer(prompts, truncation=True, return_tensors="pt", **padding).to(self.device)
        asked = {"input_ids": tokens["input_ids"]}
        if self.kind == "clip":  # SigLIP looks at the padding too
            asked["attention_mask"] = tokens["attention_mask"]
        with torch.no_grad():
            return normalize(self.model.get_text_features(**asked).pooler_output, dim=-1)

    def encode_images(self, crops: Tensor) -> Tensor:
        """Unit vectors, float32 [B, C], of square images, uint8 [B, side, side, 3]."""
        images = self.preparation.resize(channels_first(crops, self.device), self.side, self.side)
        with torch.no_grad():
            found = self.model.get_image_features(**self._inputs(images))
        return normalize(found.pooler_output, dim=-1).cpu()

    def encode_pixels(self, image: Tensor) -> Tensor:
        """Unit vectors of the patches of an image [H, W, 3], float32 [h, w, C]."""
        height, width = fitted(image.shape[0], image.shape[1], self.longest, self.patch)
        images = self.preparation.resize(channels_first(image, self.device), height, width)
        with torch.no_grad():
            tokens = self._patch_vectors(images)
        return normalize(tokens, dim=-1).reshape(height // self.patch, width // self.patch, -1).cpu()

    def _inputs(self, images: Tensor) -> dict[str, Any]:
        """Inputs of the vision tower: images, or with SigLIP 2 the patches of an image of any shape."""
        values = self.preparation.normalise(images)
        if self.kind != "siglip2":
            return {"pixel_values": values, "interpolate_pos_encoding": images.shape[2:] != (self.side, self.side)}
        rows, columns = (side // self.patch for side in images.shape[2:])
        patches = values.unflatten(3, (columns, self.patch)).unflatten(2, (rows, self.patch))
        patches = patches.permute(0, 2, 4, 3, 5, 1).flatten(3).flatten(1, 2)
        return {
            "pixel_values": patches,
            "pixel_attention_mask": torch.ones(patches.shape[:2], dtype=torch.int64, device=images.device),
            "spatial_shapes": torch.tensor([[rows, columns]] * len(images), device=images.device),
        }

    def _patch_vectors(self, images: Tensor) -> Tensor:
        """Vectors in the joint space of all patches, [B, h * w, C]."""
        vision = self.model.vision_model
        found = vision(output_hidden_states=True, **self._inputs(images))
        if self.kind == "clip":
            last = vision.encoder.layers[-1]
            values = last.self_attn.out_proj(last.self_attn.v_proj(last.layer_norm1(found.hidden_states[-2])))
            return self.model.visual_projection(vision.post_layernorm(values[:, 1:]))
        tokens = found.last_hidden_state
        return vision.head(tokens.flatten(0, 1)[:, None]).unflatten(0, tokens.shape[:2])


def make_source(member: Member, request: Request) -> MapSource:
    """The squares around masks; without masks, or with `rule=pixels`, what the network says of every patch."""
    rule = member.source.options.get("rule", "images")
    if rule not in ("images", "pixels"):
        raise InputError(f"encoder '{request.name}': rule is images or pixels, not '{rule}'")
    encoder = make_text(member.source, request)
    if member.masks is None or rule == "pixels":
        return source_of_pixels(encoder, member.masks, request)
    return source_of_images(encoder, member.masks, request)


def make_text(part: Part, request: Request) -> JointEncoder:
    """Image and text side are one network."""
    return JointEncoder(part.argument, device=request.device, **some(part, "longest"), **request.templates_of(part))
