"""Sums of alpha T by id for one view: what lifting an id map starts from, and the same as a sparse matrix."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.kernels.lifting import block as lifting_block
from sgwarp.kernels.lifting import lanes as lifting_lanes
from sgwarp.kernels.lifting import pairs as lifting_pairs
from sgwarp.kernels.lifting import shared as lifting
from sgwarp.kernels.transmittance import LaneIds
from sgwarp.ops.arguments import view
from sgwarp.ops.launcher import launch, launch_blocks
from sgwarp.ops.memory import scratch
from sgwarp.ops.splatting import tiles
from sgwarp.ops.splatting.forward import LANE, TILE_ROWS, lane_scratch
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.scene import Camera, Gaussians

MOST_WEIGHTS = 2**31 - 1


@dataclass(frozen=True, eq=False)
class LocalIds:
    """An id map cut into tiles, each with a list of its own ids; scratch, valid until the next map.

    Attributes:
        tile_ids: Distinct ids of each tile, int32 [tiles, 256].
        counts: How many they are, int32 [tiles].
        places: Place of each pixel's id in that list, -1 for none, int32 [tiles, 16, 16].
        uniform: The place that a row of 16 pixels shares, else -2, int32 [tiles, 16].
        row_starts: `first_weights`, int64 [tiles + 1].
    """

    tile_ids: Tensor
    counts: Tensor
    places: Tensor
    uniform: Tensor
    row_starts: Tensor

    def block_arrays(self) -> list[Any]:
        """What the block schedule reads."""
        return [view(t, wp.int32) for t in (self.places, self.uniform, self.tile_ids, self.counts, self._starts())]

    def lane_arrays(self) -> list[Any]:
        """What the lane schedule reads."""
        return [view(self.places, LaneIds), view(self.uniform, wp.int32), view(self._starts(), wp.int32)]

    def _starts(self) -> Tensor:
        """As kernels read them; `weight_count` sees to it that they fit, where they are read."""
        return self.row_starts.to(torch.int32)


def localize_ids(lists: tiles.TileLists, camera: Camera, ids: Tensor) -> LocalIds:
    """List the ids of each tile of a map, int32 [h, w], which may be smaller than the image."""
    device, count = ids.device, lists.tile_count
    tile_ids = scratch("tile ids", count * 256, torch.int32, device).view(count, 256)
    counts = scratch("tile id counts", count, torch.int32, device)
    places = scratch("local ids", count * 256, torch.int32, device).view(count, TILE_ROWS, LANE)
    uniform = scratch("uniform rows", count * TILE_ROWS, torch.int32, device).view(count, TILE_ROWS)
    outputs = [view(tile_ids, wp.int32), view(counts, wp.int32), view(places, LaneIds), view(uniform, wp.int32)]
    inputs = [_every_tile(device), view(ids, wp.int32), camera.width, camera.height]
    launch(lifting.localize_ids, count, inputs, outputs, device=device)
    return LocalIds(tile_ids, counts, places, uniform, first_weights(lists.offsets, counts))


def first_weights(offsets: Tensor, counts: Tensor) -> Tensor:
    """First of each tile's weights, one for each of its splats and ids, and their number, int64 [tiles + 1]."""
    starts = torch.zeros(len(offsets), dtype=torch.int64, device=offsets.device)
    torch.cumsum(offsets.diff().to(torch.int64) * counts, 0, out=starts[1:])
    return starts


def weight_count(starts: Tensor) -> int:
    """Number of weights; on CUDA the host waits for it.

    Raises:
        InputError: Kernels count them in int32.
    """
    total = int(starts[-1])
    if total > MOST_WEIGHTS:
        raise InputError(
            f"ids: {total} weights of splats and the ids of their tiles exceed {MOST_WEIGHTS}; lift at a lower "
            "resolution, or fewer ids"
        )
    return total


def _every_tile(device: torch.device) -> Any:
    """No choice of tiles: the kernels take all of them."""
    return view(torch.empty(0, dtype=torch.int32, device=device), wp.int32)


