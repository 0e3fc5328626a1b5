"""Ids over views and time for masks that have none: an id image says which pixels belong together, and nothing else.

The Gaussians remember which object the masks so far gave them to. Seen from the camera of the next mask image, at the
next moment, they tell which object each mask continues; a mask of mostly unknown Gaussians is a new object.
"""

from __future__ import annotations

import torch
from torch import Tensor

from sgwarp.apps.tracking.sources import FrameSource
from sgwarp.encoders.base import MissingMap
from sgwarp.encoders.maps.files import LABEL_SPACE
from sgwarp.errors import InputError
from sgwarp.io.moving_views import FrameView
from sgwarp.ops.splatting.forward import rasterize
from sgwarp.ops.splatting.lifting import LiftSums, lift_view
from sgwarp.scene import FeatureMap, Gaussians

CLEAR = 0.5  # share of a mask that is unknown, or belongs to other masks, from which on it is a new object
LIKELY = 0.25  # least share of a mask that continues an object
PART = 0.2  # least share of a mask that makes it show a part of an object
LEAST_PIXELS = 16  # of a mask that is a new object
MEMORY = 0.7  # weight of earlier frames after one more
KNOWN = 0.5  # opacity of remembered Gaussians that makes a pixel known


class Associated:
    """A source of id images whose ids mean nothing across images, as one whose ids stay.

    All images of a frame are matched before the first is handed on. Two objects become one where a mask shows parts of
    both, unless some image had them as two masks.
    """

    needs_image = False
    of_space = LABEL_SPACE

    def __init__(self, source: FrameSource) -> None:
        self.source = source
        self._gaussians: Gaussians | None = None
        self._sums: LiftSums | None = None
        self._apart: set[tuple[int, int]] = set()  # pairs of objects that are two masks of one image
        self._ready: dict[str, Tensor] = {}  # objects in the images of this frame, int64 [h, w]
        self.count = 0  # objects so far, those that became one with another included
        self.joined: list[tuple[int, int]] = []  # in this frame: objects that stay, and those that became one with them

    def observe(self, frame: int, gaussians: Gaussians, views: list[FrameView]) -> None:
        """Match all images of the next frame.

        Raises:
            InputError: The Gaussians are not those of the frame before, or a view has no id image.
        """
        before = self._gaussians
        if before is not None and len(before) and len(gaussians) and len(before) != len(gaussians):
            raise InputError(
                f"masks without ids: the number of Gaussians changed from {len(before)} to {len(gaussians)}; only "
                "Gaussians that stay can remember objects"
            )
        self._ready, self.joined = {}, []
        if not len(gaussians):
            return
        self._gaussians = gaussians
        if self._sums is not None:
            for total in (self._sums.slices, self._sums.weight):
                total.mul_(MEMORY)
        images = [(view, masks) for view in views if (masks := self._masks(frame, view)) is not None]
        known, changed = self.count, False
        for view, masks in images:
            table, joined = self._match(masks, self._expected(view, masks), True)
            changed |= joined
            self._ready[view.view.stem] = table[masks]
            self._remember(view, table[masks])
        if self.count > known or changed:  # what later images taught, earlier ones did not know
            for view, masks in images:
                table, _ = self._match(masks, self._expected(view, masks), False)
                self._ready[view.view.stem] = table[masks]

    def _masks(self, frame: int, view: FrameView) -> Tensor | None:
        """Number of the mask of each pixel, -1 for none, int64 [h, w]; None where there is no image."""
        try:
            found = self.source.encode(frame, view, None)
        except MissingMap:
            return None
        if found.ids is None or found.vectors is not None:
            raise InputError(f"frame {frame}, view {view.view.stem}: has no id image; masks without ids need one")
        return found.ids[0].to(torch.int64)

    def encode(self, frame: int, view: FrameView, image: Tensor | None) -> FeatureMap:
        """The objects of an image, as a one-hot map."""
        if view.view.stem not in self._ready:
            raise MissingMap(f"frame {frame}, view {view.view.stem}: has no id image")
        labels = tuple(str(k + 1) for k in range(max(1, self.count)))
        return FeatureMap(LABEL_SPACE, ids=self._ready[view.view.stem], labels=labels)

    def _expected(self, view: FrameView, masks: Tensor) -> Tensor:
        """Object that is expected at each pixel of the masks, -1 where unknown, int64 [h, w]."""
        if self._sums is None or self._gaussians is None or not bool((self._sums.weight > 0).any()):
            return torch.full_like(masks, -1)
        weight = self._sums.weight
        shares = self._sums.features / torch.where(weight > 0, weight, 1.0)[:, None]
        # The border of a mask reaches a little onto what is behind: such Gaussians are hardly known.
        known = (weight / weight[weight > 0].median()).clamp(max=1.0)[:, None]
        blended = rasterize(self._gaussians, view.view.camera, torch.cat([shares * known, known], dim=1)).features
        best = torch.where(blended[..., -1] >= KNOWN, blended[..., :-1].argmax(dim=2), -1)
        h, w = masks.shape
        height, width = best.shape
        rows = ((2 * torch.arange(h) + 1) * height) // (2 * h)
        columns = ((2 * torch.arange(w) + 1) * width) // (2 * w)
        return best[rows][:, columns]

    def _match(self, masks: Tensor, expected: Tensor, fresh: bool) -> tuple[Tensor, bool]:
        """Object of each mask, -1 for none, int64, the last entry for pixels without a mask; whether objects joined.

        Only with `fresh` are there new objects.
        """
        count, columns = int(masks.max()) + 1, self.count + 1
        pairs = (masks + 1) * columns + expected + 1
        pixels = torch.bincount(pairs.flatten(), minlength=(count + 1) * columns).view(count + 1, columns)[1:]
        shares = pixels.double() / pixels.sum(dim=1, keepdim=True).clamp(min=1)
        table = torch.full((count + 1,), -1)
        # The best fitting pairs first; two masks of one image are two objects.
        union = pixels.sum(dim=1, keepdim=True) + pixels.sum(dim=0) - pixels
        fits = (pixels.double() / union.clamp(min=1))[:, 1:]
        taken: set[int] = set()
        for pair in fits.flatten().argsort(descending=True).tolist():
            mask, best = divmod(pair, max(1, columns - 1))
            if float(shares[mask, 1 + best]) >= LIKELY and int(table[mask]) < 0 and best not in taken:
                table[mask] = best
                taken.add(best)
        large = pixels.sum(dim=1) >= LEAST_PIXELS
        for mask in large.nonzero().flatten().tolist() if fresh else []:
            foreign = float(shares[mask, 0]) + sum(float(shares[mask, 1 + one]) for one in taken)
            if int(table[mask]) < 0 and foreign >= CLEAR:
                table[mask] = self.count
                self.count += 1
        found = sorted({int(one) for one in table if one >= 0})
        self._apart |= {(one, other) for one in found for other in found if one < other}
        joined = False
        for mask in range(count):
            both = (shares[mask, 1:] >= PART).nonzero().flatten().tolist()
            for other in both[1:]:
                joined |= self._join(both[0], other, table)
        return table, joined

    def _join(self, kept: int, gone: int, table: Tensor) -> bool:
        """Make two objects one, unless they were seen as two."""
        if (kept, gone) in self._apart or self._sums is None or gone >= self._sums.channels:
            return False
        flat = self._sums.features
        flat[:, kept] += flat[:, gone]
        flat[:, gone] = 0.0
        table[table == gone] = kept
        self.joined.append((kept, gone))
        rename = {gone: kept}
        pairs = ((rename.get(one, one), rename.get(other, other)) for one, other in self._apart)
        self._apart = {(min(pair), max(pair)) for pair in pairs if pair[0] != pair[1]}
        for ids in self._ready.values():
            ids[ids == gone] = kept
        return True

    def _remember(self, view: FrameView, ids: Tensor) -> None:
        """Give the Gaussians of a view to the objects that it shows."""
        assert self._gaussians is not None
        channels = max(1, self.count)
        if self._sums is None:
            self._sums = LiftSums.zeros(len(self._gaussians), channels, self._gaussians.device)
        if channels > self._sums.channels:
            wider = LiftSums.zeros(len(self._gaussians), channels, self._gaussians.device)
            wider.slices[:, : self._sums.slices.shape[1]] = self._sums.slices
            self._sums = LiftSums(wider.slices, channels, self._sums.weight, self._sums.weight_squared)
        labels = tuple(map(str, range(channels)))
        lift_view(self._gaussians, view.view.camera, FeatureMap(LABEL_SPACE, ids=ids, labels=labels), self._sums)
