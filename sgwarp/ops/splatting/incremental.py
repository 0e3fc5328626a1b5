"""Lifting frame after frame of a moving scene, leaving out what did not change.

Kept of every view, on the CPU: its splats (64 bytes per Gaussian), its tile lists (4 bytes per intersection), the id
map (4 bytes per pixel) with the ids of each tile (1 kB per tile), and for every intersection one weight (4 bytes) for
each id of its tile. Only Gaussians that changed are projected again. Only tiles are merged and walked again where such
a Gaussian lies or lay, or where the id map differs. Only sums of Gaussians in such tiles are added up again, in the
same order as by `lift_view`: the result has the same bits.

Dense maps are lifted in full whenever they are given: their sums, one row of features per intersection, would not fit
into memory. So is everything on CUDA, and every frame in which more than `rebuild_above` of the Gaussians changed.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.ops.memory import scratch
from sgwarp.ops.splatting import tiles
from sgwarp.ops.splatting.kept_views import (
    KeptView,
    add_level,
    differing_pixels,
    keep_view,
    lift_again,
    replace_changed,
    same_camera,
    tiles_of,
)
from sgwarp.ops.splatting.lifting import LiftSums, lift_view
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.scene import Camera, FeatureMap, Gaussians

REBUILD_ABOVE = 0.5  # share of changed Gaussians from which on everything is cheaper than the changes


@dataclass
class Work:
    """How much of a frame was done, and how much there was to do.

    Attributes:
        gaussians: N.
        changed: Gaussians whose geometry is not that of the frame before.
        projections, all_projections: Gaussians projected, summed over the views, and N for each view.
        tiles, all_tiles: Tiles walked, and tiles of all views.
        affected: Gaussians whose sums were added up again.
        direct: Whether the frame was lifted in full without keeping anything.
    """

    gaussians: int = 0
    changed: int = 0
    projections: int = 0
    all_projections: int = 0
    tiles: int = 0
    all_tiles: int = 0
    affected: int = 0
    direct: bool = False

    @property
    def left_out(self) -> float:
        """Share of the tiles that were not walked again, 0 to 1."""
        return 1.0 - self.tiles / self.all_tiles if self.all_tiles else 1.0


class IncrementalLift:
    """Sums of the views of one frame after another: `begin`, `add` every view, `finish`.

    Args:
        settings: The rasterizer's approximations.
        rebuild_above: Share of changed Gaussians above which a frame is lifted in full, and nothing kept; 0 lifts every
            frame in full.
    """

    def __init__(self, settings: RasterSettings | None = None, rebuild_above: float = REBUILD_ABOVE) -> None:
        self.settings = settings or RasterSettings()
        self.rebuild_above = rebuild_above
        self.work = Work()
        self._sums: LiftSums | None = None
        self._gaussians: Gaussians | None = None
        self._kept: dict[str, KeptView] = {}
        self._order: list[str] = []  # views of the frame before
        self._seen: list[str] = []  # views of this frame so far
        self._changed = torch.empty(0, dtype=torch.uint8)  # [N]
        self._moved = torch.empty(0, dtype=torch.int32)  # [M] their indices
        self._affected = torch.empty(0, dtype=torch.uint8)  # [N] whose sums are stale
        self._part: Gaussians  # the changed Gaussians

    @property
    def kept_bytes(self) -> int:
        """Memory of what is kept of the views."""
        return sum(kept.bytes for kept in self._kept.values())

    def begin(self, gaussians: Gaussians) -> None:
        """Start a frame: find out which Gaussians changed."""
        n, device = len(gaussians), gaussians.device
        before, self._gaussians = self._gaussians, gaussians
        self.work, self._seen = Work(gaussians=n), []
        comparable = before is not None and len(before) == n and before.device == device
        if comparable:
            assert before is not None
            self._changed = changed_rows(before, gaussians)
        else:
            self._changed = torch.ones(n, dtype=torch.uint8, device=device)
            self._kept, self._sums, self._order = {}, None, []
        self._moved = self._changed.nonzero().flatten().to(torch.int32)
        self.work.changed = len(self._moved)
        share = self.work.changed / n if n else 0.0
        # A first frame is kept: nothing says yet that everything moves.
        self.work.direct = (
            device.type != "cpu" or self.rebuild_above <= 0 or (comparable and share > self.rebuild_above)
        )
        if self.work.direct:
            self._forget()
        self._affected = self._changed.clone()
        if not self._kept:  # after a frame in full: whose sums change, nobody knows
            self._affected.fill_(1)
        elif not self.work.direct:
            index = self._moved.to(torch.int64)
            fields = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
            self._part = Gaussians.unchecked(*(values[index] for values in fields))

    def _forget(self) -> None:
        self._kept, self._order = {}, []
        if self._sums is not None:
            for total in (self._sums.slices, self._sums.weight, self._sums.weight_squared):
                total.zero_()

    def add(self, key: str, camera: Camera, feature_map: FeatureMap) -> None:
        """Add a view of this frame; `key` names it from frame to frame.

        Raises:
            InputError: The view was added before, or the number of channels became smaller.
        """
        gaussians = self._require_frame()
        if key in self._seen:
            raise InputError(f"view {key}: was added to this frame before")
        self._grow(feature_map.channels)
        if feature_map.ids is None and not self.work.direct:
            if self._seen:
                raise InputError(f"view {key}: has a dense map, the views before it have ids; lift one kind at a time")
            self.work.direct = True
            self._forget()
        self._seen.append(key)
        count = -(-camera.width // tiles.TILE) * -(-camera.height // tiles.TILE)
        self.work.all_tiles += count
        self.work.all_projections += len(gaussians)
        if self.work.direct:
            assert self._sums is not None
            if len(gaussians):
                lift_view(gaussians, camera, feature_map, self._sums, settings=self.settings)
            self.work.tiles += count
            self.work.projections += len(gaussians)
            return
        self._update(key, camera, feature_map)

    def finish(self) -> LiftSums:
        """The sums of all views of this frame; they are overwritten by the next."""
        gaussians = self._require_frame()
        if self._sums is None:
            self._sums = LiftSums.zeros(len(gaussians), 1, gaussians.device)
        if self.work.direct:
            self.work.affected = len(gaussians)
            return self._sums
        for key in [key for key in self._kept if key not in self._seen]:
            self._mark(self._kept.pop(key))
        if [k for k in self._seen if k in self._order] != [k for k in self._order if k in self._seen]:
            self._affected.fill_(1)  # the order of additions differs, and with it the rounding
        self._order = list(self._seen)
        self._add_up()
        return self._sums

    def _require_frame(self) -> Gaussians:
        if self._gaussians is None:
            raise InputError("no frame was begun; call begin(gaussians) first")
        return self._gaussians

    def _grow(self, channels: int) -> None:
        """Room for `channels` channels; ids that appear later get theirs behind the others."""
        assert self._gaussians is not None
        n, device = len(self._gaussians), self._gaussians.device
        if self._sums is None:
            self._sums = LiftSums.zeros(n, channels, device)
        sums = self._sums
        if channels < sums.channels:
            raise InputError(f"feature map: has {channels} channels, those before it {sums.channels}; lift one kind")
        if channels > sums.channels:
            slices = LiftSums.zeros(n, channels, device).slices
            slices[:, : sums.slices.shape[1]] = sums.slices
            self._sums = LiftSums(slices, channels, sums.weight, sums.weight_squared)

    def _update(self, key: str, camera: Camera, feature_map: FeatureMap) -> None:
        gaussians = self._require_frame()
        assert feature_map.ids is not None
        kept = self._kept.get(key)
        if kept is None or not same_camera(kept.camera, camera) or len(kept.levels) != len(feature_map.ids):
            if kept is not None:
                self._mark(kept)
            kept = keep_view(gaussians, camera, feature_map, self.settings)
            self._kept[key] = kept
            self._mark(kept)
            self.work.tiles += kept.tile_count
            self.work.projections += len(gaussians)
            return
        if len(self._moved):
            stale = replace_changed(kept, self._part, self._moved, self._changed, self.settings)
            self.work.projections += len(self._moved)
        else:
            stale = torch.zeros(kept.tile_count, dtype=torch.uint8)
        for old, new in zip(kept.levels, feature_map.ids, strict=True):
            pixels = differing_pixels(old.ids, new, kept.vectors, feature_map.vectors)
            if pixels is not None:
                stale |= tiles_of(pixels, camera)
        kept.vectors = feature_map.vectors
        chosen = stale.nonzero().flatten().to(torch.int32)
        if len(chosen):
            for level, ids in zip(kept.levels, feature_map.ids, strict=True):
                lift_again(kept, level, ids, stale, chosen, self._affected, self.settings)
        self.work.tiles += len(chosen)

    def _mark(self, kept: KeptView) -> None:
        """All Gaussians of a view are affected."""
        self._affected[kept.listed.to(torch.int64)] = 1

    def _add_up(self) -> None:
        """Sums of the affected Gaussians over all views, in the order of the views."""
        sums = self._sums
        assert sums is not None
        affected = self._affected.nonzero().flatten()
        self.work.affected = len(affected)
        if not len(affected):
            return
        for total in (sums.slices, sums.weight, sums.weight_squared):
            total[affected] = 0.0
        chosen = affected.to(torch.int32)
        places = scratch("affected places", len(self._affected), torch.int32, chosen.device).fill_(-1)
        places[affected] = torch.arange(len(chosen), dtype=torch.int32)
        for key in self._order:
            kept = self._kept[key]
            for level in kept.levels:
                add_level(kept, level, chosen, places, sums)


def changed_rows(before: Gaussians, after: Gaussians) -> Tensor:
    """Where geometry or opacity differ in any bit, or a row became finite or no longer is, uint8 [N]."""
    changed = torch.zeros(len(after), dtype=torch.bool, device=after.device)
    for name in ("means", "quats", "scales", "opacities"):
        one, other = getattr(before, name), getattr(after, name)
        if one is not other:
            differ = one.view(torch.int32) != other.view(torch.int32)  # NaN is the same as itself
            changed |= differ.any(dim=1) if differ.ndim > 1 else differ
    if before.sh is not after.sh and (before.colors_may_be_non_finite or after.colors_may_be_non_finite):
        changed |= before.finite != after.finite
    return changed.to(torch.uint8)
