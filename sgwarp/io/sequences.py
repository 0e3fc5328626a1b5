"""Moving Gaussians, frame by frame: Dynamic3DGaussians' params.npz, or a folder of PLY files."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.io.archives import StackedArray, open_stacks
from sgwarp.io.compressed_ply import gaussians_from_packed, is_compressed
from sgwarp.io.ply import gaussians_from_elements, read_elements, say_coarse
from sgwarp.scene import Gaussians

SH_C0 = 0.28209479177387814  # of the constant harmonic
ID_COLUMNS = ("id", "gaussian_id", "point_id")
FOREGROUND_ABOVE = 0.5  # first channel of seg_colors


@dataclass(frozen=True, eq=False)
class Frame:
    """One moment of a sequence.

    Attributes:
        index: Its number, from 0.
        gaussians: The scene at that moment, possibly none at all.
        ids: Which Gaussian each row is, the same in every frame, int64 [N]. None: the file does not say; rows of two
            frames with the same number of rows then belong together.
        foreground: Gaussians of the moving objects by the file's own account, bool [N], or None.
    """

    index: int
    gaussians: Gaussians
    ids: Tensor | None = None
    foreground: Tensor | None = None


class GaussianSequence(Protocol):
    """Frames of a moving scene; one is in memory at a time."""

    def __len__(self) -> int: ...

    def frame(self, index: int) -> Frame:
        """Read frame `index`."""
        ...


def load_sequence(path: str | os.PathLike[str]) -> GaussianSequence:
    """Open a moving scene: params.npz of Dynamic3DGaussians, or a folder with one PLY file per frame.

    Nothing but headers is read. The files of a folder are ordered by the last number in their names. A PLY column
    `id`, `gaussian_id` or `point_id` says which Gaussian a row is; without one, rows belong together in file order as
    long as their number stays the same.

    Raises:
        InputError: Nothing of the kind is there, or an array is missing or has the wrong shape.
    """
    path = Path(path)
    if os.path.isdir(path):
        params = path / "params.npz"
        if params.is_file():
            return ParamsSequence(params)
        files = sorted(path.glob("*.ply"), key=_by_number)
        if not files:
            raise InputError(f"{path}: holds neither params.npz nor .ply files; give a sequence of frames")
        return PlySequence(files)
    if path.suffix == ".npz":
        return ParamsSequence(path)
    if path.suffix == ".ply":
        return PlySequence([path])
    if not os.path.exists(path):
        raise InputError(f"{path}: no such file or folder; check the path")
    raise InputError(f"{path}: is no sequence; expected params.npz of Dynamic3DGaussians or a folder of .ply files")


def is_sequence(path: str | os.PathLike[str]) -> bool:
    """Whether a path is one that `load_sequence` opens as more than a single PLY file."""
    path = Path(path)
    return path.suffix == ".npz" or path.is_dir()


def _by_number(path: Path) -> tuple[int, str]:
    numbers = re.findall(r"\d+", path.name)
    return int(numbers[-1]) if numbers else -1, path.name


class PlySequence:
    """One PLY file per frame."""

    def __init__(self, files: list[Path]) -> None:
        self.files = files

    def __len__(self) -> int:
        return len(self.files)

    def frame(self, index: int) -> Frame:
        """Read one file; one without rows is a frame without Gaussians.

        Raises:
            InputError: The file cannot be read, or its ids are not unique.
        """
        path = self.files[index]
        elements = dict(read_elements(path))
        vertex = elements.get("vertex")
        if is_compressed(elements):
            return Frame(index, gaussians_from_packed(path, elements))
        if vertex is not None and len(vertex) == 0:
            return Frame(index, no_gaussians())
        names = (vertex.dtype.names or ()) if vertex is not None else ()
        column = next((name for name in ID_COLUMNS if name in names), None)
        if vertex is None or column is None:
            return Frame(index, gaussians_from_elements(path, elements))
        ids = _unique_ids(path, column, np.asarray(vertex[column]))
        elements["vertex"] = _without(vertex, column)
        return Frame(index, gaussians_from_elements(path, elements), ids)


def _without(vertex: Any, column: str) -> Any:
    return vertex[[name for name in vertex.dtype.names if name != column]]


def _unique_ids(path: Path, column: str, values: Any) -> Tensor:
    if values.dtype.kind not in "iu":
        raise InputError(f"{path}: column '{column}' holds {values.dtype}, expected integers")
    ids = values.astype(np.int64)
    if len(np.unique(ids)) < len(ids):
        raise InputError(f"{path}: column '{column}' names a Gaussian twice; ids must be unique within a frame")
    return torch.from_numpy(ids)


def no_gaussians() -> Gaussians:
    """A scene without Gaussians."""
    empty = torch.empty
    return Gaussians(empty(0, 3), empty(0, 4), empty(0, 3), empty(0), empty(0, 1, 3))


MOVING = {"means3D": 3, "rgb_colors": 3, "unnorm_rotations": 4}  # [T, N, width]
STILL = {"logit_opacities": 1, "log_scales": 3}  # [N, width], or [T, N, width]


class ParamsSequence:
    """params.npz of Dynamic3DGaussians (Luiten et al. 2024): positions, colours and rotations per frame.

    Rows are the same Gaussian in all frames. Colours are constant harmonics, opacities logits, scales logarithms.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._arrays = open_stacks(path)
        missing = [name for name in (*MOVING, *STILL) if name not in self._arrays]
        if missing:
            raise InputError(f"{path}: lacks the arrays {', '.join(missing)} of a Dynamic3DGaussians params.npz")
        means = self._arrays["means3D"]
        if len(means.shape) != 3 or means.shape[2] != 3:
            raise InputError(f"{path}: array 'means3D' has shape {list(means.shape)}, expected [frames, N, 3]")
        self._frames, self._count = means.shape[:2]
        for name, width in MOVING.items():
            self._require(name, [(self._frames, self._count, width)])
        for name, width in STILL.items():
            self._require(name, [(self._count, width), (self._frames, self._count, width)])
        if "seg_colors" in self._arrays:
            self._require("seg_colors", [(self._count, 3)])
        self._still = {
            name: self._arrays[name].whole()
            for name in (*STILL, "seg_colors")
            if name in self._arrays and len(self._arrays[name].shape) == 2
        }

    def _require(self, name: str, shapes: list[tuple[int, ...]]) -> None:
        array = self._arrays[name]
        if array.shape not in shapes or array.dtype.kind != "f":
            wanted = " or ".join(str(list(shape)) for shape in shapes)
            raise InputError(
                f"{self.path}: array '{name}' is {array.dtype} of shape {list(array.shape)}, expected float {wanted}"
            )

    def __len__(self) -> int:
        return int(self._frames)

    def _row(self, name: str, index: int) -> Any:
        return self._still[name] if name in self._still else self._arrays[name].row(index)

    def frame(self, index: int) -> Frame:
        """Read one frame.

        Raises:
            InputError: The archive is damaged there.
        """
        means, rgb, quats, logits, log_scales = (self._row(name, index) for name in (*MOVING, *STILL))
        with np.errstate(over="ignore", invalid="ignore"):
            opacities = 1.0 / (1.0 + np.exp(-logits[:, 0].astype(np.float64)))
            scales = np.exp(log_scales.astype(np.float64))
            sh = (rgb.astype(np.float64) - 0.5) / SH_C0
        fields = (means, quats, scales, opacities, sh[:, None])
        tensors = [torch.from_numpy(np.array(field, dtype=np.float32, order="C")) for field in fields]
        if index == 0:  # of a sequence it is enough to say it once
            say_coarse(self.path, tensors[0].numpy(), tensors[2].numpy())
        foreground = None
        if "seg_colors" in self._still:
            foreground = torch.from_numpy(self._still["seg_colors"][:, 0] > FOREGROUND_ABOVE)
        return Frame(index, Gaussians(*tensors), None, foreground)


__all__ = ["Frame", "GaussianSequence", "ParamsSequence", "PlySequence", "StackedArray", "is_sequence", "load_sequence"]
