"""How much every mask of every view says about every Gaussian, as sparse matrices.

The weight of a mask for a Gaussian is the sum of alpha T over its pixels: an entry of A^T M with A the renderer and M
the masks. Masks may overlap; a view is cut into the sets of masks that cover its pixels, which do not, and those are
lifted as ids in one pass. A Gaussian and a set take 10 bytes, and only where the set shows the Gaussian.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sgwarp.encoders.base import LEVELS, MissingMap
from sgwarp.encoders.masks.sources import MaskSource, ViewMasks
from sgwarp.encoders.painting import cover_sets
from sgwarp.errors import InputError
from sgwarp.ops.splatting.id_weights import weigh_pairs
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.rendering.renderer import render
from sgwarp.runs.log import RunLog
from sgwarp.runs.progress import Report
from sgwarp.scene import Gaussians, View

MAX_SETS = 32767  # of a view: they are stored in 16 bits


@dataclass(frozen=True, eq=False)
class ViewEvidence:
    """What the masks of one view say.

    Attributes:
        stem: Name of the view.
        gaussians: Gaussian of each pair, int32 [P].
        sets: Set of masks that shows it, int16 [P]; the last set holds no mask.
        weights: Sum of alpha T over the pixels of that set, float32 [P].
        members: Whether a mask belongs to a set, bool [S, M].
        ranks: Level of each mask, 0, 1, 2 or -1 for none, int64 [M].
        names: What the source calls each mask; empty where it gives no names.
    """

    stem: str
    gaussians: NDArray[np.int32]
    sets: NDArray[np.int16]
    weights: NDArray[np.float32]
    members: NDArray[np.bool_]
    ranks: NDArray[np.int64]
    names: tuple[str, ...]

    def masks_of(self, level: str) -> NDArray[np.int64]:
        """Masks of a level."""
        if level == "default":
            return np.arange(len(self.ranks))
        return np.flatnonzero(self.ranks == LEVELS.index(level) - 1)

    def totals(self, count: int) -> NDArray[np.float64]:
        """Weight of each Gaussian in this view, float64 [N]."""
        return np.bincount(self.gaussians, weights=self.weights, minlength=count).astype(np.float64)

    def mask_pairs(
        self, masks: NDArray[np.int64], wanted: NDArray[np.bool_] | None = None
    ) -> tuple[NDArray[np.int32], NDArray[np.int64], NDArray[np.float32]]:
        """Gaussian, place in `masks` and weight of the pairs of a Gaussian and a mask, once per set that they share.

        Args:
            masks: Masks to look at.
            wanted: Gaussians to look at, bool [N]; None for all.
        """
        members = self.members[:, masks]
        counts = members.sum(axis=1)
        firsts = np.cumsum(counts) - counts
        places = np.nonzero(members)[1]
        repeats = counts[self.sets]
        if wanted is not None:
            repeats[~wanted[self.gaussians]] = 0
        if counts.max(initial=0) <= 1:  # masks that do not overlap
            pair = np.flatnonzero(repeats)
            return self.gaussians[pair], places[firsts[self.sets[pair]]], self.weights[pair]
        pair = np.repeat(np.arange(len(self.sets)), repeats)
        within = np.arange(len(pair)) - np.repeat(np.cumsum(repeats) - repeats, repeats)
        return self.gaussians[pair], places[firsts[self.sets[pair]] + within], self.weights[pair]

    @property
    def nbytes(self) -> int:
        """Memory of the pairs [bytes]."""
        return self.gaussians.nbytes + self.sets.nbytes + self.weights.nbytes


def gather_evidence(
    gaussians: Gaussians,
    views: Sequence[View],
    source: MaskSource,
    settings: RasterSettings,
    log: RunLog,
    progress: Report,
) -> list[ViewEvidence]:
    """Evidence of every view that has masks, in the order of the views.

    Raises:
        InputError: No view has a mask, or none of them shows a Gaussian.
    """
    found = []
    progress(0, len(views), "")
    for done, view in enumerate(views, start=1):
        masks = _read(gaussians, view, source, settings, log)
        if masks is not None:
            with log.stage("lift"):
                found.append(view_evidence(gaussians, view, masks, settings))
        progress(done, len(views), view.stem)
    if not any(len(one.ranks) for one in found):
        raise InputError(f"no mask in any of the {len(views)} views; file names must match the view stems")
    if not any(len(one.gaussians) for one in found):
        raise InputError("no view sees any Gaussian; scene and cameras are not in the same world frame")
    return found


def view_evidence(gaussians: Gaussians, view: View, masks: ViewMasks, settings: RasterSettings) -> ViewEvidence:
    """Evidence of one view.

    Raises:
        InputError: Its masks overlap in more ways than can be stored.
    """
    ids, members = cover_sets(masks.masks)
    count = len(members)
    if count > MAX_SETS:
        raise InputError(f"view {view.stem}: masks overlap in {count} ways, at most {MAX_SETS} are possible")
    ids = ids.where(ids >= 0, ids.new_tensor(count))
    owner, sets, weights = weigh_pairs(gaussians, view.camera, ids, settings)
    table = np.concatenate([members.numpy(), np.zeros((1, len(masks)), bool)])
    return ViewEvidence(
        view.stem,
        owner.cpu().numpy(),
        sets.cpu().numpy().astype(np.int16),
        weights.cpu().numpy(),
        table,
        masks.ranks.cpu().numpy(),
        masks.names,
    )


def _read(
    gaussians: Gaussians, view: View, source: MaskSource, settings: RasterSettings, log: RunLog
) -> ViewMasks | None:
    image = None
    if source.needs_image and view.image_path is not None:
        with log.stage("read"):
            image = view.image()
    elif source.needs_image:
        with log.stage("render"):
            image = render(gaussians, view.camera, settings=settings).clamp(0.0, 1.0).cpu()
    try:
        with log.stage("masks"):
            return source.read(view, image)
    except MissingMap:
        log.leave_out("views_without_masks")
        return None
