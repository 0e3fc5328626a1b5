"""CLIPSeg through transformers: how much every pixel looks like each of some phrases."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from sgwarp.encoders.base import MapSource
from sgwarp.encoders.building import Request, source_of_pixels
from sgwarp.encoders.maps.files import LABEL_SPACE
from sgwarp.encoders.names import Member
from sgwarp.encoders.prompts import PLAIN, fill_templates
from sgwarp.encoders.weights import (
    Preparation,
    channels_first,
    identity_of_weights,
    load_config,
    load_model,
    load_tokenizer,
)
from sgwarp.errors import InputError


class ClipSeg:
    """A PixelEncoder whose channels are the phrases it was asked for, so it speaks the space of labels.

    Args:
        path: Folder with config.json, weights, tokenizer and preprocessor_config.json, or a name on the hub.
        classes: The phrases.
        templates: What they are put into; the shares of all templates are averaged.
        device: Where it runs.

    Raises:
        InputError: The model cannot be loaded, or there are no phrases.
    """

    space = LABEL_SPACE

    def __init__(
        self, path: str, classes: Sequence[str], templates: Sequence[str] = PLAIN, device: str | torch.device = "cpu"
    ) -> None:
        what = f"encoder clipseg:{path}"
        if not classes:
            raise InputError(f"{what}: needs the phrases to look for: clipseg:{path}?classes=couch,lamp")
        load_config(path, what, ("clipseg",))
        self.labels = tuple(classes)
        self.device = torch.device(device)
        self.model = load_model("CLIPSegForImageSegmentation", path, what, device)
        self.preparation = Preparation.load(path, what)
        self.side = self.preparation.side or int(self.model.config.vision_config.image_size)
        tokenizer = load_tokenizer(path, what)
        prompts = fill_templates(self.labels, templates)
        self.identity = f"clipseg, {identity_of_weights(self.model)}, {prompts}, {self.preparation}"
        tokens = tokenizer(prompts, padding=True, truncation=True, return_tensors="pt").to(self.device)
        with torch.no_grad():
            self._asked = self.model.get_conditional_embeddings(
                batch_size=len(prompts), input_ids=tokens["input_ids"], attention_mask=tokens["attention_mask"]
            )

    def encode_pixels(self, image: Tensor) -> Tensor:
        """Similarity of each pixel and each phrase, in [0, 1], float32 [h, w, Q]."""
        images = self.preparation.resize(channels_first(image, self.device), self.side, self.side)
        values = self.preparation.normalise(images)
        shares = []
        for asked in self._asked:  # one by one: a class list may be long, and the image tower is the cheaper part
            with torch.no_grad():
                found = self.model(pixel_values=values, conditional_embeddings=asked[None])
            shares.append(found.logits.reshape(found.logits.shape[-2:]).sigmoid())
        templates = len(shares) // len(self.labels)
        return torch.stack(shares).unflatten(0, (len(self.labels), templates)).mean(dim=1).permute(1, 2, 0).cpu()


def make_source(member: Member, request: Request) -> MapSource:
    """Shares of the phrases at every pixel."""
    part = member.source
    classes, templates = part.options.get("classes", ()), request.templates_of(part)
    return source_of_pixels(ClipSeg(part.argument, classes, device=request.device, **templates), member.masks, request)
