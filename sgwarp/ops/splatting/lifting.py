"""Lifting one view's 2D semantics onto the Gaussians: the transpose of the renderer, and the paper's centre mode.

Weighted: with A the matrix of alpha T, one row per pixel and one column per Gaussian, the sums of a view are A^T f and
A^T 1. Squared: the same with the squares of its entries. Strongest: with the largest entry of each row alone. Centre
(Sec. III-B): the feature at the pixel of each centre, where the rendered depth agrees.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from torch import Tensor
from torch.nn.functional import interpolate

from sgwarp.errors import InputError
from sgwarp.kernels.lifting import block as lifting_block
from sgwarp.kernels.lifting import lanes as lifting_lanes
from sgwarp.kernels.lifting import shared as lifting
from sgwarp.kernels.transmittance import Lanes
from sgwarp.ops.arguments import view
from sgwarp.ops.launcher import launch, launch_blocks, launch_plain
from sgwarp.ops.memory import scratch
from sgwarp.ops.splatting import tiles
from sgwarp.ops.splatting.forward import LANE, TILE_ROWS, in_slices, lane_scratch
from sgwarp.ops.splatting.id_weights import localize_ids, weigh_ids
from sgwarp.ops.splatting.lift_loading import load_lifting
from sgwarp.ops.splatting.lift_sums import LiftSums as LiftSums
from sgwarp.ops.splatting.pixel_lifting import add_centers, add_strongest
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.ops.splatting.wide_lifting import LEAST_SLICES, WIDE, add_slices, add_weights, list_entries
from sgwarp.scene import Camera, FeatureMap, Gaussians

MODES = ("weighted", "center", "squared", "strongest")
ROW_BYTES = 512 * 2**20  # at most this much scratch for the rows of all intersections
SLICE_BYTES = 512 * 2**20  # at most this much for slices that have to be brought to the size of the image


@dataclass(frozen=True)
class _Way:
    """How sums are made.

    Attributes:
        block: In the block schedule (CUDA), else in the lane schedule.
        ordered: In a fixed order, else by atomic additions.
        squared: With (alpha T)^2 in place of alpha T.
    """

    block: bool
    ordered: bool
    squared: bool


def lift_view(
    gaussians: Gaussians,
    camera: Camera,
    feature_map: FeatureMap,
    sums: LiftSums,
    *,
    mode: str = "weighted",
    tau: float = 0.05,
    border: int = 10,
    settings: RasterSettings = RasterSettings(),  # noqa: B008 - frozen
    deterministic: bool | None = None,
) -> None:
    """Add one view to `sums`.

    Args:
        gaussians: The scene, N Gaussians on the device of `sums`.
        camera: Where the map was seen from, at the size of the image.
        feature_map: Dense features (read bilinearly where the map is smaller than the image) or ids (read at the
            nearest position; their cost does not depend on the number of channels).
        sums: Added to, in place.
        mode: "weighted" adds alpha T f for every pixel, "squared" (alpha T)^2 f; "strongest" adds alpha T f to the
            Gaussian that contributes most to the pixel; "center" adds the feature of the centre's pixel once.
        tau: Relative depth tolerance of "center".
        border: Pixels cut at the image border by "center".
        settings: The rasterizer's approximations.
        deterministic: Add up in a fixed order. The CPU always does; on CUDA the default is atomic additions.

    Raises:
        InputError: The map has other channels than `sums`, an unknown mode, or another device.
    """
    if mode not in MODES:
        raise InputError(f"mode: expected one of {', '.join(MODES)}, got '{mode}'")
    if feature_map.channels != sums.channels or len(sums.weight) != len(gaussians):
        got = f"{feature_map.channels} channels for {len(gaussians)} Gaussians"
        raise InputError(f"feature map: {got}, but the sums hold {sums.channels} for {len(sums.weight)}")
    if mode == "strongest":
        add_strongest(gaussians, camera, feature_map, sums, settings)
        return
    by_rows = mode != "center"
    if by_rows:
        ids, squared = feature_map.ids is not None, mode == "squared"
        load_lifting(gaussians.device, sums.channels, ids=ids, squared=squared)
    projected = tiles.project(gaussians, camera, settings)
    order = tiles.depth_order(projected)
    wants_tiles = by_rows and feature_map.ids is not None
    lists = tiles.bin_splats(projected, order, None, camera, places=by_rows, tiles=wants_tiles)
    if mode == "center":
        add_centers(projected, lists, camera, feature_map, sums, tau, border, settings)
        return
    block = gaussians.device.type == "cuda"
    ordered = not block if deterministic is None else deterministic or not block
    squared = mode == "squared"
    add_weighted(lists, camera, feature_map, sums, settings, block=block, ordered=ordered, squared=squared)


def add_weighted(
    lists: tiles.TileLists,
    camera: Camera,
    feature_map: FeatureMap,
    sums: LiftSums,
    settings: RasterSettings,
    *,
    block: bool,
    ordered: bool,
    squared: bool = False,
) -> None:
    """Add A^T f of one view in the lane or block schedule, by atomic additions or in a fixed order; with the squares of
    the entries of A if `squared`."""
    way = _Way(block, ordered, squared)
    if feature_map.ids is None:
        _add_dense(lists, camera, feature_map, sums, settings, way)
        return
    for level in feature_map.ids:
        _add_ids(lists, camera, level.to(sums.weight.device), feature_map, sums, settings, way)


def _add_dense(
    lists: tiles.TileLists,
    camera: Camera,
    feature_map: FeatureMap,
    sums: LiftSums,
    settings: RasterSettings,
    way: _Way,
) -> None:
    device = sums.weight.device
    valid = _valid_pixels(feature_map, camera, device)
    total_slices = sums.slices.shape[1]
    if not _ready(feature_map, camera, device):  # a slice and its copy in the order of the kernel
        per_pass = SLICE_BYTES // (2 * 64 * camera.height * camera.width)
    else:
        per_pass = total_slices
    first = 0
    if not way.block and total_slices >= LEAST_SLICES and per_pass >= WIDE and lists.intersections:
        first = _add_wide(lists, camera, feature_map, valid, per_pass, sums, settings, way)
    # A pass of four slices shares one walk over the tiles; with very many intersections its rows must stay small.
    affordable = max(1, ROW_BYTES // max(1, 64 * lists.intersections))
    if way.block and not way.ordered:
        affordable = total_slices  # writes no rows
    affordable = min(affordable, per_pass)
    while first < total_slices:
        count = WIDE if total_slices - first >= WIDE and affordable >= WIDE else 1
        if way.block:
            count = min(total_slices - first, max(affordable, 1))
        features, first_feature = _slices_at_image_size(feature_map, camera, first, count, device)
        place = (first_feature, first, count)
        _add_dense_pass(lists, camera, features, valid, place, sums, settings, way)
        first += count


def _add_wide(
    lists: tiles.TileLists,
    camera: Camera,
    feature_map: FeatureMap,
    valid: Tensor,
    per_pass: int,
    sums: LiftSums,
    settings: RasterSettings,
    way: _Way,
) -> int:
    """Lift whole groups of slices by the entries of A, at most `per_pass` slices at once; returns how many it did."""
    entries = list_entries(lists, _valid_lanes(valid), settings, camera.size, way.squared)
    if entries is None:
        return 0
    add_weights(lists, entries, sums)
    first, total_slices = 0, sums.slices.shape[1]
    while (count := min(per_pass, total_slices - first) // WIDE * WIDE) > 0:
        features, first_feature = _slices_at_image_size(feature_map, camera, first, count, sums.weight.device)
        add_slices(lists, entries, features, (first_feature, first, count), camera, sums)
        first += count
    return first


def _valid_lanes(valid: Tensor) -> Any:
    """A mask [H, W] as the lane schedule reads it: [H, tile columns, 1] vectors, zero beyond the image."""
    height, width = valid.shape
    columns = -(-width // LANE)
    return view(torch.nn.functional.pad(valid, (0, columns * LANE - width)).view(height, columns, 1, LANE), Lanes)


def _add_dense_pass(
    lists: tiles.TileLists,
    camera: Camera,
    features: Tensor,
    valid: Tensor,
    place: tuple[int, int, int],
    sums: LiftSums,
    settings: RasterSettings,
    way: _Way,
) -> None:
    """Lift `count` slices: from `first_feature` of the map's slices to `first` of the sums'."""
    device = sums.weight.device
    height, width = camera.size
    total = lists.intersections
    first_feature, first, count = place
    knobs = tiles.knobs(settings)
    rows = scratch("rows", total * count * LANE if way.ordered else 0, torch.float32, device).view(-1, count, LANE)
    weights = scratch("entry weights", total if way.ordered else 0, torch.float32, device)
    if way.block:
        target, of_fragments = (rows, weights) if way.ordered else (sums.slices, torch.zeros_like(sums.weight))
        inputs = [*lists.arrays(), view(features.flatten(2), wp.float32), view(valid, wp.float32)]
        inputs += [LANE * first_feature, LANE * first, LANE * count, knobs, width, height]
        outputs = [view(target.flatten(1), wp.float32), view(of_fragments, wp.float32)]
        wide = LANE * count > lifting_block.CHANNELS
        per_block = lifting_block.WIDE_CHANNELS if wide else lifting_block.CHANNELS
        kernel = lifting_block.make_lift_dense_block(way.ordered, way.squared, wide)
        launch_blocks(kernel, [lists.tile_count, -(-LANE * count // per_block)], inputs, outputs, device=device)
        if not way.ordered:
            if first == 0:
                _fold(of_fragments, sums)
            return
    else:
        state = lane_scratch("state", TILE_ROWS, 1, device)
        inputs = [
            *lists.arrays(),
            view(features, Lanes),
            _valid_lanes(valid),
            first_feature,
            knobs,
            width,
            height,
            state,
        ]
        outputs = [view(rows, Lanes), view(weights, wp.float32)]
        kernel = lifting_lanes.make_lift_dense(count, way.squared)
        launch(kernel, lists.tile_count, inputs, outputs, device=device, slots=True)
    gather = lists.sums()
    visible = len(lists.order)
    launch(
        lifting.sum_rows, visible, [*gather, view(rows, Lanes), first, count], [view(sums.slices, Lanes)], device=device
    )
    if first == 0:
        outputs = [view(sums.weight, wp.float32), view(sums.weight_squared, wp.float32)]
        launch(lifting.sum_weights, visible, [*gather, view(weights, wp.float32)], outputs, device=device)


def _slices_at_image_size(
    feature_map: FeatureMap, camera: Camera, first: int, count: int, device: torch.device
) -> tuple[Tensor, int]:
    """Slices of 16 channels at image size, float32 [H, W, S, 16], and which of them is slice `first` of the map.

    A float32 map at image size with whole slices is used as it is; from any other only the slices asked for are made.
    """
    dense, valid = feature_map.dense, feature_map.valid
    assert dense is not None
    if _ready(feature_map, camera, device):
        return in_slices(dense), first
    at_size = feature_map.size == camera.size
    part = dense[..., LANE * first : LANE * (first + count)].to(device=device, dtype=torch.float32)
    if valid is not None:
        part = torch.where(valid.to(device)[..., None], part, 0.0)
    if not at_size:
        channels_first = part.permute(2, 0, 1).contiguous()  # five times as fast as a strided view
        part = interpolate(channels_first[None], camera.size, mode="bilinear", align_corners=False)[0]
        part = part.permute(1, 2, 0)
        if valid is not None:  # the mean of the valid neighbours, not of the zeros between them
            part = part / _valid_pixels(feature_map, camera, device).clamp(min=1e-6)[..., None]
    return in_slices(part), 0


def _ready(feature_map: FeatureMap, camera: Camera, device: torch.device) -> bool:
    """Whether a dense map can be lifted as it lies in memory."""
    dense = feature_map.dense
    assert dense is not None
    plain = feature_map.size == camera.size and feature_map.valid is None and dense.dtype == torch.float32
    return plain and dense.shape[2] % LANE == 0 and dense.device == device and dense.is_contiguous()


def _valid_pixels(feature_map: FeatureMap, camera: Camera, device: torch.device) -> Tensor:
    """1 where an image pixel carries semantics, else 0, float32 [H, W]; between pixels of the map, the share."""
    if feature_map.valid is None:
        return torch.ones(camera.size, device=device)
    valid = feature_map.valid.to(device=device, dtype=torch.float32)
    if feature_map.size != camera.size:
        valid = interpolate(valid[None, None], camera.size, mode="bilinear", align_corners=False)[0, 0]
    return valid.contiguous()


def _fold(view_weights: Tensor, sums: LiftSums) -> None:
    outputs = [view(sums.weight, wp.float32), view(sums.weight_squared, wp.float32)]
    inputs = [view(view_weights, wp.float32)]
    launch_plain(lifting_block.fold_view_weights, len(view_weights), inputs, outputs, device=view_weights.device)


def _add_ids(
    lists: tiles.TileLists,
    camera: Camera,
    ids: Tensor,
    feature_map: FeatureMap,
    sums: LiftSums,
    settings: RasterSettings,
    way: _Way,
) -> None:
    device = sums.weight.device
    visible = len(lists.order)
    local = localize_ids(lists, camera, ids)

    # One-hot labels: the weights of the ids are the features, so they are added where they belong at once.
    one_hot = feature_map.vectors is None
    known = sums.channels if feature_map.vectors is None else len(feature_map.vectors)
    atomic = way.block and not way.ordered
    if one_hot:
        id_weights = sums.slices.flatten(1)
    else:
        rows = len(sums.weight) if atomic else visible
        id_weights = scratch("id weights", rows * known, torch.float32, device).view(rows, known).zero_()
    vectors = None if feature_map.vectors is None else in_slices(feature_map.vectors.to(device))
    if atomic:
        view_weights = torch.zeros_like(sums.weight)
        unused = [torch.empty(0, device=device), torch.empty(0, dtype=torch.int32, device=device)]
        inputs = [*lists.arrays(), *local.block_arrays(), tiles.knobs(settings), camera.width, camera.height]
        outputs = [view(t, wp.float32) for t in (id_weights, view_weights, unused[0])] + [view(unused[1], wp.int32)]
        launch_blocks(
            lifting_block.make_lift_ids_block(False, way.squared), [lists.tile_count], inputs, outputs, device=device
        )
        _fold(view_weights, sums)
        if vectors is not None:
            inputs = [view(t, wp.float32) for t in (id_weights, vectors.flatten(1))]
            outputs = [view(sums.slices.flatten(1), wp.float32)]
            launch_plain(lifting_block.add_id_channels, 32 * len(sums.weight), inputs, outputs, device=device)
        return
    order = view(lists.order, wp.int32)
    where = weigh_ids(lists, camera, local, settings, block=way.block, squared=way.squared)
    outputs = [view(t, wp.float32) for t in (id_weights, sums.weight, sums.weight_squared)]
    launch(lifting.sum_id_weights, visible, [order, *where, int(one_hot)], outputs, device=device)
    if vectors is not None:
        inputs = [order, view(id_weights, wp.float32), view(vectors, Lanes)]
        launch(lifting.add_id_features, visible, inputs, [view(sums.slices, Lanes)], device=device)
