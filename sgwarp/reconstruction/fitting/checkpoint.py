"""Checkpoints: everything a run needs to go on as if it had never stopped."""

from __future__ import annotations

import dataclasses
import hashlib
import pickle
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.files.access import reading
from sgwarp.files.atomic import atomic_path
from sgwarp.reconstruction.fitting.photographs import Photograph
from sgwarp.reconstruction.fitting.settings import FitSettings

FORMAT = 1


@dataclass(eq=False)
class Checkpoint:
    """A run between two steps.

    Attributes:
        settings: Of the run.
        photographs: Fingerprint of what it is fitted to.
        step: How many steps have been taken; random numbers and the order of the views follow from it and the seed.
        seconds: Spent on them.
        model, strategy, exposure: Tensors by name.
        curve: Measurements so far, rows of numbers.
    """

    settings: dict[str, Any]
    photographs: str
    step: int
    seconds: float
    model: dict[str, Tensor]
    strategy: dict[str, Tensor]
    exposure: dict[str, Tensor]
    curve: list[list[float]]

    def save(self, path: Path) -> None:
        """Write it, whole or not at all."""
        content = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        with atomic_path(path) as temporary:
            torch.save({"format": FORMAT, **content}, temporary)

    @classmethod
    def load(cls, path: Path, settings: FitSettings, photographs: str, device: torch.device) -> Checkpoint:
        """Read the checkpoint of a run of these settings on these photographs.

        Raises:
            InputError: The file is missing or damaged, or belongs to another run.
        """
        with reading(path):
            try:
                content = torch.load(path, map_location=device, weights_only=True)
            except (RuntimeError, EOFError, ValueError, KeyError, pickle.UnpicklingError, struct.error):
                raise InputError(f"{path}: is not a checkpoint, or is damaged; start again without --resume") from None
        names = {field.name for field in dataclasses.fields(cls)}
        if not isinstance(content, dict) or content.pop("format", None) != FORMAT or set(content) != names:
            raise InputError(f"{path}: was written by another version; start again without --resume")
        checkpoint = cls(**content)
        for name, value in dataclasses.asdict(settings).items():
            if checkpoint.settings.get(name) != value:
                was = checkpoint.settings.get(name)
                raise InputError(
                    f"{path}: that run had {name} = {was}, this one {value}; give the same, or start again without "
                    "--resume"
                )
        if checkpoint.photographs != photographs:
            raise InputError(f"{path}: that run had other photographs or cameras; start again without --resume")
        return checkpoint


def fingerprint(photographs: Sequence[Photograph], held_out: Sequence[Photograph]) -> str:
    """Hash of pixels, masks and cameras, 16 hex digits."""
    digest = hashlib.sha256()
    for group in (photographs, held_out):
        digest.update(len(group).to_bytes(4, "little"))
        for photograph in group:
            camera = photograph.camera
            digest.update(photograph.pixels.cpu().numpy().tobytes())
            digest.update(camera.K.numpy().tobytes() + camera.world_to_camera.numpy().tobytes())
            if photograph.mask is not None:
                digest.update(photograph.mask.cpu().numpy().tobytes())
    return digest.hexdigest()[:16]
