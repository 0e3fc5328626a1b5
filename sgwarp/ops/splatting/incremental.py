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

from dataclasses import dataclass, field

import torch
import warp as wp
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.kernels.lifting import lanes, lanes_changes, shared
from sgwarp.kernels.transmittance import LaneIds, Lanes
from sgwarp.ops.launcher import get_threads, launch, scratch, view
from sgwarp.ops.splatting import tiles
from sgwarp.ops.splatting.forward import LANE, TILE_ROWS, in_slices, lane_scratch
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


@dataclass(eq=False)
class _KeptIds:
    """One level of a view's id map, and what was lifted from it."""

    ids: Tensor  # int32 [h, w]
    tile_ids: Tensor  # int32 [tiles, 256]
    counts: Tensor  # int32 [tiles] ids of each tile
    row_starts: Tensor  # int32 [tiles + 1] first weight of each tile
    weights: Tensor  # float32, for each place one weight per id of its tile


@dataclass(eq=False)
class _KeptView:
    camera: Camera
    splats: Tensor  # int32, flat: N splats
    offsets: Tensor  # int32 [tiles + 1]
    listed: Tensor  # int32 [I] Gaussians, tile by tile, front to back
    levels: list[_KeptIds] = field(default_factory=list)
    vectors: Tensor | None = None  # float32 [M, C]

    @property
    def tile_count(self) -> int:
        return len(self.offsets) - 1

    @property
    def bytes(self) -> int:
        own = (self.splats, self.offsets, self.listed)
        level = (
            t for kept in self.levels for t in (kept.ids, kept.tile_ids, kept.counts, kept.row_starts, kept.weights)
        )
        return sum(t.numel() * t.element_size() for t in (*own, *level))


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
        self._kept: dict[str, _KeptView] = {}
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
            kept = _build(gaussians, camera, feature_map, self.settings)
            self._kept[key] = kept
            self._mark(kept)
            self.work.tiles += kept.tile_count
            self.work.projections += len(gaussians)
            return
        if len(self._moved):
            stale = _replace(kept, self._part, self._moved, self._changed, self.settings)
            self.work.projections += len(self._moved)
        else:
            stale = torch.zeros(kept.tile_count, dtype=torch.uint8)
        for old, new in zip(kept.levels, feature_map.ids, strict=True):
            pixels = _differing(old.ids, new, kept.vectors, feature_map.vectors)
            if pixels is not None:
                stale |= _tiles_of(pixels, camera)
        kept.vectors = feature_map.vectors
        chosen = stale.nonzero().flatten().to(torch.int32)
        if len(chosen):
            for level, ids in zip(kept.levels, feature_map.ids, strict=True):
                _lift_again(kept, level, ids, stale, chosen, self._affected, self.settings)
        self.work.tiles += len(chosen)

    def _mark(self, kept: _KeptView) -> None:
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
                _add_level(kept, level, chosen, places, sums)


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


def same_camera(one: Camera, other: Camera) -> bool:
    """Whether two cameras see the same."""
    numbers = (one.size, one.near, one.far) == (other.size, other.near, other.far)
    return numbers and torch.equal(one.K, other.K) and torch.equal(one.world_to_camera, other.world_to_camera)


def _lists(kept: _KeptView) -> list[wp.array]:
    return [view(kept.offsets, wp.int32), view(kept.listed, wp.int32)]


def _build(gaussians: Gaussians, camera: Camera, feature_map: FeatureMap, settings: RasterSettings) -> _KeptView:
    """Project, sort, list and lift a view in full, and keep it."""
    projected = tiles.project(gaussians, camera, settings)
    order = tiles.depth_order(projected)
    lists = tiles.bin_splats(projected, order, None, camera)
    memory = tiles.splat_memory(len(gaussians), gaussians.device, "splats").clone()  # what `project` wrote
    listed = lists.order[lists.listed.to(torch.int64)]
    kept = _KeptView(camera, memory, lists.offsets, listed, vectors=feature_map.vectors)
    assert feature_map.ids is not None
    count = kept.tile_count
    every = torch.empty(0, dtype=torch.int32)
    for ids in feature_map.ids:
        level = _KeptIds(
            ids,
            torch.empty(count, 256, dtype=torch.int32),
            torch.empty(count, dtype=torch.int32),
            every,
            torch.empty(0),
        )
        labels = _localize(level, every, camera)
        level.row_starts = _row_starts(kept.offsets, level.counts)
        level.weights = torch.zeros(int(level.row_starts[-1]))
        _walk(lists.arrays(), level, labels, every, camera, lists.intersections, settings)
        kept.levels.append(level)
    return kept


