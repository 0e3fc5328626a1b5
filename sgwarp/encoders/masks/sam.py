"""SAM, SAM 2 and SAM 3 through transformers: masks of everything in an image, and the mask in a box.

"Everything" asks for the masks at a grid of points, three per point (subpart, part and whole, which are the ranks
small, middle and large), and keeps those that the network itself thinks good, that do not change when the threshold
does, and that repeat no better one (Kirillov et al., Segment Anything, 2023, Sec. 5).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import interpolate, pad

from sgwarp.encoders.base import MaskGenerator, Masks
from sgwarp.encoders.building import Request, levels_of, own
from sgwarp.encoders.names import Part
from sgwarp.encoders.regions import mask_boxes
from sgwarp.encoders.weights import Preparation, channels_first, fitted, identity_of_weights, load_config, load_model
from sgwarp.errors import InputError
from sgwarp.scene import View

# Checkpoints of the video models hold the weights of the image models too.
CLASSES = {
    "sam": "SamModel",
    "sam2": "Sam2Model",
    "sam2_video": "Sam2Model",
    "sam3": "Sam3TrackerModel",
    "sam3_video": "Sam3TrackerModel",
    "sam3_tracker": "Sam3TrackerModel",
}


@dataclass(frozen=True)
class SamSettings:
    """Settings of the "segment everything" mode.

    Attributes:
        points: Points along each side of the grid.
        together: Prompts that go through the decoder at once.
        least_score: Least quality that the network itself gives a mask.
        least_stability: Least IoU of a mask with itself at thresholds `offset` higher and lower.
        offset: Of the threshold, in logits.
        overlap: Of two masks whose boxes overlap by this IoU or more, the worse is dropped.
        smallest: Least share of the image that a mask covers.
        longest: Longest side of the masks [pixels].
        by_rank: Whether masks of different rank may repeat each other, so that each level is complete.
    """

    points: int = 32
    together: int = 64
    least_score: float = 0.88
    least_stability: float = 0.95
    offset: float = 1.0
    overlap: float = 0.7
    smallest: float = 1e-4
    longest: int = 1024
    by_rank: bool = False


class Sam:
    """A MaskGenerator; the model's type decides which SAM it is.

    Args:
        path: Folder with config.json, weights and preprocessor_config.json, or a name on the hub.
        settings: Of "everything".
        device: Where it runs; masks come back on the CPU.

    Raises:
        InputError: The model cannot be loaded.
    """

    def __init__(self, path: str, settings: SamSettings | None = None, device: str | torch.device = "cpu") -> None:
        what = f"masks sam:{path}"
        config = load_config(path, what, tuple(CLASSES))
        self.kind: str = config.model_type
        self.settings = settings or SamSettings()
        self.device = torch.device(device)
        self.model = load_model(CLASSES[self.kind], path, what, device)
        self.preparation = Preparation.load(path, what)
        sized = self.model.config.vision_config if self.kind == "sam" else self.model.config.prompt_encoder_config
        self.side = int(sized.image_size)
        self.identity = f"{self.kind}, {identity_of_weights(self.model)}, {self.settings!r}, {self.preparation}"

    def identity_of(self, view: View) -> str:
        return ""

    def everything(self, view: View, image: Tensor) -> Masks:
        """The masks at a grid of points, without repetitions, the best first."""
        embedding, inside = self._look(image)
        steps = (torch.arange(self.settings.points, dtype=torch.float32) + 0.5) / self.settings.points
        grid = torch.cartesian_prod(steps, steps).flip(1)  # row by row; x, y in shares of the image
        points = grid * torch.tensor([inside[1], inside[0]], dtype=torch.float32)
        kept: list[tuple[Tensor, Tensor, Tensor]] = []
        for part in points.split(self.settings.together):
            logits, scores = self._decode(embedding, input_points=part[None, :, None].to(self.device))
            kept.append(self._good(logits, scores, inside))
        logits, scores, ranks = (torch.cat(column) for column in zip(*kept, strict=True))
        masks = self._at_size(logits, inside, image)
        areas = masks.flatten(1).sum(dim=1)
        large = areas >= max(1.0, self.settings.smallest * masks.shape[1] * masks.shape[2])
        found = Masks(masks[large], scores[large], ranks[large])
        return without_repetitions(found, self.settings.overlap, self.settings.by_rank)

    def in_boxes(self, image: Tensor, boxes: Tensor) -> Tensor:
        """The mask in each box, float32 [K, 4] in pixels of the image, bool [K, h, w]."""
        embedding, inside = self._look(image)
        height, width = image.shape[:2]
        scale = torch.tensor([inside[1] / width, inside[0] / height] * 2)
        masks = []
        for part in (boxes.cpu() * scale).split(self.settings.together):
            logits, _ = self._decode(embedding, input_boxes=part[None].to(self.device), multimask_output=False)
            masks.append(self._at_size(logits[:, 0], inside, image))
        return torch.cat(masks)

    def _look(self, image: Tensor) -> tuple[Any, tuple[int, int]]:
        """Image embedding for the prompts, and the part of the square input that the image fills, (height, width)."""
        keeps_shape = self.kind == "sam"  # and leaves the rest of the square empty
        inside = fitted(image.shape[0], image.shape[1], self.side, 1) if keeps_shape else (self.side, self.side)
        images = self.preparation.resize(channels_first(image, self.device), *inside)
        values = pad(self.preparation.normalise(images), (0, self.side - inside[1], 0, self.side - inside[0]))
        with torch.no_grad():
            return self.model.get_image_embeddings(values), inside

    def _decode(self, embedding: Any, **prompts: Any) -> tuple[Tensor, Tensor]:
        """Mask logits, [P, K, s, s], and scores, [P, K], of P prompts."""
        with torch.no_grad():
            found = self.model(image_embeddings=embedding, **prompts)
        return found.pred_masks[0].float(), found.iou_scores[0].float()

    def _good(self, logits: Tensor, scores: Tensor, inside: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
        """Logits [m, s, s], scores and ranks of the good masks among [P, K, s, s]."""
        ranks = torch.arange(scores.shape[1], device=scores.device).expand_as(scores)
        chosen = scores >= self.settings.least_score
        logits, scores, ranks = logits[chosen], scores[chosen], ranks[chosen]
        rows, columns = (-(-logits.shape[1] * side // self.side) for side in inside)
        seen = logits[:, :rows, :columns].flatten(1)
        high, low = ((seen > offset).sum(dim=1) for offset in (self.settings.offset, -self.settings.offset))
        stable = (high >= self.settings.least_stability * low) & (high > 0)
        return logits[stable].cpu(), scores[stable].cpu(), ranks[stable].cpu()

    def _at_size(self, logits: Tensor, inside: tuple[int, int], image: Tensor) -> Tensor:
        """Masks in the shape of the image, bool [m, h, w], from logits [m, s, s] of the square."""
        longest = min(self.settings.longest, max(image.shape[:2]))
        size = fitted(image.shape[0], image.shape[1], longest, 1)
        if not len(logits):
            return torch.zeros(0, *size, dtype=torch.bool)
        masks = []
        for part in logits.split(16):
            square = interpolate(part[None], (self.side, self.side), mode="bilinear", align_corners=False)
            filled = square[:, :, : inside[0], : inside[1]]
            masks.append((interpolate(filled, size, mode="bilinear", align_corners=False)[0] > 0).cpu())
        return torch.cat(masks)


def without_repetitions(masks: Masks, overlap: float, by_rank: bool = False) -> Masks:
    """Masks none of whose boxes overlaps that of a better one by an IoU of `overlap` or more, the best first.

    Args:
        masks: None of them empty.
        overlap: In (0, 1].
        by_rank: Compare only masks of the same rank.
    """
    order = torch.argsort(masks.scores, descending=True, stable=True)
    boxes = mask_boxes(masks.masks)[order] if len(order) else torch.zeros(0, 4)
    kept = best_boxes(boxes, overlap, masks.ranks[order] if by_rank else None)
    chosen = order[kept]
    return Masks(masks.masks[chosen], masks.scores[chosen], masks.ranks[chosen])


def best_boxes(boxes: Tensor, overlap: float, groups: Tensor | None = None) -> Tensor:
    """Non-maximum suppression per group: boxes [K, 4], best first, that repeat no better one, bool [K]."""
    if not 0 < overlap <= 1:
        raise InputError(f"overlap: expected an IoU in (0, 1], got {overlap}")
    boxes = boxes.to(torch.float32)
    low = torch.maximum(boxes[:, None, :2], boxes[None, :, :2])
    high = torch.minimum(boxes[:, None, 2:], boxes[None, :, 2:])
    shared = (high - low).clamp(min=0).prod(dim=2)
    areas = (boxes[:, 2:] - boxes[:, :2]).prod(dim=1)
    repeats = shared >= overlap * (areas[:, None] + areas - shared).clamp(min=1e-12)
    if groups is not None:
        repeats &= groups[:, None] == groups
    kept = torch.ones(len(boxes), dtype=torch.bool)
    for number in range(len(boxes)):
        if kept[number]:
            kept[number + 1 :] &= ~repeats[number, number + 1 :].cpu()
    return kept


def make_masks(part: Part, request: Request) -> MaskGenerator:
    """SAM, SAM 2 or SAM 3, as the files say."""
    by_rank = levels_of(part) != ("default",)
    return Sam(part.argument, SamSettings(by_rank=by_rank, **own(part, SamSettings)), request.device)
