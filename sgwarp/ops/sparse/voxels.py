"""Voxel keys, strides, and the kernel maps of sparse convolutions.

A voxel is (batch, x, y, z), integers. Conventions are those of MinkowskiEngine: offset k of a kernel of side K is
(ix, iy, iz) with k = ix + K iy + K^2 iz; an odd kernel is centred, an even one starts at its voxel; the output voxels
of a strided convolution are floor(c / stride) * stride in absolute coordinates.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import torch
import warp as wp
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.kernels.sparse import convolution_block, voxels
from sgwarp.ops.launcher import launch, launch_plain, view

AXIS_BITS, BIAS = int(voxels.AXIS_BITS), int(voxels.BIAS)
LIMIT = int(voxels.LIMIT)  # coordinates lie in -LIMIT + 1 to LIMIT - 1
MAX_BATCH = 2 ** int(voxels.BATCH_BITS)
MARGIN = BIAS - LIMIT  # farthest that an offset may reach [voxels]
FIELD = 2**AXIS_BITS - 1
PER_CHUNK = {"cpu": 4096, "cuda": 64}  # targets per thread: few searches on the CPU, many threads on CUDA


def pack_voxels(coordinates: Tensor) -> Tensor:
    """Keys of voxels, int64 [N], in increasing order where rows are in lexicographic order.

    Args:
        coordinates: (batch, x, y, z), integers [N, 4].

    Raises:
        InputError: Another shape or type, or a voxel that is out of range.
    """
    if coordinates.ndim != 2 or coordinates.shape[1] != 4 or coordinates.is_floating_point():
        found = f"{coordinates.dtype} {list(coordinates.shape)}"
        raise InputError(f"coordinates: expected integers [N, 4], rows of (batch, x, y, z), got {found}")
    coordinates = coordinates.to(torch.int64)
    batch, axes = coordinates[:, 0], coordinates[:, 1:]
    bad = (batch < 0) | (batch >= MAX_BATCH) | ((axes <= -LIMIT) | (axes >= LIMIT)).any(dim=1)
    if bool(bad.any()):
        row = int(bad.nonzero()[0])
        raise InputError(
            f"coordinates[{row}] = {coordinates[row].tolist()}: expected a batch number below {MAX_BATCH} and x, y, z "
            f"from {1 - LIMIT} to {LIMIT - 1}; move the scene to the origin or take larger voxels"
        )
    x, y, z = (axes + BIAS).unbind(1)
    return (((batch << AXIS_BITS | x) << AXIS_BITS) | y) << AXIS_BITS | z


def unpack_voxels(keys: Tensor) -> Tensor:
    """(batch, x, y, z) of keys [N], int64 [N, 4]."""
    axes = [((keys >> shift) & FIELD) - BIAS for shift in (2 * AXIS_BITS, AXIS_BITS, 0)]
    return torch.stack([keys >> 3 * AXIS_BITS, *axes], dim=1)


def key_points(points: Tensor, origin: tuple[float, float, float], size: float, batch: int = 0) -> Tensor:
    """Voxel of every point: floor((point - origin) / size) in float64, as keys.

    Args:
        points: [m], float32 [N, 3].
        origin: Corner of voxel (0, 0, 0) [m].
        size: Side of a voxel [m].
        batch: Batch number of these points.

    Returns:
        int64 [N]; -1 for points that are not finite or out of range.

    Raises:
        InputError: Another shape or type, a size that is not positive, or a batch number out of range.
    """
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype != torch.float32:
        raise InputError(f"points: expected float32 [N, 3], got {points.dtype} {list(points.shape)}")
    if not 0 < size < float("inf") or not 0 <= batch < MAX_BATCH:
        raise InputError(f"expected a voxel size above 0 and a batch number below {MAX_BATCH}, got {size} and {batch}")
    keys = torch.empty(len(points), dtype=torch.int64, device=points.device)
    inputs = [view(points.contiguous(), wp.vec3), wp.vec3d(*origin), wp.float64(size), batch]
    launch(voxels.key_points, len(points), inputs, [view(keys, wp.int64)], device=points.device)
    return keys


def coarsen(keys: Tensor, stride: int) -> Tensor:
    """Sorted keys of the voxels at a stride, a power of two, that `keys` lie in."""
    field = FIELD & ~(stride - 1)
    mask = (((MAX_BATCH - 1) << AXIS_BITS | field) << AXIS_BITS | field) << AXIS_BITS | field
    return torch.unique(keys & mask)


@dataclass(frozen=True, eq=False)
class KernelMap:
    """Pairs of voxels that a convolution connects, offset by offset.

    Attributes:
        sources: Row that is read, int64 [pairs].
        targets: Row that is written, int64 [pairs]; no row twice within an offset.
        starts: First pair of each of the K^3 offsets, and the number of pairs.
        source_count, target_count: Rows on either side.
        identity: Offset that connects every voxel with itself and has no pairs here; None if there is none.
        turned: Whether it was swapped an odd number of times.
        kept: Tables made of the pairs, shared with the swapped map.
    """

    sources: Tensor
    targets: Tensor
    starts: tuple[int, ...]
    source_count: int
    target_count: int
    identity: int | None = None
    turned: bool = False
    kept: dict[str, Tensor] = field(default_factory=dict, repr=False)

    @property
    def offsets(self) -> int:
        return len(self.starts) - 1

    @property
    def pairs(self) -> int:
        """Number of multiplied rows, those of the identity included."""
        return self.starts[-1] + (0 if self.identity is None else self.target_count)

    def swapped(self) -> KernelMap:
        """The map of the transposed convolution: the same offsets, read and written the other way round."""
        counts = self.target_count, self.source_count
        return KernelMap(self.targets, self.sources, self.starts, *counts, self.identity, not self.turned, self.kept)

    @property
    def sources_of_targets(self) -> Tensor:
        """Source of every target at each offset, -1 where it has none, int32 [K^3, M]; made once for both directions.

        The identity has no pairs, so that its row is empty.
        """
        if "by target" not in self.kept:
            self.kept.update(_tables(self))
        return self.kept["by source" if self.turned else "by target"]

    @property
    def starts_on_device(self) -> Tensor:
        """`starts` beside the pairs, int32 [K^3 + 1]."""
        if "starts" not in self.kept:
            self.kept["starts"] = torch.tensor(self.starts, dtype=torch.int32).to(self.sources.device)
        return self.kept["starts"]


def _tables(pairs: KernelMap) -> dict[str, Tensor]:
    """Sources by target and targets by source of a map, named as they are before it is turned."""
    device, offsets = pairs.sources.device, pairs.offsets
    filled = torch.full((offsets * (pairs.target_count + pairs.source_count),), -1, dtype=torch.int32, device=device)
    by_target, by_source = filled.split([offsets * pairs.target_count, offsets * pairs.source_count])
    by_target, by_source = by_target.view(offsets, -1), by_source.view(offsets, -1)
    starts = torch.tensor(pairs.starts, dtype=torch.int32).to(device)
    inputs = [view(pairs.sources, wp.int64), view(pairs.targets, wp.int64), view(starts, wp.int32)]
    outputs = [view(by_target, wp.int32), view(by_source, wp.int32)]
    launch_plain(convolution_block.tabulate_pairs, len(pairs.sources), inputs, outputs, device=device)
    tables = (by_source, by_target) if pairs.turned else (by_target, by_source)
    return {"by target": tables[0], "by source": tables[1], "starts": starts}


def kernel_map(sources: Tensor, targets: Tensor, side: int, step: int = 1) -> KernelMap:
    """Connect target voxels with the source voxels under a kernel.

    Args:
        sources: Sorted unique keys of the voxels that are read, int64 [N].
        targets: Sorted unique keys of the voxels that are written, int64 [M]; the same tensor for a convolution
            without stride, of whose map half is searched and half mirrored.
        side: K of the K^3 kernel.
        step: Between neighbouring offsets: tensor stride times dilation [voxels].

    Raises:
        InputError: The kernel reaches farther than keys have room for.
    """
    first = -(side // 2) if side % 2 else 0
    reach = step * max(side // 2, side - 1 + first)
    if side < 1 or step < 1 or reach > MARGIN:
        raise InputError(f"a kernel of side {side} and step {step} reaches {reach} voxels; at most {MARGIN} may be")
    along = [step * (first + i) for i in range(side)]
    steps = [(x << 2 * AXIS_BITS) + (y << AXIS_BITS) + z for z, y, x in itertools.product(along, repeat=3)]
    if sources is not targets or side % 2 == 0 or side == 1:
        found, written, counts = _merge(sources, targets, steps)
        return KernelMap(found, written, _starts(counts), len(sources), len(targets))
    # Offset K^3 - 1 - k is minus offset k: its pairs are those of k the other way round.
    half = len(steps) // 2
    found, written, counts = _merge(sources, targets, steps[:half])
    mirror_found, mirror_written = (torch.cat(rows.split(counts)[::-1]) for rows in (written, found))
    return KernelMap(
        torch.cat([found, mirror_found]),
        torch.cat([written, mirror_written]),
        _starts([*counts, 0, *reversed(counts)]),
        len(sources),
        len(targets),
        identity=half,
    )


def _starts(counts: list[int]) -> tuple[int, ...]:
    return tuple(itertools.accumulate(counts, initial=0))


def _merge(sources: Tensor, targets: Tensor, steps: list[int]) -> tuple[Tensor, Tensor, list[int]]:
    """Rows of sources and of targets, offset by offset, and how many of each offset."""
    device = targets.device
    nothing = torch.empty(0, dtype=torch.int64, device=device)
    if not steps or not len(sources) or not len(targets):
        return nothing, nothing, [0] * len(steps)
    per_chunk = min(PER_CHUNK[device.type], max(64, len(targets) // 8))
    chunks = -(-len(targets) // per_chunk)
    threads = len(steps) * chunks
    added = torch.tensor(steps, dtype=torch.int64, device=device)
    inputs = [*(view(t, wp.int64) for t in (added, sources, targets)), per_chunk, chunks]
    counts = torch.empty(threads, dtype=torch.int32, device=device)
    rows = [nothing, nothing]

    def run(write: bool, places: Tensor) -> None:
        outputs = [view(counts, wp.int32), *(view(row, wp.int64) for row in rows)]
        kernel = voxels.make_list_pairs(write)
        share = max(1, threads // 32)  # a kernel thread is long: even few of them are worth two host threads
        launch(kernel, threads, [*inputs, view(places, wp.int64)], outputs, device=device, chunk=share)

    run(False, nothing)
    ends = counts.cumsum(0, dtype=torch.int64)
    per_offset = counts.view(len(steps), chunks).sum(dim=1).tolist()
    rows = [torch.empty(sum(per_offset), dtype=torch.int64, device=device) for _ in range(2)]
    run(True, ends - counts)
    return rows[0], rows[1], per_offset
