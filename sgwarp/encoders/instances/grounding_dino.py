"""GroundingDINO through transformers: boxes of the things that a list of phrases names."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from sgwarp.encoders.base import Instances, MapSource
from sgwarp.encoders.building import Request, own, source_of_instances
from sgwarp.encoders.instances.detections import DetectorSettings, keep_detections
from sgwarp.encoders.names import Member
from sgwarp.encoders.weights import (
    Preparation,
    channels_first,
    identity_of_weights,
    load_config,
    load_model,
    load_tokenizer,
)
from sgwarp.errors import InputError
from sgwarp.scene import View

STRIDE = 32  # of the backbone's last level: sides are multiples of it
END = "."  # what separates the phrases of a prompt
LEAST_SCORE = 0.25  # of a box, if none is asked for


class GroundingDino:
    """An InstanceEncoder.

    Args:
        path: Folder with config.json, weights, tokenizer and preprocessor_config.json, or a name on the hub.
        classes: What to look for. A long list is asked in several prompts.
        settings: Which boxes count.
        device: Where it runs.

    Raises:
        InputError: The model cannot be loaded, or there are no phrases.
    """

    def __init__(
        self,
        path: str,
        classes: Sequence[str],
        settings: DetectorSettings | None = None,
        device: str | torch.device = "cpu",
    ) -> None:
        what = f"encoder gdino:{path}"
        if not classes:
            raise InputError(f"{what}: needs the names to look for: gdino:{path}?classes=couch,lamp")
        load_config(path, what, ("grounding-dino",))
        self.classes = tuple(classes)
        self.settings = settings or DetectorSettings(LEAST_SCORE)
        self.device = torch.device(device)
        self.model = load_model("GroundingDinoForObjectDetection", path, what, device)
        self.preparation = Preparation.load(path, what)
        self.tokenizer = load_tokenizer(path, what)
        self.identity = (
            f"grounding-dino, {identity_of_weights(self.model)}, {self.classes}, {self.settings!r}, {self.preparation}"
        )
        self._prompts = list(self._fill_prompts(what))

    def identity_of(self, view: View) -> str:
        return ""

    def find(self, view: View, image: Tensor) -> Instances:
        """Boxes, names and scores of what an image, float32 [H, W, 3], shows."""
        values = self.preparation.normalise(self._resize(channels_first(image, self.device)))
        boxes, names, scores = [], [], []
        for first, tokens, owners in self._prompts:
            with torch.no_grad():
                found = self.model(pixel_values=values, **{name: t.to(self.device) for name, t in tokens.items()})
            per_token = found.logits[0, :, : len(owners)].sigmoid().cpu()
            # A phrase is as likely as the likeliest of its tokens.
            per_class = torch.stack(
                [per_token[:, owners == k].amax(dim=1) for k in range(int(owners.max()) + 1)], dim=1
            )
            best, place = per_class.max(dim=1)
            boxes.append(found.pred_boxes[0].cpu())
            scores.append(best)
            names += [self.classes[first + k] for k in place.tolist()]
        return keep_detections(torch.cat(boxes), names, torch.cat(scores), self.settings, image.shape[:2])

    def _resize(self, images: Tensor) -> Tensor:
        """The shorter side at the model's, unless the longer would exceed its own limit."""
        size = dict(self.preparation.size)
        height, width = images.shape[2:]
        scale = size.get("shortest_edge", 800) / min(height, width)
        scale = min(scale, size.get("longest_edge", 1333) / max(height, width))
        high, wide = (max(1, round(side * scale / STRIDE)) * STRIDE for side in (height, width))
        return self.preparation.resize(images, high, wide)

    def _fill_prompts(self, what: str) -> Iterator[tuple[int, dict[str, Tensor], Tensor]]:
        """Number of the first class, tokens, and the class of each token (-1 for none), prompt by prompt."""
        pieces = [
            self.tokenizer(f"{name.strip().lower()} {END}", add_special_tokens=False)["input_ids"]
            for name in self.classes
        ]
        limit = int(self.model.config.text_config.max_position_embeddings)
        limit = min(limit, int(self.model.config.max_text_len))
        start, end = self.tokenizer.cls_token_id, self.tokenizer.sep_token_id
        first = 0
        while first < len(pieces):
            ids, owners, count = [start], [-1], 0
            while first + count < len(pieces) and len(ids) + len(pieces[first + count]) < limit:
                piece = pieces[first + count]
                ids += piece
                owners += [count] * (len(piece) - 1) + [-1]
                count += 1
            if not count:
                raise InputError(f"{what}: '{self.classes[first]}' is longer than a prompt of {limit} tokens")
            tokens = torch.tensor([[*ids, end]])
            asked = {
                "input_ids": tokens,
                "attention_mask": torch.ones_like(tokens),
                "token_type_ids": torch.zeros_like(tokens),
            }
            yield first, asked, torch.tensor([*owners, -1])
            first += count


def make_source(member: Member, request: Request) -> MapSource:
    """Its boxes, or the masks inside them, as the text side embeds their names."""
    part = member.source
    settings = DetectorSettings(**{"least_score": LEAST_SCORE, **own(part, DetectorSettings)})
    detector = GroundingDino(part.argument, part.options.get("classes", ()), settings, request.device)
    return source_of_instances(detector, member, request)
