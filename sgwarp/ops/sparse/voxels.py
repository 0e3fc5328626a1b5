"""Voxel keys, strides, and the kernel maps of sparse convolutions.

A voxel is (batch, x, y, z), integers. Conventions are those of MinkowskiEngine: offset k of a kernel of side K is
(ix, iy, iz) with k = ix + K iy + K^2 iz; an odd kernel is centred, an even one starts at its voxel; the output voxels
of a strided convolution are floor(c / stride) * stride in absolute coordinates.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, replace
from typing import Any

import torch
import warp as wp
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.kernels.sparse import voxels
from sgwarp.ops.arguments import view
from sgwarp.ops.launcher import launch, launch_plain

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
    """Which voxels a convolution connects, offset by offset: as pairs or as tables, each made when it is asked for.

    The kernels of CUDA read the tables, which are made in one launch, without a wait; everything else reads the pairs.

    Attributes:
        side: K of the K^3 kernel.
        step: Between neighbouring offsets [voxels].
        keys: Sorted keys of the sources and of the targets as they were before the map was turned; the same tensor for
            a convolution without stride.
        turned: Whether it was swapped an odd number of times.
        kept: What was made so far, shared with the swapped map.
    """

    side: int
    step: int
    keys: tuple[Tensor, Tensor]
    turned: bool = False
    kept: dict[str, Any] = field(default_factory=dict, repr=False)

    @property
    def device(self) -> torch.device:
        return self.keys[0].device

    @property
    def source_count(self) -> int:
        """Rows that are read."""
        return len(self.keys[1 if self.turned else 0])

    @property
    def target_count(self) -> int:
        """Rows that are written."""
        return len(self.keys[0 if self.turned else 1])

    @property
    def offsets(self) -> int:
        return self.side**3

    @property
    def symmetric(self) -> bool:
        """Whether offset K^3 - 1 - k is minus offset k, between the same voxels."""
        return self.keys[0] is self.keys[1] and self.side % 2 == 1

    @property
    def identity(self) -> int | None:
        """Offset that connects every voxel with itself and has no pairs; None if there is none."""
        return self.offsets // 2 if self.symmetric else None

    @property
    def _pairs(self) -> tuple[Tensor, Tensor, tuple[int, ...]]:
        """Rows of either side before the map was turned, offset by offset, and where those of each offset begin."""
        if "pairs" not in self.kept:
            self.kept["pairs"] = _list_pairs(self)
        pairs: tuple[Tensor, Tensor, tuple[int, ...]] = self.kept["pairs"]
        return pairs

    @property
    def sources(self) -> Tensor:
        """Row that is read, int64 [pairs]."""
        found, written, _ = self._pairs
        return written if self.turned else found

    @property
    def targets(self) -> Tensor:
        """Row that is written, int64 [pairs]; no row twice within an offset."""
        found, written, _ = self._pairs
        return found if self.turned else written

    @property
    def starts(self) -> tuple[int, ...]:
        """First pair of each of the K^3 offsets, and the number of pairs."""
        return self._pairs[2]

    @property
    def pairs(self) -> int:
        """Number of multiplied rows, those of the identity included."""
        return self.starts[-1] + (0 if self.identity is None else self.target_count)

    def swapped(self) -> KernelMap:
        """The map of the transposed convolution: the same offsets, read and written the other way round."""
        return replace(self, turned=not self.turned)

    def table(self, by_target: bool) -> tuple[Tensor, bool]:
        """Source of every target at each offset, or target of every source; -1 where there is none.

        Returns:
            int32 [K^3, rows], empty if the identity is the only offset; and whether its rows belong to the offsets in
            reverse, as they do where one table of a symmetric map serves both ways.
        """
        if "tables" not in self.kept:
            self.kept["tables"] = _tables(self)
        first = by_target != self.turned
        tables: list[Tensor] = self.kept["tables"]
        return tables[0 if first or self.symmetric else 1], self.symmetric and not first


def _tables(pairs: KernelMap) -> list[Tensor]:
    """Source of every target before the map was turned; and, if it is not symmetric, target of every source."""
    sources, targets = pairs.keys
    offsets = 0 if pairs.identity == 0 else pairs.offsets
    counts = [len(targets), 0 if pairs.symmetric else len(sources)]
    tables = [torch.empty(offsets, count, dtype=torch.int32, device=pairs.device) for count in counts]
    inputs = [pairs.side, pairs.step, view(sources, wp.int64), view(targets, wp.int64)]
    outputs = [view(table, wp.int32) for table in tables]
    launch_plain(voxels.tabulate_neighbors, (offsets, sum(counts)), inputs, outputs, device=pairs.device)
    return tables


def kernel_map(sources: Tensor, targets: Tensor, side: int, step: int = 1) -> KernelMap:
    """Connect target voxels with the source voxels under a kernel.

    Args:
        sources: Sorted unique keys of the voxels that are read, int64 [N].
        targets: Sorted unique keys of the voxels that are written, int64 [M]; the same tensor for a convolution
            without stride, of whose pairs half are searched and half mirrored.
        side: K of the K^3 kernel.
        step: Between neighbouring offsets: tensor stride times dilation [voxels].

    Raises:
        InputError: The kernel reaches farther than keys have room for.
    """
    first = -(side // 2) if side % 2 else 0
    reach = step * max(side // 2, side - 1 + first)
    if side < 1 or step < 1 or reach > MARGIN:
        raise InputError(f"a kernel of side {side} and step {step} reaches {reach} voxels; at most {MARGIN} may be")
    return KernelMap(side, step, (sources, targets))


def _list_pairs(pairs: KernelMap) -> tuple[Tensor, Tensor, tuple[int, ...]]:
    """Rows of sources and of targets, offset by offset, and where each offset begins."""
    (sources, targets), side = pairs.keys, pairs.side
    first = -(side // 2) if side % 2 else 0
    along = [pairs.step * (first + i) for i in range(side)]
    steps = [(x << 2 * AXIS_BITS) + (y << AXIS_BITS) + z for z, y, x in itertools.product(along, repeat=3)]
    if not pairs.symmetric:
        found, written, counts = _merge(sources, targets, steps)
        return found, written, _starts(counts)
    # Offset K^3 - 1 - k is minus offset k: its pairs are those of k the other way round.
    found, written, counts = _merge(sources, targets, steps[: len(steps) // 2])
    if not counts:  # the identity alone
        return found, written, (0, 0)
    mirror_found, mirror_written = (torch.cat(rows.split(counts)[::-1]) for rows in (written, found))
    starts = _starts([*counts, 0, *reversed(counts)])
    return torch.cat([found, mirror_found]), torch.cat([written, mirror_written]), starts


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
