"""The tables that gsplat returns as `meta`: one row per visible splat (packed) or per camera and Gaussian (dense)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.ops.planar.intersections import intersection_keys, tile_bits
from sgwarp.ops.planar.projection import ProjectedSplats, select_rows
from sgwarp.ops.planar.splats import listed_rows
from sgwarp.ops.splatting.tiles import TileLists


@dataclass(frozen=True)
class Images:
    """Numbering of the images of a call: image i = b * cameras + c, N Gaussians in each scene b."""

    batch_dims: tuple[int, ...]
    batches: int
    cameras: int
    gaussians: int

    @classmethod
    def of(cls, means: Tensor, viewmats: Tensor) -> Images:
        """Read the counts off means [..., N, 3] and viewmats [..., C, 4, 4]."""
        if not isinstance(means, Tensor) or means.ndim < 2:
            raise InputError("means: expected a tensor [..., N, 3]")
        if not isinstance(viewmats, Tensor) or viewmats.ndim < 3:
            raise InputError("viewmats: expected a tensor [..., C, 4, 4]")
        if viewmats.shape[-3] == 0:
            raise InputError("viewmats: expected at least one camera")
        batch_dims = tuple(means.shape[:-2])
        return cls(batch_dims, math.prod(batch_dims), viewmats.shape[-3], means.shape[-2])

    @property
    def count(self) -> int:
        return self.batches * self.cameras

    def scenes(self, tensor: Tensor) -> list[Tensor]:
        """[..., N, *] as one [N, *] per scene; without batch dimensions the tensor itself."""
        if not self.batch_dims:
            return [tensor]
        return list(tensor.reshape(self.batches, *tensor.shape[len(self.batch_dims) :]).unbind(0))

    def images(self, tensor: Tensor) -> list[Tensor]:
        """[..., C, *] as one [*] per image."""
        return list(tensor.reshape(self.count, *tensor.shape[len(self.batch_dims) + 1 :]).unbind(0))

    def dense(self, rows: list[Tensor], splats: list[ProjectedSplats]) -> Tensor:
        """Rows of the visible Gaussians of each image among all N, zeros elsewhere, [..., C, N, *]."""
        empty = rows[0].new_zeros(self.gaussians, *rows[0].shape[1:])
        filled = [empty.index_copy(0, p.index, row) for p, row in zip(splats, rows, strict=True)]
        return torch.stack(filled).reshape(*self.batch_dims, self.cameras, *empty.shape)


@dataclass(frozen=True, eq=False)
class SplatTable:
    """The visible splats of every image, laid out as the caller asked for."""

    images: Images
    splats: list[ProjectedSplats]
    packed: bool

    @property
    def device(self) -> torch.device:
        return self.splats[0].index.device

    @property
    def first_rows(self) -> list[int]:
        """First row of each image in the flattened table."""
        if not self.packed:
            return [i * self.images.gaussians for i in range(self.images.count)]
        first = [0]
        for p in self.splats[:-1]:
            first.append(first[-1] + len(p.index))
        return first

    def rows(self, i: int) -> Tensor:
        """Row of each splat of image i in the flattened table, int64 [V]."""
        index = self.splats[i].index
        return (torch.arange(len(index), device=self.device) if self.packed else index) + self.first_rows[i]

    def join(self, parts: list[Tensor]) -> Tensor:
        """One [V, *] per image as the table [nnz, *] or [..., C, N, *], zero where nothing is visible."""
        return torch.cat(parts) if self.packed else self.images.dense(parts, self.splats)

    def split(self, table: Tensor) -> list[Tensor]:
        """The table as one [V, *] per image; gradients pass through the table."""
        if self.packed:
            return list(table.split([len(p.index) for p in self.splats]))
        whole = self.images.images(table)
        return [select_rows(part, p.index) for part, p in zip(whole, self.splats, strict=True)]

    def ids(self) -> dict[str, Tensor | None]:
        """Scene, camera and Gaussian of each row, int64 [nnz]; None for a dense table."""
        if not self.packed:
            return {"batch_ids": None, "camera_ids": None, "gaussian_ids": None}
        image = torch.cat([torch.full_like(p.index, i) for i, p in enumerate(self.splats)])
        cameras = self.images.cameras
        index = torch.cat([p.index for p in self.splats])
        return {"batch_ids": image // cameras, "camera_ids": image % cameras, "gaussian_ids": index}

    def receive_absgrad(self, means2d: Tensor) -> list[Callable[[Tensor], None]]:
        """Give the table of centres an attribute `absgrad`, and for each image what writes its rows of it."""
        absolute = torch.zeros_like(means2d)
        means2d.absgrad = absolute  # type: ignore[attr-defined]
        flat = absolute.view(-1, 2)

        def receiver(rows: Tensor) -> Callable[[Tensor], None]:
            def write(values: Tensor) -> None:
                flat.index_copy_(0, rows, values.to(flat))

            return write

        return [receiver(self.rows(i)) for i in range(self.images.count)]


@dataclass(eq=False)
class ListTable:
    """The tile lists of every image, as one table.

    Attributes:
        table: What the rows of the lists refer to.
        width, height, tile_size: Of the images and tiles [pixels].
    """

    table: SplatTable
    width: int
    height: int
    tile_size: int

    def __post_init__(self) -> None:
        self.columns, self.height_in_tiles = -(-self.width // self.tile_size), -(-self.height // self.tile_size)
        self._keys: list[Tensor] = []
        self._rows: list[Tensor] = []
        self._offsets: list[Tensor] = []
        self._tiles: list[Tensor] = []
        self._total = 0

    def add(self, lists: TileLists) -> None:
        """Add the next image's lists; they may be scratch."""
        i = len(self._rows)
        p = self.table.splats[i]
        listed = listed_rows(lists).to(torch.int64)
        sizes = lists.offsets.diff()
        tile = torch.repeat_interleave(torch.arange(len(sizes), device=sizes.device), sizes, output_size=len(listed))
        bits = tile_bits(self.columns, self.height_in_tiles)
        self._keys.append(intersection_keys(torch.tensor(i, device=tile.device), tile, p.depths.detach()[listed], bits))
        self._rows.append(self.table.rows(i)[listed].to(torch.int32))
        self._offsets.append(lists.offsets[:-1] + self._total)
        counts = torch.zeros(len(p.index), dtype=torch.int32, device=tile.device)
        self._tiles.append(counts.index_copy_(0, lists.order.to(torch.int64), lists.entries.diff()))
        self._total += len(listed)

    def meta(self) -> dict[str, Any]:
        """The lists under gsplat's names."""
        images = self.table.images
        shape = (*images.batch_dims, images.cameras, self.height_in_tiles, self.columns)
        return {
            "tile_width": self.columns,
            "tile_height": self.height_in_tiles,
            "tiles_per_gauss": self.table.join(self._tiles),
            "isect_ids": torch.cat(self._keys),
            "flatten_ids": torch.cat(self._rows),
            "isect_offsets": torch.stack(self._offsets).reshape(shape),
            "width": self.width,
            "height": self.height,
            "tile_size": self.tile_size,
            "n_batches": images.batches,
            "n_cameras": images.cameras,
        }
