"""Mask2Former and OneFormer through transformers: which of the classes it was trained on every pixel shows."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from sgwarp.encoders.base import MapSource
from sgwarp.encoders.building import Request
from sgwarp.encoders.maps.files import LABEL_SPACE
from sgwarp.encoders.names import Member
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
from sgwarp.scene import FeatureMap, View

CLASSES = {"mask2former": "Mask2FormerForUniversalSegmentation", "oneformer": "OneFormerForUniversalSegmentation"}
STRIDE = 32
TASK = "the task is semantic"  # OneFormer is told what to do


class ClosedSet:
    """A MapSource of label maps in the space "labels", whose names are the model's.

    Args:
        path: Folder with config.json, weights and preprocessor_config.json (for OneFormer also the tokenizer), or a
            name on the hub.
        least: Least confidence of a pixel's class; below it the pixel has none.
        longest: Longest side of the image that it sees [pixels].
        device: Where it runs.

    Raises:
        InputError: The model cannot be loaded.
    """

    space = LABEL_SPACE
    needs_image = True

    def __init__(self, path: str, least: float = 0.5, longest: int = 640, device: str | torch.device = "cpu") -> None:
        what = f"encoder mask2former:{path}"
        config = load_config(path, what, tuple(CLASSES))
        if not 0.0 <= least < 1.0 or longest < STRIDE:
            raise InputError(f"{what}: least is a confidence from 0 to 1 and longest at least {STRIDE}")
        self.least, self.longest = least, longest
        self.kind: str = config.model_type
        self.device = torch.device(device)
        self.model = load_model(CLASSES[self.kind], path, what, device)
        self.preparation = Preparation.load(path, what)
        self.labels = tuple(config.id2label[number] for number in range(len(config.id2label)))
        if len(set(self.labels)) < len(self.labels):  # COCO panoptic has no doubles, but nothing forbids them
            self.labels = tuple(f"{name} {number}" for number, name in enumerate(self.labels))
        self.identity = f"{self.kind}, {identity_of_weights(self.model)}, {least}, {longest}, {self.preparation}"
        self._task: dict[str, Tensor] = {}
        if self.kind == "oneformer":
            tokens = load_tokenizer(path, what)(
                [TASK], padding="max_length", max_length=config.task_seq_len, truncation=True, return_tensors="pt"
            )
            self._task = {"task_inputs": tokens["input_ids"].to(self.device)}

    def cache_key(self, view: View) -> str:
        return f"labels({self.identity})"

    def encode(self, view: View, image: Tensor | None) -> FeatureMap:
        """Id map: the class with the greatest share at each pixel, at a quarter of the network's input."""
        if image is None:
            raise InputError(f"view {view.stem}: this encoder needs an image")
        height, width = fitted(image.shape[0], image.shape[1], self.longest, STRIDE)
        values = self.preparation.normalise(self.preparation.resize(channels_first(image, self.device), height, width))
        inputs = {"pixel_values": values, "pixel_mask": torch.ones_like(values[:, 0], dtype=torch.int64)}
        with torch.no_grad():
            found = self.model(**inputs, **self._task)
        shares = class_shares(found.class_queries_logits[0], found.masks_queries_logits[0])
        shares = interpolate(shares[None], (height // 4, width // 4), mode="bilinear", align_corners=False)[0]
        best, number = shares.max(dim=0)
        return FeatureMap(self.space, ids=torch.where(best >= self.least, number, -1).cpu(), labels=self.labels)


def class_shares(classes: Tensor, masks: Tensor) -> Tensor:
    """Class scores of every pixel, float32 [K, h, w]: summed over the queries, class probability times mask.

    Args:
        classes: Logits of Q queries over K classes and "nothing", [Q, K + 1].
        masks: Logits, [Q, h, w].
    """
    return torch.einsum("qk,qyx->kyx", classes.float().softmax(dim=-1)[:, :-1], masks.float().sigmoid())


def make_source(member: Member, request: Request) -> MapSource:
    """Shares of the classes that it was trained on."""
    return ClosedSet(member.source.argument, device=request.device, **member.source.options)
