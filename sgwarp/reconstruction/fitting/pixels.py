"""Pixels of many photographs: in memory while they are few, else in a file, and read when they are looked at."""

from __future__ import annotations

import os
import tempfile
import weakref
from typing import Any

import numpy as np
import torch
from torch import Tensor

IN_MEMORY = 2**30  # bytes of photographs that are kept in memory


class PixelStore:
    """Takes arrays of bytes, and gives a tensor of each when asked.

    What does not fit in memory goes into one temporary file without a name, which is gone when the process ends.
    """

    def __init__(self, device: str | torch.device = "cpu", in_memory: int = IN_MEMORY) -> None:
        self.device = torch.device(device)
        self.left = in_memory
        self.file: Any = None

    def put(self, pixels: np.ndarray) -> StoredPixels | Tensor:
        """Keep an image or what belongs to it, uint8 [H, W, 3] or [H, W]."""
        if pixels.nbytes <= self.left:
            self.left -= pixels.nbytes
            return torch.from_numpy(np.ascontiguousarray(pixels)).to(self.device)
        if self.file is None:
            self.file = tempfile.TemporaryFile(prefix="sgwarp-")  # noqa: SIM115 (open as long as the photographs are)
            weakref.finalize(self, self.file.close)
        place = self.file.seek(0, os.SEEK_END)
        self.file.write(np.ascontiguousarray(pixels).tobytes())
        return StoredPixels(self, place, pixels.shape)


class StoredPixels:
    """An image in the file of its store."""

    def __init__(self, store: PixelStore, place: int, shape: tuple[int, ...]) -> None:
        self.store, self.place, self.shape = store, place, shape

    def read(self) -> Tensor:
        """uint8 of its shape, on the device of the store."""
        self.store.file.seek(self.place)
        data = bytearray(self.store.file.read(int(np.prod(self.shape))))
        return torch.frombuffer(data, dtype=torch.uint8).reshape(self.shape).to(self.store.device)
