"""OWLv2 through transformers: boxes of the things that a list of phrases names."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import pad

from sgwarp.encoders.base import Instances, MapSource
from sgwarp.encoders.building import Request, own, source_of_instances
from sgwarp.encoders.instances.detections import DetectorSettings, keep_detections
from sgwarp.encoders.names import Member
from sgwarp.encoders.prompts import PHOTO, fill_templates
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

GREY = 0.5  # of the square around the image
LEAST_SCORE = 0.1  # of a box, if none is asked for


class Owlv2:
    """An InstanceEncoder.

    Args:
        path: Folder with config.json, weights, tokenizer and preprocessor_config.json, or a name on the hub.
        classes: What to look for.
        templates: One template that the names are put into.
        settings: Which boxes count.
        device: Where it runs.

    Raises:
        InputError: The model cannot be loaded, there are no names, or more than one template.
    """

    def __init__(
        self,
        path: str,
        classes: Sequence[str],
        templates: Sequence[str] = PHOTO,
        settings: DetectorSettings | None = None,
        device: str | torch.device = "cpu",
    ) -> None:
        what = f"encoder owlv2:{path}"
        if not classes or len(templates) != 1:
            raise InputError(f"{what}: needs the names to look for, and one template: owlv2:{path}?classes=couch,lamp")
        load_config(path, what, ("owlv2",))
        self.classes = tuple(classes)
        self.settings = settings or DetectorSettings(LEAST_SCORE)
        self.device = torch.device(device)
        self.model = load_model("Owlv2ForObjectDetection", path, what, device)
        self.preparation = Preparation.load(path, what)
        self.side = int(self.model.config.vision_config.image_size)
        prompts = fill_templates(self.classes, templates)
        self.identity = f"owlv2, {identity_of_weights(self.model)}, {prompts}, {self.settings!r}, {self.preparation}"
        length = int(self.model.config.text_config.max_position_embeddings)
        tokens = load_tokenizer(path, what)(
            prompts, padding="max_length", max_length=length, truncation=True, return_tensors="pt"
        )
        self._tokens = {name: tokens[name].to(self.device) for name in ("input_ids", "attention_mask")}

    def identity_of(self, view: View) -> str:
        return ""

    def find(self, view: View, image: Tensor) -> Instances:
        """Boxes, names and scores of what an image, float32 [H, W, 3], shows."""
        height, width = image.shape[:2]
        longest = max(height, width)
        square = pad(channels_first(image, self.device), (0, longest - width, 0, longest - height), value=GREY)
        values = self.preparation.normalise(self.preparation.resize(square, self.side, self.side))
        with torch.no_grad():
            found = self.model(pixel_values=values, **self._tokens)
        best, place = found.logits[0].cpu().max(dim=1)
        names = [self.classes[k] for k in place.tolist()]
        # Boxes are shares of the square.
        return keep_detections(
            found.pred_boxes[0].cpu(), names, best.sigmoid(), self.settings, (height, width), longest
        )


def make_source(member: Member, request: Request) -> MapSource:
    """Its boxes, or the masks inside them, as the text side embeds their names."""
    part = member.source
    settings = DetectorSettings(**{"least_score": LEAST_SCORE, **own(part, DetectorSettings)})
    classes, templates = part.options.get("classes", ()), request.templates_of(part)
    detector = Owlv2(part.argument, classes, settings=settings, device=request.device, **templates)
    return source_of_instances(detector, member, request)
