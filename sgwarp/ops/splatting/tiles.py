"""Projection and tile lists of one view: what compositing and lifting both start from."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any
from weakref import WeakKeyDictionary

import torch
import warp as wp
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.kernels import binning, binning_lanes, ordering_lanes
from sgwarp.kernels.gaussian import Pinhole, Splat
from sgwarp.kernels.harmonics import forward as harmonics
from sgwarp.kernels.native import GROUP
from sgwarp.kernels.projection import forward as projection
from sgwarp.kernels.projection import lanes as projection_lanes
from sgwarp.ops.arguments import view, view_structs
from sgwarp.ops.devices import warp_device
from sgwarp.ops.launcher import launch, launch_plain, sort_pairs
from sgwarp.ops.memory import scratch
from sgwarp.ops.splatting.room import MOST, ListRoom
from sgwarp.ops.splatting.settings import RasterSettings
from sgwarp.scene import Camera, Gaussians

TILE = 16
SLICES = 16  # of the depth order, counted and filled independently; not the number of threads
MAX_INTERSECTIONS = 2**31 - 1


@dataclass(frozen=True)
class Projected:
    """Splats of one view; the arrays are scratch, valid until the next view."""

    splats: Any  # Splat [N], as kernels take it
    status: Tensor  # uint8 [N], see kernels/projection.py
    depths: Tensor  # float32 [N] z [m], valid where visible
    counted: Tensor | None = None  # int64 per status, on the CPU, valid once ordered; its own memory
    invalid: Tensor | None = None  # int32 [1], on the CPU, whether some scale is negative or opacity outside [0, 1]

    def counts(self) -> Tensor:
        """Number of Gaussians per status, int64; on CUDA the host waits only when it is read."""
        if self.status.device.type == "cuda":
            names = torch.arange(len(projection.STATUS_NAMES), device=self.status.device)
            return (self.status[:, None] == names).sum(dim=0)
        if self.counted is None:
            return torch.bincount(self.status, minlength=len(projection.STATUS_NAMES))
        return self.counted


def culled(counts: Tensor) -> dict[str, int]:
    """Number of Gaussians that were left out, by reason, from `Projected.counts`."""
    named = dict(zip(projection.STATUS_NAMES, counts.tolist(), strict=True))
    return {name: count for name, count in named.items() if count and name != "visible"}


@dataclass(frozen=True)
class TileLists:
    """Tile lists of one view; scratch memory, valid until the next view unless kept.

    A place is a position in the lists, an entry an intersection (one splat in one tile) counted splat by splat, a rank
    a place in the depth order. A row of sums belongs to a splat in a patch of tiles (`kernels/binning_lanes.py`).
    """

    order: Tensor  # int32 [V] Gaussians by (depth, index)
    memory: Tensor  # int32, flat: the splats in depth order
    offsets: Tensor  # int32 [tiles + 1] first place of each tile
    listed: Tensor  # int32 [I] ranks, tile by tile, front to back
    entries: Tensor  # int32 [V + 1] first entry of each rank
    places: Tensor  # int32 [I] place of each entry; empty unless asked for
    tiles: Tensor  # int32 [I] tile of each entry; empty unless asked for
    row_places: Tensor  # int32 [V, 2] where the rows of sums of each rank are; empty unless asked for, as what follows
    row_ranges: Tensor  # int32 [N + 1, 2] first row of sums of each Gaussian and their number; last: of all

    @property
    def tile_count(self) -> int:
        return len(self.offsets) - 1

    @property
    def intersections(self) -> int:
        return len(self.listed)

    @property
    def splats(self) -> wp.array:
        """The splats in depth order, Splat [V]; a view of `memory`."""
        return as_splats(self.memory)

    def arrays(self) -> list[Any]:
        """Inputs of compositing and lifting kernels: offsets, listed, splats."""
        return [view(self.offsets, wp.int32), view(self.listed, wp.int32), view_splats(self.memory)]

    def sums(self) -> list[Any]:
        """Inputs of the kernels that sum the rows of each Gaussian: order, entries, places."""
        return [view(t, wp.int32) for t in (self.order, self.entries, self.places)]


SPLAT_WORDS = wp.types.type_size_in_bytes(Splat) // 4


def splat_memory(count: int, device: torch.device, name: str | None) -> Tensor:
    """Room for `count` splats, int32, flat: scratch of that name, or memory of its own."""
    if name is None:
        return torch.empty(count * SPLAT_WORDS, dtype=torch.int32, device=device)
    return scratch(name, count * SPLAT_WORDS, torch.int32, device)


def view_splats(memory: Tensor) -> Any:
    """The memory as an array of splats, for kernels."""
    return view_structs(memory, Splat, len(memory) // SPLAT_WORDS)


def as_splats(memory: Tensor) -> wp.array:
    """The memory as an array of splats, to look at; it must outlive the array."""
    count = len(memory) // SPLAT_WORDS
    layout = {"dtype": Splat, "shape": (count,), "capacity": 4 * len(memory)}
    splats: wp.array = wp.array(ptr=memory.data_ptr(), device=warp_device(memory.device), **layout)
    return splats


_pinholes: WeakKeyDictionary[Camera, Pinhole] = WeakKeyDictionary()


def pinhole(camera: Camera) -> Pinhole:
    """The camera as the kernels read it; made once for each camera, since every kernel of a step reads it."""
    held = _pinholes.get(camera)
    if held is None:
        held = _pinholes[camera] = _make_pinhole(camera)
    return held


def _make_pinhole(camera: Camera) -> Pinhole:
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    center = camera.position
    rounded = center.to(torch.float32)
    device = Pinhole()
    device.rotation = wp.mat33(*(entry for row in camera.world_to_camera.tolist()[:3] for entry in row[:3]))
    device.center = wp.vec3(*rounded.tolist())
    device.center_rest = wp.vec3(*(center - rounded.to(torch.float64)).tolist())
    device.focal = wp.vec2(fx, fy)
    device.principal = wp.vec2(cx, cy)
    # gsplat's clamp: 0.3 half fields of view beyond the image's borders, wherever the principal point lies.
    margin_x, margin_y = 0.15 * camera.width / fx, 0.15 * camera.height / fy
    device.tangent_min = wp.vec2(-cx / fx - margin_x, -cy / fy - margin_y)
    device.tangent_max = wp.vec2((camera.width - cx) / fx + margin_x, (camera.height - cy) / fy + margin_y)
    device.width, device.height = camera.width, camera.height
    device.near, device.far = camera.near, camera.far
    return device


@lru_cache(maxsize=64)
def knobs(settings: RasterSettings) -> projection.Knobs:
    """The settings as the kernels read them."""
    device = projection.Knobs()
    device.alpha_min = settings.alpha_min
    device.alpha_max = settings.alpha_max
    device.transmittance_min = settings.transmittance_min
    device.dilation = settings.dilation
    device.antialiased = int(settings.antialiased)
    device.surface_transmittance = 1.0 - settings.surface_opacity
    device.alpha_min_level = math.log2(settings.alpha_min)
    return device


def project(
    gaussians: Gaussians,
    camera: Camera,
    settings: RasterSettings,
    *,
    degree: int | None = None,
    look: bool = True,
) -> Projected:
    """Project every Gaussian.

    Args:
        gaussians, camera, settings: What is seen.
        degree: On the CPU also evaluate the harmonics of what is visible, up to this degree.
        look: On the CPU look once per scene whether some coefficient is not finite. Without it only those are looked
            at that are evaluated: of what is hidden and not finite the status says why it is hidden.
    """
    n, device = len(gaussians), gaussians.device
    splats = view_splats(splat_memory(n, device, "splats"))
    status = scratch("status", n, torch.uint8, device)
    depths = scratch("depths", n, torch.float32, device)
    inputs = [
        view(gaussians.means, wp.vec3),
        view(gaussians.quats, wp.vec4),
        view(gaussians.scales, wp.vec3),
        view(gaussians.opacities, wp.float32),
    ]
    seen_by = [pinhole(camera), knobs(settings)]
    outputs = [splats, view(status, wp.uint8), view(depths, wp.float32)]
    if device.type == "cuda":
        # The kernel reads geometry and opacity only. It is cheaper to look at all colours than to wait for an answer.
        launch(projection.project_gaussians, n, [*inputs, *seen_by], outputs, device=device)
        mark_non_finite_colors(gaussians.sh, status)
        return Projected(splats, status, depths)
    read = -1 if degree is None else degree
    inputs += [view(gaussians.sh, wp.vec3), read, *seen_by]
    invalid = torch.zeros(1, dtype=torch.int32, device=device)
    outputs.append(view(invalid, wp.int32))
    launch(projection_lanes.project_groups, -(-n // GROUP), inputs, outputs, device=device)
    # The kernel left out those whose coefficients it read are not finite. There may be others.
    if (look or (read + 1) ** 2 < gaussians.sh.shape[1]) and gaussians.colors_may_be_non_finite:
        status.masked_fill_(~gaussians.finite, int(projection.NON_FINITE))
    return Projected(splats, status, depths, _status_counts(device), invalid)


def _status_counts(device: torch.device) -> Tensor:
    return torch.empty(len(projection.STATUS_NAMES), dtype=torch.int64, device=device)


def mark_non_finite_colors(sh: Tensor, status: Tensor) -> None:
    """Set the status [N] of Gaussians with a coefficient that is not finite, [N, K, 3]; one launch."""
    inputs, outputs = [view(sh, wp.vec3)], [view(status, wp.uint8)]
    launch_plain(projection.mark_non_finite_colors, sh.shape[0] * sh.shape[1], inputs, outputs, device=sh.device)


def leave_out_non_finite(projected: Projected, features: Tensor | None) -> None:
    """On CUDA, leave out Gaussians some feature of which is NaN or infinity; on the CPU they were refused."""
    if features is not None and features.is_cuda:
        rows = torch.isfinite(features.detach().sum(dim=1, dtype=torch.float64))
        projected.status.masked_fill_(~rows, int(projection.NON_FINITE))


def depth_order(projected: Projected, *, keep: bool = False) -> Tensor:
    """Visible Gaussians by (depth, index), int32 [V]; on CUDA all N, the culled last, so that nobody waits for V.

    On the CPU it is scratch, valid until the next view, unless kept.
    """
    device = projected.status.device
    if device.type == "cuda":
        shown = torch.where(projected.status == projection.VISIBLE, projected.depths, math.inf)
        return shown.argsort(stable=True).to(torch.int32)
    n = len(projected.status)
    pairs, order = scratch("depth pairs", 2 * n, torch.int64, device), _integers("order", n, device, keep)
    counted = projected.counted
    if counted is None:
        counted = _status_counts(device)
    inputs = [view(projected.status, wp.uint8), view(projected.depths, wp.float32), view(pairs, wp.uint64)]
    launch(ordering_lanes.sort_depths, 1, inputs, [view(order, wp.int32), view(counted, wp.int64)], device=device)
    return order[: int(counted[projection.VISIBLE])]


def shade(gaussians: Gaussians, camera: Camera, order: Tensor, degree: int) -> Tensor:
    """Colours of the visible Gaussians seen from the camera, in depth order, float32 [V, 3]; degree 0 to 3."""
    colors = scratch("colors", 3 * len(order), torch.float32, gaussians.device).view(-1, 3)
    inputs = [
        view(order, wp.int32),
        view(gaussians.means, wp.vec3),
        view(gaussians.sh, wp.vec3),
        degree,
        pinhole(camera),
    ]
    launch(harmonics.evaluate_harmonics, len(order), inputs, [view(colors, wp.vec3)], device=gaussians.device)
    return colors


def _first_places(counts: Tensor, limit: int) -> tuple[Tensor, int]:
    """Exclusive prefix sum with the total at the end, int32 [n + 1], and the total."""
    places = torch.zeros(len(counts) + 1, dtype=torch.int64, device=counts.device)
    torch.cumsum(counts, 0, out=places[1:])
    total = int(places[-1])  # the one host synchronisation of the render path on CUDA: it sizes the lists
    _check_total(total, limit)
    return places.to(torch.int32), total


def _check_total(total: int, limit: int) -> None:
    if total > limit:
        raise InputError(f"{total} tile intersections exceed {limit}; render at a lower resolution or fewer Gaussians")


def bin_splats(
    projected: Projected,
    order: Tensor,
    colors: Tensor | None,
    camera: Camera,
    *,
    places: bool = False,
    tiles: bool = False,
    rows: bool = False,
    keep: bool = False,
    room: ListRoom | None = None,
) -> TileLists:
    """Write the tile lists of a view.

    `colors` [V, 3] travel with the splats; `places` and `tiles` of the entries and the `rows` of sums, on the CPU, are
    filled only if asked for. With `keep` the lists have memory of their own, as the order then has: they outlive the
    view, as a backward pass needs it. On CUDA nobody waits for the length of the lists if they are given a `room`.
    """
    device = order.device
    packed = view(torch.empty(0, 3, device=device) if colors is None else colors, wp.vec3)
    memory = splat_memory(len(order), device, None if keep else "ordered splats")
    if device.type == "cuda":
        return bin_by_sorting(projected, order, packed, camera, memory, keep=keep, room=room)
    lists = bin_by_counting(projected, order, packed, camera, memory, places=places, tiles=tiles, rows=rows, keep=keep)
    if room is not None:
        room.note(lists.entries[-1].to(torch.int64))
    return lists


def bin_by_counting(
    projected: Projected,
    order: Tensor,
    colors: Any,
    camera: Camera,
    memory: Tensor,
    *,
    places: bool,
    tiles: bool,
    rows: bool,
    keep: bool,
) -> TileLists:
    """Count and fill in slices of the depth order (CPU)."""
    device, count, grid = order.device, len(order), _tile_count(camera)
    per_slice = max(1, -(-count // SLICES))
    cursors = scratch("tile counts", SLICES * grid, torch.int32, device).view(SLICES, grid)
    totals = torch.zeros(SLICES + 1, 2, dtype=torch.int64, device=device)
    sizes = [per_slice, camera.width, camera.height]
    splats = view_splats(memory)
    inputs = [view(order, wp.int32), projected.splats, colors, *sizes]
    shared = [view(cursors, wp.int32), view(totals, wp.int64)]
    words = binning_lanes.SPAN_WORDS * count
    kept = [view(scratch("spans", words, torch.int64, device), wp.uint64)]
    kept += [view(scratch(name, count, torch.int32, device), wp.int32) for name in ("tile rows", "tile patches")]
    ranges = _integers("row ranges", 2 * (len(projected.status) + 1) if rows else 0, device, keep).view(-1, 2)
    ranged = view(ranges, wp.int32)
    outputs = [splats, *shared, *kept, ranged]
    launch(binning_lanes.count_tiles, SLICES, inputs, outputs, device=device, chunk=1)
    offsets = torch.empty(grid + 1, dtype=torch.int32, device=device)
    launch(binning_lanes.place_slices, 1, [], [*shared, view(offsets, wp.int32)], device=device)
    total, _ = totals[-1].tolist()
    _check_total(total, MAX_INTERSECTIONS)
    lengths = {
        "listed": total,
        "entries": count + 1,
        "places": total if places else 0,
        "entry tiles": total if tiles else 0,
        "row places": 2 * count if rows else 0,
    }
    listed, entries, places_of, tiles_of, row_places = (
        _integers(name, length, device, keep) for name, length in lengths.items()
    )
    row_places = row_places.view(-1, 2)
    inputs = [view(order, wp.int32), splats, *sizes, shared[1], *kept, shared[0]]
    outputs = [*(view(t, wp.int32) for t in (listed, entries, places_of, tiles_of, row_places)), ranged]
    launch(binning_lanes.fill_tiles, SLICES, inputs, outputs, device=device, chunk=1)
    return TileLists(order, memory, offsets, listed, entries, places_of, tiles_of, row_places, ranges)


def bin_by_sorting(
    projected: Projected,
    order: Tensor,
    colors: Any,
    camera: Camera,
    memory: Tensor,
    *,
    keep: bool,
    room: ListRoom | None = None,
) -> TileLists:
    """Emit in depth order, sort by tile, list (CUDA); the lists are those of `bin_by_counting`.

    In a `room` larger than needed, unused places follow those of the last tile, whose end `offsets` says.
    """
    device, count, grid = order.device, len(order), _tile_count(camera)
    size = [camera.width, camera.height]
    splat_counts = scratch("splat counts", count, torch.int32, device)
    splats = view_splats(memory)
    inputs = [view(order, wp.int32), projected.splats, colors, view(projected.status, wp.uint8), *size]
    launch_plain(binning.count_splat_tiles, count, inputs, [splats, view(splat_counts, wp.int32)], device=device)
    if room is None:
        entries, total = _first_places(splat_counts, MOST)
    else:
        entries, total = _places_in_room(splat_counts, room), room.size
    listed, places_of, tiles_of = (_integers(name, total, device, keep) for name in ("listed", "places", "tiles"))
    keys = scratch("tile keys", 2 * total, torch.int32, device)
    values = scratch("tile values", 2 * total, torch.int32, device)
    ranks = scratch("tile ranks", total, torch.int32, device)
    if room is not None:
        tiles_of.fill_(grid)  # behind every tile
        ranks.zero_()
        values[:total] = torch.arange(total, dtype=torch.int32, device=device)
    outputs = [view(t, wp.int32) for t in (tiles_of, values, ranks)]
    launch_plain(binning.emit_tiles, count, [splats, *size, view(entries, wp.int32)], outputs, device=device)
    keys[:total] = tiles_of
    sort_pairs(keys, values, total, wp.int32, end_bit=grid.bit_length())
    edges = torch.arange(grid + 1, dtype=torch.int32, device=device)
    offsets = torch.searchsorted(keys[:total], edges).to(torch.int32)
    outputs = [view(listed, wp.int32), view(places_of, wp.int32)]
    launch_plain(binning.list_sorted, total, [view(values, wp.int32), view(ranks, wp.int32)], outputs, device=device)
    none = order.new_empty(0, 2)
    return TileLists(order, memory, offsets, listed, entries, places_of, tiles_of, none, none)


def _places_in_room(counts: Tensor, room: ListRoom) -> Tensor:
    """First place of each splat's entries, int32 [n + 1]; those that the room does not hold have none."""
    places = torch.zeros(len(counts) + 1, dtype=torch.int64, device=counts.device)
    torch.cumsum(counts, 0, out=places[1:])
    room.note(places[-1])
    return places.clamp(max=room.size).to(torch.int32)


def _tile_count(camera: Camera) -> int:
    return -(-camera.width // TILE) * -(-camera.height // TILE)


def _integers(name: str, count: int, device: torch.device, keep: bool) -> Tensor:
    """`count` int32 of the lists: scratch, or memory of its own where it is kept."""
    return torch.empty(count, dtype=torch.int32, device=device) if keep else scratch(name, count, torch.int32, device)
