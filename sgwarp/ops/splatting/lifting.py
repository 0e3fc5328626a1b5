"""Lifting one view's 2D semantics onto the Gaussians: the transpose of the renderer, and the paper's centre mode.

Weighted: with A the matrix of alpha T, one row per pixel and one column per Gaussian, the sums of a view are A^T f and
A^T 1. Centre (Sec. III-B): the feature at the pixel of each centre, where the rendered depth agrees.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import warp as wp
from torch import Tensor
from torch.nn.functional import interpolate

from sgwarp.errors import InputError
from sgwarp.kernels.lifting import block as lifting_block
from sgwarp.kernels.lifting import lanes as lifting_lanes
from sgwarp.kernels.lifting import shared as lifting
from sgwarp.kernels.transmittance import Lanes
from sgwarp.ops.launcher import launch, launch_blocks, launch_plain, scratch, view
from sgwarp.ops.splatting import tiles
from sgwarp.ops.splatting.forward import LANE, TILE_ROWS, composite, in_slices, lane_scratch
from sgwarp.ops.splatting.id_weights import localize_ids, weigh_ids
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.scene import Camera, FeatureMap, Gaussians

MODES = ("weighted", "center")
WIDE = 4  # slices of 16 channels lifted in one walk over the tiles
ROW_BYTES = 512 * 2**20  # at most this much scratch for the rows of all intersections
SLICE_BYTES = 512 * 2**20  # at most this much for slices that have to be brought to the size of the image


@dataclass(eq=False)
class LiftSums:
    """Running sums over the lifted views.

    Attributes:
        slices: Sum of weighted features, channels in slices of 16 padded with zeros, float32 [N, S, 16].
        channels: How many of them are real.
        weight: Sum of weights (weighted) or number of views (center), float32 [N].
        weight_squared: Sum over the views of the squared weight of a view, float32 [N].
    """

    slices: Tensor
    channels: int
    weight: Tensor
    weight_squared: Tensor

    @classmethod
    def zeros(cls, count: int, channels: int, device: torch.device | str = "cpu") -> LiftSums:
        """Sums of no view at all."""
        slices = torch.zeros(count, -(-channels // LANE), LANE, device=device)
        return cls(slices, channels, torch.zeros(count, device=device), torch.zeros(count, device=device))

    @property
    def features(self) -> Tensor:
        """Sum of weighted features, float32 [N, C]; shares memory with `slices`."""
        return self.slices.flatten(1)[:, : self.channels]


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
        mode: "weighted" adds alpha T f for every pixel; "center" adds the feature of the centre's pixel once.
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
    projected = tiles.project(gaussians, camera, settings)
    order = tiles.depth_order(projected)
    by_rows = mode == "weighted"
    wants_tiles = by_rows and feature_map.ids is not None
    lists = tiles.bin_splats(projected, order, None, camera, places=by_rows, tiles=wants_tiles)
    if mode == "center":
        _add_centers(projected, lists, camera, feature_map, sums, tau, border, settings)
        return
    block = gaussians.device.type == "cuda"
    ordered = not block if deterministic is None else deterministic or not block
    add_weighted(lists, camera, feature_map, sums, settings, block=block, ordered=ordered)


def add_weighted(
    lists: tiles.TileLists,
    camera: Camera,
    feature_map: FeatureMap,
    sums: LiftSums,
    settings: RasterSettings,
    *,
    block: bool,
    ordered: bool,
) -> None:
    """Add A^T f of one view in the lane or block schedule, by atomic additions or in a fixed order."""
    if feature_map.ids is None:
        _add_dense(lists, camera, feature_map, sums, settings, block, ordered)
        return
    for level in feature_map.ids:
        _add_ids(lists, camera, level.to(sums.weight.device), feature_map, sums, settings, block, ordered)


def _add_dense(
    lists: tiles.TileLists,
    camera: Camera,
    feature_map: FeatureMap,
    sums: LiftSums,
    settings: RasterSettings,
    block: bool,
    ordered: bool,
) -> None:
    device = sums.weight.device
    valid = _valid_pixels(feature_map, camera, device)
    total_slices = sums.slices.shape[1]
    # A pass of four slices shares one walk over the tiles; with very many intersections its rows must stay small.
    affordable = max(1, ROW_BYTES // max(1, 64 * lists.intersections))
    if block and not ordered:
        affordable = total_slices  # writes no rows
    if not _ready(feature_map, camera, device):  # a slice and its copy in the order of the kernel
        affordable = min(affordable, SLICE_BYTES // (2 * 64 * camera.height * camera.width))
    first = 0
    while first < total_slices:
        count = WIDE if total_slices - first >= WIDE and affordable >= WIDE else 1
        if block:
            count = min(total_slices - first, max(affordable, 1))
        features, first_feature = _slices_at_image_size(feature_map, camera, first, count, device)
        place = (first_feature, first, count)
        _add_dense_pass(lists, camera, features, valid, place, sums, settings, block, ordered)
        first += count


def _add_dense_pass(
    lists: tiles.TileLists,
    camera: Camera,
    features: Tensor,
    valid: Tensor,
    place: tuple[int, int, int],
    sums: LiftSums,
    settings: RasterSettings,
    block: bool,
    ordered: bool,
) -> None:
    """Lift `count` slices: from `first_feature` of the map's slices to `first` of the sums'."""
    device = sums.weight.device
    height, width = camera.size
    total = lists.intersections
    first_feature, first, count = place
    knobs = tiles.knobs(settings)
    rows = scratch("rows", total * count * LANE if ordered else 0, torch.float32, device).view(-1, count, LANE)
    weights = scratch("entry weights", total if ordered else 0, torch.float32, device)
    if block:
        target, of_fragments = (rows, weights) if ordered else (sums.slices, torch.zeros_like(sums.weight))
        inputs = [*lists.arrays(), view(features.flatten(2), wp.float32), view(valid, wp.float32)]
        inputs += [LANE * first_feature, LANE * first, LANE * count, knobs, width, height]
        outputs = [view(target.flatten(1), wp.float32), view(of_fragments, wp.float32)]
        grid = [lists.tile_count, -(-LANE * count // lifting_block.CHANNELS)]
        launch_blocks(lifting_block.make_lift_dense_block(ordered), grid, inputs, outputs, device=device)
        if not ordered:
            if first == 0:
                _fold(of_fragments, sums)
            return
    else:
        columns = -(-width // LANE)
        lanes = torch.nn.functional.pad(valid, (0, columns * LANE - width)).view(height, columns, 1, LANE)
        state = lane_scratch("state", TILE_ROWS, 1, device)
        inputs = [
            *lists.arrays(),
            view(features, Lanes),
            view(lanes, Lanes),
            first_feature,
            knobs,
            width,
            height,
            state,
        ]
        outputs = [view(rows, Lanes), view(weights, wp.float32)]
        kernel = lifting_lanes.make_lift_dense(count)
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
    block: bool,
    ordered: bool,
) -> None:
    device = sums.weight.device
    visible = len(lists.order)
    local = localize_ids(lists, camera, ids)

    # One-hot labels: the weights of the ids are the features, so they are added where they belong at once.
    one_hot = feature_map.vectors is None
    known = sums.channels if feature_map.vectors is None else len(feature_map.vectors)
    atomic = block and not ordered
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
        launch_blocks(lifting_block.make_lift_ids_block(False), [lists.tile_count], inputs, outputs, device=device)
        _fold(view_weights, sums)
        if vectors is not None:
            inputs = [view(t, wp.float32) for t in (id_weights, vectors.flatten(1))]
            outputs = [view(sums.slices.flatten(1), wp.float32)]
            launch_plain(lifting_block.add_id_channels, 32 * len(sums.weight), inputs, outputs, device=device)
        return
    order = view(lists.order, wp.int32)
    where = weigh_ids(lists, camera, local, settings, block=block)
    outputs = [view(t, wp.float32) for t in (id_weights, sums.weight, sums.weight_squared)]
    launch(lifting.sum_id_weights, visible, [order, *where, int(one_hot)], outputs, device=device)
    if vectors is not None:
        inputs = [order, view(id_weights, wp.float32), view(vectors, Lanes)]
        launch(lifting.add_id_features, visible, inputs, [view(sums.slices, Lanes)], device=device)


def _add_centers(
    projected: tiles.Projected,
    lists: tiles.TileLists,
    camera: Camera,
    feature_map: FeatureMap,
    sums: LiftSums,
    tau: float,
    border: int,
    settings: RasterSettings,
) -> None:
    device = sums.weight.device
    surface = composite(lists, camera, settings, None, True)[3]
    n = len(sums.weight)
    pixels = scratch("center pixels", n, torch.int32, device)
    inputs = [projected.splats, view(projected.status, wp.uint8), view(surface, wp.float32), tau, border]
    launch(lifting.find_center_pixels, n, inputs, [view(pixels, wp.int32)], device=device)
    seen = (pixels >= 0).nonzero().flatten()
    at = pixels[seen].to(torch.int64)
    y, x = at // camera.width, at % camera.width
    features, given = _read_at(feature_map, camera, y, x)
    seen = seen[given]
    flat = sums.slices.flatten(1)
    flat[seen, : sums.channels] += features[given]
    sums.weight[seen] += 1.0
    sums.weight_squared[seen] += 1.0


def _read_at(feature_map: FeatureMap, camera: Camera, y: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    """Features at image pixels [K, C], read at the nearest map position, and whether there are any, bool [K]."""
    h, w = feature_map.size
    row = ((2 * y + 1) * h) // (2 * camera.height)
    column = ((2 * x + 1) * w) // (2 * camera.width)
    if feature_map.dense is not None:
        device = y.device
        features = feature_map.dense.to(device)[row, column].to(torch.float32)
        given = torch.ones_like(y, dtype=torch.bool)
        if feature_map.valid is not None:
            given = feature_map.valid.to(device)[row, column]
        return features, given
    assert feature_map.ids is not None
    ids = feature_map.ids.to(y.device)[:, row, column].to(torch.int64)
    held = ids >= 0
    if feature_map.vectors is None:
        vectors = torch.eye(feature_map.channels, device=y.device)
    else:
        vectors = feature_map.vectors.to(y.device)
    # Several levels count once: the mean over the levels that carry an id here.
    features = torch.where(held[..., None], vectors[ids.clamp(min=0)], 0.0).sum(0)
    return features / held.sum(0).clamp(min=1)[:, None], held.any(dim=0)