def weigh_ids(
    lists: tiles.TileLists,
    camera: Camera,
    local: LocalIds,
    settings: RasterSettings,
    *,
    block: bool,
    squared: bool = False,
) -> list[Any]:
    """Sum of alpha T, or of its square, of every splat for every id of its tile, in a fixed order.

    Returns what kernels read that gather them by Gaussian: entries, places, starts, tiles, ids of the tiles, their
    counts, weights.
    """
    device, (height, width) = lists.order.device, camera.size
    weights = scratch("id entry weights", weight_count(local.row_starts), torch.float32, device).zero_()
    starts = scratch("id entry starts", lists.intersections, torch.int32, device)
    outputs = [view(weights, wp.float32), view(starts, wp.int32)]
    if block:
        unused = [view(torch.empty(size, device=device), wp.float32) for size in ((0, 0), (0,))]
        kernel = lifting_block.make_lift_ids_block(True, squared)
        inputs = [*lists.arrays(), *local.block_arrays(), tiles.knobs(settings), width, height]
        launch_blocks(kernel, [lists.tile_count], inputs, [*unused, *outputs], device=device)
    else:
        state = lane_scratch("state", TILE_ROWS, 1, device)
        inputs = [
            _every_tile(device),
            *lists.arrays(),
            *local.lane_arrays(),
            tiles.knobs(settings),
            width,
            height,
            state,
        ]
        kernel = lifting_lanes.make_lift_ids(squared)
        launch(kernel, lists.tile_count, inputs, outputs, device=device, slots=True)
    where = [view(t, wp.int32) for t in (lists.entries, lists.places, starts, lists.tiles)]
    return [*where, view(local.tile_ids, wp.int32), view(local.counts, wp.int32), view(weights, wp.float32)]


def weigh_pairs(
    gaussians: Gaussians,
    camera: Camera,
    ids: Tensor,
    settings: RasterSettings = RasterSettings(),  # noqa: B008 - frozen
) -> tuple[Tensor, Tensor, Tensor]:
    """The transpose of the renderer applied to a one-hot id map, as a sparse matrix.

    Only pairs of a Gaussian and an id that it shows are stored, so the number of ids costs nothing.

    Args:
        gaussians: The scene.
        camera: Where the map was seen from.
        ids: Id at every pixel, -1 for none, integers [h, w]; read at the nearest position if smaller than the image.
        settings: The rasterizer's approximations.

    Returns:
        Gaussian, int32 [P], id, int32 [P], and the sum of alpha T over the pixels of that id, float32 [P] > 0; each
        pair occurs once, front to back. The same bits for any number of threads.

    Raises:
        InputError: `ids` is no integer image.
    """
    if ids.ndim != 2 or ids.is_floating_point():
        raise InputError(f"ids: expected integers [h, w], got {ids.dtype} {list(ids.shape)}")
    return pair_up(_lists(gaussians, camera, settings), camera, ids, settings, block=gaussians.device.type == "cuda")


def _lists(gaussians: Gaussians, camera: Camera, settings: RasterSettings) -> tiles.TileLists:
    projected = tiles.project(gaussians, camera, settings)
    return tiles.bin_splats(projected, tiles.depth_order(projected), None, camera, places=True, tiles=True)


def pair_up(
    lists: tiles.TileLists, camera: Camera, ids: Tensor, settings: RasterSettings, *, block: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """`weigh_pairs` of tile lists, in the lane or block schedule; either runs on the CPU."""
    device = lists.order.device
    local = localize_ids(lists, camera, ids.to(device, torch.int32).contiguous())
    weighed = weigh_ids(lists, camera, local, settings, block=block)
    # Every Gaussian gets room for all ids of all its tiles; most share theirs, so a part of it stays empty.
    room = torch.zeros(lists.intersections + 1, dtype=torch.int64, device=device)
    torch.cumsum(local.counts[lists.tiles], 0, out=room[1:])
    firsts = room[lists.entries]
    found = torch.empty(int(firsts[-1]), dtype=torch.int32, device=device)
    sums = torch.zeros(len(found), device=device)
    inputs = [*weighed, view(firsts.to(torch.int32), wp.int32)]
    outputs = [view(found, wp.int32), view(sums, wp.float32)]
    launch(lifting_pairs.gather_id_weights, len(lists.order), inputs, outputs, device=device)
    filled = sums.nonzero().flatten()
    owner = torch.repeat_interleave(lists.order, firsts[1:] - firsts[:-1])
    return owner[filled], found[filled], sums[filled]