def _replace(kept: _KeptView, part: Gaussians, moved: Tensor, changed: Tensor, settings: RasterSettings) -> Tensor:
    """Project the changed Gaussians again, and merge them into the lists; returns the stale tiles, uint8 [tiles]."""
    camera, device, count = kept.camera, moved.device, kept.tile_count
    projected = tiles.project(part, camera, settings)
    lists = tiles.bin_splats(projected, tiles.depth_order(projected), None, camera)
    added = moved[lists.order.to(torch.int64)][lists.listed.to(torch.int64)]
    memory = tiles.splat_memory(len(part), device, "splats")  # where `project` wrote; the culled are in no list
    kept.splats.view(-1, tiles.SPLAT_WORDS).index_copy_(0, moved.to(torch.int64), memory.view(-1, tiles.SPLAT_WORDS))
    stale, counts = torch.zeros(count, dtype=torch.uint8), torch.empty(count, dtype=torch.int32)
    common = [*_lists(kept), view(changed, wp.uint8)]
    added_offsets = view(lists.offsets, wp.int32)
    outputs = [view(stale, wp.uint8), view(counts, wp.int32)]
    launch(lanes_changes.count_carried, count, [*common, added_offsets], outputs, device=device)
    offsets = torch.zeros(count + 1, dtype=torch.int32)
    torch.cumsum(counts, 0, dtype=torch.int32, out=offsets[1:])
    listed = torch.empty(int(offsets[-1]), dtype=torch.int32)
    inputs = [*common, view(stale, wp.uint8), added_offsets, view(added, wp.int32), tiles.as_splats(kept.splats)]
    inputs.append(view(offsets, wp.int32))
    launch(lanes_changes.merge_lists, count, inputs, [view(listed, wp.int32)], device=device)
    kept.offsets, kept.listed = offsets, listed
    return stale


def _lift_again(
    kept: _KeptView,
    level: _KeptIds,
    ids: Tensor,
    stale: Tensor,
    chosen: Tensor,
    affected: Tensor,
    settings: RasterSettings,
) -> None:
    """Walk the stale tiles of a level; the weights of the others move to their new places."""
    level.ids = ids
    labels = _localize(level, chosen, kept.camera)
    row_starts = _row_starts(kept.offsets, level.counts)
    weights = torch.empty(int(row_starts[-1]))
    inputs = [view(stale, wp.uint8), view(level.row_starts, wp.int32), view(level.weights, wp.float32)]
    inputs += [view(row_starts, wp.int32), *_lists(kept)]
    outputs = [view(weights, wp.float32), view(affected, wp.uint8)]
    launch(lanes_changes.carry_weights, kept.tile_count, inputs, outputs, device=stale.device)
    level.row_starts, level.weights = row_starts, weights
    arrays = [*_lists(kept), tiles.as_splats(kept.splats)]
    _walk(arrays, level, labels, chosen, kept.camera, len(kept.listed), settings)


def _localize(level: _KeptIds, chosen: Tensor, camera: Camera) -> list[wp.array]:
    """List the ids of the chosen tiles, all if there are none; returns where the pixels point into those lists."""
    count, device = len(level.counts), level.ids.device
    local_ids = scratch("local ids", count * 256, torch.int32, device).view(count, TILE_ROWS, LANE)
    uniform = scratch("uniform rows", count * TILE_ROWS, torch.int32, device).view(count, TILE_ROWS)
    labels = [view(local_ids, LaneIds), view(uniform, wp.int32)]
    inputs = [view(chosen, wp.int32), view(level.ids, wp.int32), camera.width, camera.height]
    outputs = [view(level.tile_ids, wp.int32), view(level.counts, wp.int32), *labels]
    launch(shared.localize_ids, len(chosen) or count, inputs, outputs, device=device)
    return labels


def _walk(
    arrays: list[wp.array],
    level: _KeptIds,
    labels: list[wp.array],
    chosen: Tensor,
    camera: Camera,
    intersections: int,
    settings: RasterSettings,
) -> None:
    """Weights of the ids in the chosen tiles, all if there are none."""
    device = level.ids.device
    starts = scratch("id entry starts", intersections, torch.int32, device)
    state = lane_scratch("state", TILE_ROWS, 1, device)
    rows = view(level.row_starts, wp.int32)
    inputs = [view(chosen, wp.int32), *arrays, *labels, rows, tiles.knobs(settings), camera.width, camera.height, state]
    outputs = [view(level.weights, wp.float32), view(starts, wp.int32)]
    launch(lanes.lift_ids, len(chosen) or len(level.counts), inputs, outputs, device=device, slots=True)


