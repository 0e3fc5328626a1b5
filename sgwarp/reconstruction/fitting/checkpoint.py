"""Checkpoints: everything a run needs to go on as if it had never stopped."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.files.inputs import own_files
from sgwarp.files.torch_files import load_torch, save_torch
from sgwarp.reconstruction.fitting.photographs import Photograph
from sgwarp.reconstruction.fitting.settings import FitSettings
from sgwarp.scene import SH_COUNTS

FORMAT = 2
GROUPS = ("model", "strategy", "exposure", "poses")
PARTS = ("parameters", "first", "second", "values")


@dataclass(eq=False)
class Checkpoint:
    """A run between two steps.

    Attributes:
        settings: Of the run.
        photographs: Fingerprint of what it is fitted to.
        step: How many steps have been taken; random numbers and the order of the views follow from it and the seed.
        seconds: Spent on them.
        model, strategy, exposure, poses: Tensors by name.
        curve: Measurements so far, rows of numbers.
    """

    settings: dict[str, Any]
    photographs: str
    step: int
    seconds: float
    model: dict[str, Tensor]
    strategy: dict[str, Tensor]
    exposure: dict[str, Tensor]
    poses: dict[str, Tensor]
    curve: list[list[float]]

    def save(self, path: Path) -> None:
        """Write it, whole or not at all."""
        content = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        save_torch(path, {"format": FORMAT, **content})

    def _check(self, path: Path) -> None:
        """Refuse a file that was not written by `save`, whatever it names its parts."""
        groups = all(_named_tensors(getattr(self, name)) for name in GROUPS)
        numbers = type(self.step) is int and self.step >= 0 and isinstance(self.seconds, (int, float))
        rows = isinstance(self.curve, list) and all(isinstance(row, list) for row in self.curve)
        if not (groups and numbers and rows and self.curve and isinstance(self.settings, dict)) or not _fits(
            self.model
        ):
            raise InputError(f"{path}: is not a checkpoint, or is damaged; start again without --resume")

    def _move(self, device: torch.device) -> None:
        for name in GROUPS:
            setattr(self, name, {key: tensor.to(device) for key, tensor in getattr(self, name).items()})

    @classmethod
    def load(cls, path: Path, settings: FitSettings, photographs: str, device: torch.device) -> Checkpoint:
        """Read the checkpoint of a run of these settings on these photographs.

        Raises:
            InputError: The file is missing or damaged, or belongs to another run.
        """
        try:
            with own_files():
                content = load_torch(path)
        except InputError:
            if not path.is_file():
                raise
            raise InputError(f"{path}: is not a checkpoint, or is damaged; start again without --resume") from None
        names = {field.name for field in dataclasses.fields(cls)}
        if not isinstance(content, dict) or content.pop("format", None) != FORMAT or set(content) != names:
            raise InputError(f"{path}: was written by another version; start again without --resume")
        checkpoint = cls(**content)
        checkpoint._check(path)
        checkpoint._move(device)
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


def _named_tensors(group: Any) -> bool:
    return isinstance(group, dict) and all(isinstance(value, Tensor) for value in group.values())


def _fits(model: dict[str, Tensor]) -> bool:
    """Whether everything has a row for each Gaussian: kernels do not look."""
    count = len(model["steps"]) if "steps" in model and model["steps"].ndim == 1 else -1
    for name in ("steps", "skipped"):
        if name not in model or model[name].shape != (count,) or model[name].dtype != torch.int32:
            return False
    sh = model.get("sh.parameters")
    if sh is None or sh.ndim != 3 or sh.shape[1] not in SH_COUNTS:
        return False
    shapes = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh": (sh.shape[1], 3)}
    parts = {f"{name}.{part}": shape for name, shape in shapes.items() for part in PARTS}
    found = {name: model.get(name) for name in parts}
    return all(
        tensor is not None and tensor.dtype == torch.float32 and tensor.shape == (count, *parts[name])
        for name, tensor in found.items()
    )


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
