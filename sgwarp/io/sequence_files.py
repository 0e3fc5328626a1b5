"""Writing moving scenes in the layout that Dynamic3DGaussians publishes: params.npz and {train,test}_meta.json."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.files.atomic import atomic_path
from sgwarp.io.sequences import SH_C0
from sgwarp.scene import Gaussians, View

LOG_ZERO = -110.0  # below the logarithm of the smallest float32


def write_params(path: str | os.PathLike[str], frames: Sequence[Gaussians], foreground: Tensor | None = None) -> None:
    """Write params.npz: means3D, rgb_colors, unnorm_rotations per frame; opacities and scales of the first.

    Args:
        path: Name ending in .npz.
        frames: The scene at every frame; rows are the same Gaussians, opacities and scales stay.
        foreground: Gaussians of the moving objects, bool [N]; goes into seg_colors.

    Raises:
        InputError: There are no frames, they differ in size, or opacities or scales change.
    """
    path = Path(path)
    if not frames or path.suffix != ".npz":
        raise InputError(f"{path}: a sequence needs frames and a name ending in .npz")
    first = frames[0]
    for index, frame in enumerate(frames):
        same = len(frame) == len(first)
        if not same or not (frame.scales.equal(first.scales) and frame.opacities.equal(first.opacities)):
            raise InputError(f"{path}: frame {index} has other Gaussians, scales or opacities than frame 0")
    n = len(first)
    opacities = first.opacities.cpu().numpy().astype(np.float64)
    with np.errstate(divide="ignore"):
        logits = np.clip(np.log(opacities) - np.log1p(-opacities), LOG_ZERO, -LOG_ZERO)
        log_scales = np.maximum(np.log(first.scales.cpu().numpy().astype(np.float64)), LOG_ZERO)
    seg = np.zeros((n, 3), np.float32)
    moves = np.ones(n, bool) if foreground is None else foreground.cpu().numpy()
    seg[:, 0], seg[:, 2] = moves, ~moves
    arrays = {
        "means3D": _stack([frame.means for frame in frames]),
        "rgb_colors": _stack([frame.sh[:, 0] * SH_C0 + 0.5 for frame in frames]),
        "unnorm_rotations": _stack([frame.quats for frame in frames]),
        "seg_colors": seg,
        "logit_opacities": logits[:, None].astype(np.float32),
        "log_scales": log_scales.astype(np.float32),
        "cam_m": np.zeros((50, 3), np.float32),
        "cam_c": np.zeros((50, 3), np.float32),
    }
    with atomic_path(path) as temporary:
        np.savez(temporary, **arrays)


def _stack(parts: Sequence[Tensor]) -> NDArray[np.float32]:
    return np.stack([part.detach().cpu().numpy() for part in parts]).astype(np.float32)


def write_meta(path: str | os.PathLike[str], views: Sequence[View], frames: int, suffix: str = ".jpg") -> None:
    """Write {split}_meta.json of cameras that stay; photographs are named {stem}/{frame:06d}{suffix}.

    Raises:
        InputError: There are no views, or they differ in size.
    """
    path = Path(path)
    if not views or any(view.camera.size != views[0].camera.size for view in views):
        raise InputError(f"{path}: needs views, all of one size")
    height, width = views[0].camera.size
    names = [int(view.stem) if view.stem.isdecimal() else view.stem for view in views]
    meta = {
        "w": width,
        "h": height,
        "k": [[view.camera.K.tolist() for view in views]] * frames,
        "w2c": [[view.camera.world_to_camera.tolist() for view in views]] * frames,
        "fn": [[f"{view.stem}/{frame:06d}{suffix}" for view in views] for frame in range(frames)],
        "cam_id": [names] * frames,
    }
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(meta), encoding="utf-8")
