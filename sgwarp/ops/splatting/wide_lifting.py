"""Lifting many dense channels on the CPU: the entries of A once, then its transpose times the map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from torch import Tensor

from sgwarp.kernels.lifting import lanes_wide, shared
from sgwarp.kernels.lifting.loops import WIDE as WIDE
from sgwarp.kernels.transmittance import Lanes
from sgwarp.ops.arguments import view
from sgwarp.ops.launcher import get_threads, launch
from sgwarp.ops.memory import scratch
from sgwarp.ops.splatting import tiles
from sgwarp.ops.splatting.forward import LANE, TILE_ROWS, lane_scratch
from sgwarp.ops.splatting.lift_sums import LiftSums
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.scene import Camera

LEAST_SLICES = 8  # from here on writing down the entries of A pays
MOST_RANKS = 2**18  # Gaussians whose sums a thread holds at once, 256 bytes each
PAIR_BYTES = 1024 * 2**20  # at most this much scratch for the entries of A


@dataclass(frozen=True)
class Entries:
    """Entries of A of one view, place by place; scratch, valid until the next view.

    Attributes:
        starts: First pair of each place, int32 [I + 1].
        pixels: Pixel of each pair within its tile, 16 y + x, uint8 [pairs].
        weights: alpha T of each pair, or its square, float32 [pairs].
        totals: Their sum for each place, float32 [I].
    """

    starts: Tensor
    pixels: Tensor
    weights: Tensor
    totals: Tensor


def list_entries(
    lists: tiles.TileLists, valid: Any, settings: RasterSettings, size: tuple[int, int], squared: bool
) -> Entries | None:
    """Entries of A, or None if they take too much memory. `valid` is as `lanes_wide.py` reads it, `size` (H, W)."""
    device, total = lists.order.device, lists.intersections
    height, width = size
    floats, ints = torch.float32, torch.int32
    counts = scratch("pair counts", total, ints, device)
    totals = scratch("entry weights", total, floats, device)
    state = lane_scratch("state", TILE_ROWS, 1, device)
    before = [*lists.arrays(), valid]
    behind = [tiles.knobs(settings), width, height, state]

    def walk(write: bool, starts: Tensor, pixels: Tensor, weights: Tensor) -> None:
        kernel = lanes_wide.make_list_weights(write, squared)
        outputs = [view(counts, wp.int32), view(pixels, wp.uint8), view(weights, wp.float32), view(totals, wp.float32)]
        launch(kernel, lists.tile_count, [*before, view(starts, wp.int32), *behind], outputs, device=device, slots=True)

    nothing = torch.empty(0, dtype=ints, device=device)
    walk(False, nothing, nothing.to(torch.uint8), torch.empty(0, device=device))
    pairs = int(counts.sum())
    if 5 * pairs > PAIR_BYTES:
        return None
    starts = scratch("pair starts", total + 1, ints, device)
    starts[0] = 0
    torch.cumsum(counts, 0, dtype=ints, out=starts[1:])
    pixels, weights = scratch("pair pixels", pairs, torch.uint8, device), scratch("pair weights", pairs, floats, device)
    walk(True, starts, pixels, weights)
    return Entries(starts, pixels, weights, totals)


def add_weights(lists: tiles.TileLists, entries: Entries, sums: LiftSums) -> None:
    """Add a view's weights to the sums."""
    outputs = [view(sums.weight, wp.float32), view(sums.weight_squared, wp.float32)]
    inputs = [*lists.sums(), view(entries.totals, wp.float32)]
    launch(shared.sum_weights, len(lists.order), inputs, outputs, device=lists.order.device)


def add_slices(
    lists: tiles.TileLists,
    entries: Entries,
    features: Tensor,
    place: tuple[int, int, int],
    camera: Camera,
    sums: LiftSums,
) -> None:
    """Add A^T f of `count` slices, whole groups: from `first_feature` of the map's [H, W, S, 16] to `first` of the
    sums'."""
    first_feature, first, count = place
    device, threads, visible = features.device, get_threads(), len(lists.order)
    groups = count // WIDE
    ranges = max(-(-threads // groups), -(-visible // MOST_RANKS))
    per_range = -(-visible // ranges)
    packed = scratch("packed tiles", threads * 256 * WIDE * LANE, torch.float32, device)
    summed = scratch("wide sums", threads * per_range * WIDE * LANE, torch.float32, device)
    inputs = [ranges, *(view(t, wp.int32) for t in (lists.offsets, lists.listed, lists.order, entries.starts))]
    inputs += [view(entries.pixels, wp.uint8), view(entries.weights, wp.float32)]
    inputs += [view(features, Lanes), first_feature, first, camera.width, camera.height]
    inputs += [view(t.view(threads, -1, LANE), Lanes) for t in (packed, summed)]
    outputs = [view(sums.slices, Lanes)]
    launch(lanes_wide.sum_tiles, groups * ranges, inputs, outputs, device=device, slots=True, chunk=1)
