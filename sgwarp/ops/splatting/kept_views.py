"""What is kept of a view between two frames of a moving scene, and how it follows them (CPU)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
import warp as wp
from torch import Tensor

from sgwarp.kernels.lifting import lanes, lanes_changes, shared
from sgwarp.kernels.transmittance import LaneIds, Lanes
from sgwarp.ops.arguments import view
from sgwarp.ops.launcher import get_threads, launch
from sgwarp.ops.memory import scratch
from sgwarp.ops.splatting import tiles
from sgwarp.ops.splatting.forward import LANE, TILE_ROWS, in_slices, lane_scratch
from sgwarp.ops.splatting.id_weights import first_weights, weight_count
from sgwarp.ops.splatting.lifting import LiftSums
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.scene import Camera, FeatureMap, Gaussians


@dataclass(eq=False)
class KeptIds:
    """One level of a view's id map, and what was lifted from it."""

    ids: Tensor  # int32 [h, w]
    tile_ids: Tensor  # int32 [tiles, 256]
    counts: Tensor  # int32 [tiles] ids of each tile
    row_starts: Tensor  # int32 [tiles + 1] first weight of each tile
    weights: Tensor  # float32, for each place one weight per id of its tile


@dataclass(eq=False)
class KeptView:
    camera: Camera
    splats: Tensor  # int32, flat: N splats
    offsets: Tensor  # int32 [tiles + 1]
    listed: Tensor  # int32 [I] Gaussians, tile by tile, front to back
    levels: list[KeptIds] = field(default_factory=list)
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


def same_camera(one: Camera, other: Camera) -> bool:
    """Whether two cameras see the same."""
    numbers = (one.size, one.near, one.far) == (other.size, other.near, other.far)
    return numbers and torch.equal(one.K, other.K) and torch.equal(one.world_to_camera, other.world_to_camera)


def _lists(kept: KeptView) -> list[Any]:
    return [view(kept.offsets, wp.int32), view(kept.listed, wp.int32)]


def keep_view(gaussians: Gaussians, camera: Camera, feature_map: FeatureMap, settings: RasterSettings) -> KeptView:
    """Project, sort, list and lift a view in full, and keep it."""
    projected = tiles.project(gaussians, camera, settings)
    order = tiles.depth_order(projected)
    lists = tiles.bin_splats(projected, order, None, camera)
    memory = tiles.splat_memory(len(gaussians), gaussians.device, "splats").clone()  # what `project` wrote
    listed = lists.order[lists.listed.to(torch.int64)]
    kept = KeptView(camera, memory, lists.offsets, listed, vectors=feature_map.vectors)
    assert feature_map.ids is not None
    count = kept.tile_count
    every = torch.empty(0, dtype=torch.int32)
    for ids in feature_map.ids:
        level = KeptIds(
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


def replace_changed(
    kept: KeptView, part: Gaussians, moved: Tensor, changed: Tensor, settings: RasterSettings
) -> Tensor:
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
    inputs = [*common, view(stale, wp.uint8), added_offsets, view(added, wp.int32), tiles.view_splats(kept.splats)]
    inputs.append(view(offsets, wp.int32))
    launch(lanes_changes.merge_lists, count, inputs, [view(listed, wp.int32)], device=device)
    kept.offsets, kept.listed = offsets, listed
    return stale


def lift_again(
    kept: KeptView,
    level: KeptIds,
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
    arrays = [*_lists(kept), tiles.view_splats(kept.splats)]
    _walk(arrays, level, labels, chosen, kept.camera, len(kept.listed), settings)


def _localize(level: KeptIds, chosen: Tensor, camera: Camera) -> list[Any]:
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
    arrays: list[Any],
    level: KeptIds,
    labels: list[Any],
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
    starts = first_weights(offsets, counts)
    weight_count(starts)
    return starts.to(torch.int32)


def differing_pixels(old: Tensor, new: Tensor, old_vectors: Tensor | None, vectors: Tensor | None) -> Tensor | None:
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


def tiles_of(pixels: Tensor, camera: Camera) -> Tensor:
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


def add_level(kept: KeptView, level: KeptIds, chosen: Tensor, places: Tensor, sums: LiftSums) -> None:
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
