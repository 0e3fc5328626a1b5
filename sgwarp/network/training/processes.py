"""One training run on one process or, under torchrun, on several."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
import torch.distributed as dist
from torch import Tensor

from sgwarp.errors import InputError


@dataclass(frozen=True)
class Processes:
    """Rank of this process and number of all; with one process every method leaves things as they are."""

    rank: int = 0
    count: int = 1

    @property
    def leads(self) -> bool:
        """Whether this process writes the files and shows the progress."""
        return self.rank == 0

    def add_up(self, tensors: Iterable[Tensor]) -> None:
        """Replace tensors of one type by their sums over the processes, all in one message."""
        if self.count == 1:
            return
        together = list(tensors)
        flat = torch.cat([tensor.detach().flatten() for tensor in together])
        dist.all_reduce(flat)
        for tensor, part in zip(together, flat.split([t.numel() for t in together]), strict=True):
            tensor.detach().copy_(part.view_as(tensor))


@contextmanager
def joined(device: str) -> Iterator[Processes]:
    """The processes that torchrun started, or this one alone.

    Raises:
        InputError: There are several, and the device is one of them all.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield Processes()
        return
    if device.startswith("cuda:"):
        raise InputError(f"device {device}: several processes take one device each; name plain cuda")
    if device == "cuda":
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
    dist.init_process_group("nccl" if device == "cuda" else "gloo")
    try:
        yield Processes(dist.get_rank(), dist.get_world_size())
    finally:
        dist.destroy_process_group()