def _row_starts(offsets: Tensor, counts: Tensor) -> Tensor:
    """First weight of each tile, int32 [tiles + 1]."""
    starts = torch.zeros(len(counts) + 1, dtype=torch.int64)
    torch.cumsum((offsets[1:] - offsets[:-1]).to(torch.int64) * counts, 0, out=starts[1:])
    if int(starts[-1]) > tiles.MAX_INTERSECTIONS:
        raise InputError(f"{int(starts[-1])} weights of a view exceed 2^31 - 1; lift at a lower resolution")
    return starts.to(torch.int32)


def _differing(old: Tensor, new: Tensor, old_vectors: Tensor | None, vectors: Tensor | None) -> Tensor | None:
    """Pixels of the map whose id, or the vector of whose id, differs, bool [h, w]; None if there are none."""
    if old.shape != new.shape:
        return torch.ones_like(new, dtype=torch.bool)
    differ = None if old is new or torch.equal(old, new) else old != new
    if vectors is None or old_vectors is None or vectors is old_vectors:
        return differ
    if old_vectors.shape[1] != vectors.shape[1]:
        return torch.ones_like(new, dtype=torch.bool)
    moved = torch.ones(len(vectors) + 1, dtype=torch.bool)
    common = min(len(vectors), len(old_vectors))
    moved[:common] = (old_vectors[:common] != vectors[:common]).any(dim=1)
    moved[-1] = False  # of id -1
    if bool(moved[:-1].any()):
        differ = moved[new.to(torch.int64)] if differ is None else differ | moved[new.to(torch.int64)]
    return differ


def _tiles_of(pixels: Tensor, camera: Camera) -> Tensor:
    """Tiles in which a pixel of the map, bool [h, w], is set, uint8 [tiles]."""
    height, width = camera.size
    h, w = pixels.shape
    if (h, w) != (height, width):  # read as `localize_ids` does
        rows = (2 * torch.arange(height) + 1) * h // (2 * height)
        columns = (2 * torch.arange(width) + 1) * w // (2 * width)
        pixels = pixels[rows][:, columns]
    side = tiles.TILE
    across, down = -(-width // side), -(-height // side)
    padded = torch.zeros(down * side, across * side, dtype=torch.uint8)
    padded[:height, :width] = pixels
    return padded.view(down, side, across, side).amax(dim=3).amax(dim=1).flatten()


def _add_level(kept: _KeptView, level: _KeptIds, chosen: Tensor, places: Tensor, sums: LiftSums) -> None:
    """Add one level of one view to the sums of the chosen Gaussians."""
    count, device = len(chosen), chosen.device
    runs = scratch("runs", count, torch.int32, device)
    run_weights = scratch("run weights", count, torch.float32, device)
    totals = scratch("run totals", count, torch.float32, device)
    known = 0 if kept.vectors is None else len(kept.vectors)
    id_weights = sums.slices.flatten(1)
    if kept.vectors is not None:
        id_weights = scratch("affected id weights", count * known, torch.float32, device).view(count, known).zero_()
    slices = get_threads()
    per_slice = max(1, -(-count // slices))
    inputs = [
        per_slice,
        view(chosen, wp.int32),
        view(places, wp.int32),
        *_lists(kept),
        view(level.row_starts, wp.int32),
    ]
    inputs += [view(level.tile_ids, wp.int32), view(level.counts, wp.int32), view(level.weights, wp.float32)]
    inputs += [int(kept.vectors is None), view(runs, wp.int32), view(run_weights, wp.float32), view(totals, wp.float32)]
    outputs = [view(t, wp.float32) for t in (id_weights, sums.weight, sums.weight_squared)]
    launch(lanes_changes.sum_listed_weights, slices, inputs, outputs, device=device, chunk=1)
    if kept.vectors is not None:
        vectors = in_slices(kept.vectors)
        inputs = [view(chosen, wp.int32), view(id_weights, wp.float32), view(vectors, Lanes)]
        launch(shared.add_id_features, count, inputs, [view(sums.slices, Lanes)], device=device)
