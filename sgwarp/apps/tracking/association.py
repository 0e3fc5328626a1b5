"""Ids over views and time for masks that have none: an id image says which pixels belong together, and nothing else.

The Gaussians remember which object the masks so far gave them to. Seen from the camera of the next mask image, at the
next moment, they tell which object each mask continues; a mask of mostly unknown Gaussians is a new object. Neighboring
cameras should follow each other: of an object, two views must share a part for its masks to become one.
"""

from __future__ import annotations

import torch
from torch import Tensor

from sgwarp.apps.tracking.sources import FrameSource
from sgwarp.errors import InputError
from sgwarp.io.moving_views import FrameView
from sgwarp.ops.splatting.forward import rasterize
from sgwarp.ops.splatting.lifting import LiftSums, lift_view
from sgwarp.scene import FeatureMap, Gaussians

CLEAR = 0.5  # share of a mask that must agree on an object, or on being unknown
LIKELY = 0.3  # share that is enough where neither is clear
MEMORY = 0.7  # weight of earlier frames after one more
KNOWN = 0.5  # opacity of remembered Gaussians that makes a pixel known


class Associated:
    """A source of id images whose ids mean nothing across images, as one whose ids stay."""

    needs_image = False

    def __init__(self, source: FrameSource) -> None:
        self.source = source
        self._gaussians: Gaussians | None = None
        self._sums: LiftSums | None = None
        self.count = 0  # objects so far

    def observe(self, gaussians: Gaussians) -> None:
        """The next frame begins.

        Raises:
            InputError: The Gaussians are not those of the frame before.
        """
        before = self._gaussians
        if before is not None and len(before) and len(gaussians) and len(before) != len(gaussians):
            raise InputError(
                f"masks without ids: the number of Gaussians changed from {len(before)} to {len(gaussians)}; only "
                "Gaussians that stay can remember objects"
            )
        self._gaussians = gaussians if len(gaussians) or before is None else before
        if self._sums is not None:
            for total in (self._sums.slices, self._sums.weight):
                total.mul_(MEMORY)

    def encode(self, frame: int, view: FrameView, image: Tensor | None) -> FeatureMap:
        found = self.source.encode(frame, view, image)
        if found.ids is None or found.vectors is not None:
            raise InputError(f"frame {frame}, view {view.view.stem}: has no id image; masks without ids need one")
        assert self._gaussians is not None
        masks = found.ids[0].to(torch.int64)
        table = self._match(masks, self._expected(view, masks))
        ids = table[masks]
        labels = tuple(str(k + 1) for k in range(max(1, self.count)))
        result = FeatureMap(found.space, ids=ids, labels=labels)
        self._remember(view, result)
        return result

    def _expected(self, view: FrameView, masks: Tensor) -> Tensor:
        """Object that is expected at each pixel of the masks, -1 where unknown, int64 [h, w]."""
        if self._sums is None or self._gaussians is None or not len(self._gaussians):
            return torch.full_like(masks, -1)
        weight = self._sums.weight
        shares = self._sums.features / torch.where(weight > 0, weight, 1.0)[:, None]
        seen = (weight > 0).float()[:, None]
        blended = rasterize(self._gaussians, view.view.camera, torch.cat([shares, seen], dim=1)).features
        best = torch.where(blended[..., -1] >= KNOWN, blended[..., :-1].argmax(dim=2), -1)
        h, w = masks.shape
        height, width = best.shape
        rows = ((2 * torch.arange(h) + 1) * height) // (2 * h)
        columns = ((2 * torch.arange(w) + 1) * width) // (2 * w)
        return best[rows][:, columns]

    def _match(self, masks: Tensor, expected: Tensor) -> Tensor:
        """Object of each mask, -1 for none, int64; the last entry is that of pixels without a mask."""
        count = int(masks.max()) + 1
        table = torch.full((count + 1,), -1)
        columns = self.count + 1
        pairs = torch.bincount(((masks + 1) * columns + expected + 1).flatten(), minlength=(count + 1) * columns).view(
            count + 1, columns
        )[1:]
        shares = pairs.double() / pairs.sum(dim=1, keepdim=True).clamp(min=1)
        for mask in range(count):
            if not int(pairs[mask].sum()):
                continue
            best, place = shares[mask, 1:].max(dim=0) if columns > 1 else (torch.tensor(0.0), torch.tensor(0))
            if float(best) >= CLEAR:
                table[mask] = place
            elif float(shares[mask, 0]) >= CLEAR:
                table[mask] = self.count
                self.count += 1
            elif float(best) >= LIKELY:
                table[mask] = place
        return table

    def _remember(self, view: FrameView, found: FeatureMap) -> None:
        assert self._gaussians is not None
        n, device = len(self._gaussians), self._gaussians.device
        if not n:
            return
        channels = found.channels
        if self._sums is None:
            self._sums = LiftSums.zeros(n, channels, device)
        if channels > self._sums.channels:
            wider = LiftSums.zeros(n, channels, device)
            wider.slices[:, : self._sums.slices.shape[1]] = self._sums.slices
            self._sums = LiftSums(wider.slices, channels, self._sums.weight, self._sums.weight_squared)
        lift_view(self._gaussians, view.view.camera, found, self._sums)
