"""SceneSplat-7K and -49K: trained scenes as one .npy file per field, with language features.

| file, below {scene} | holds |
|---|---|
| coord.npy, scale.npy, quat.npy | float [N, 3] [m], standard deviations [N, 3] [m], (w, x, y, z) [N, 4] |
| opacity.npy, color.npy | [N] or [N, 1] in 0 to 1; uint8 [N, 3] |
| lang_feat.npy, valid_feat_mask.npy | features [M, C] of the Gaussians with a feature, or of all; which have one [N] |
| segment.npy | class of each Gaussian, -1 where there is none, [N] |

Scenes lie in the root or in its folders train, val and test. Opacity, scale and color are ready for use: neither logits
nor logarithms nor harmonics.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sgwarp.datasets.base import LabelledPoints, SceneData, absent, folders_in, require_scene
from sgwarp.errors import InputError
from sgwarp.files.arrays import read_array
from sgwarp.scene import Gaussians, Semantics

NAME = "scenesplat"
ABOUT = "SceneSplat: {scene}/coord, color, opacity, quat, scale, lang_feat, valid_feat_mask .npy"
FIELDS = ("coord.npy", "color.npy", "opacity.npy", "quat.npy", "scale.npy")
SPLITS = ("train", "val", "test")
SH_C0 = 0.28209479177387814  # of the constant harmonic
SPACE = "siglip2-base-patch16:768"  # SceneSplat's own features; another width is another space


def list_scenes(root: Path) -> list[str]:
    """Folders with coord.npy, with their split."""
    found = [folder.name for folder in folders_in(root) if (folder / FIELDS[0]).is_file()]
    for split in SPLITS:
        if (root / split).is_dir():
            found += [f"{split}/{folder.name}" for folder in folders_in(root / split) if (folder / FIELDS[0]).is_file()]
    return found


def open_scene(root: Path, name: str) -> SceneData:
    """A scene, without views.

    Raises:
        InputError: There is none of that name.
    """
    require_scene(root, name, list_scenes(root))
    folder = root / name
    missing = absent(folder, (*FIELDS, "lang_feat.npy", "valid_feat_mask.npy", "segment.npy"))
    has_labels = (folder / "segment.npy").is_file()
    return SceneData(
        name, folder, 0, missing, load_points=(lambda: read_points(folder)) if has_labels else None, gaussians=folder
    )


def read_gaussians(folder: Path) -> Gaussians:
    """The Gaussians of a scene.

    Raises:
        InputError: A field is missing or has another shape.
    """
    coord = _field(folder, "coord", 3)
    color = _field(folder, "color", 3, len(coord))
    if color.dtype != np.uint8:
        raise InputError(f"{folder}/color.npy: expected uint8 [N, 3], got {color.dtype}; SceneSplat stores bytes")
    fields = {
        name: _field(folder, name, width, len(coord)) for name, width in (("quat", 4), ("scale", 3), ("opacity", 1))
    }
    sh = ((color.astype(np.float32) / 255.0) - 0.5) / SH_C0
    try:
        return Gaussians(
            means=torch.from_numpy(coord.astype(np.float32)),
            quats=torch.from_numpy(fields["quat"].astype(np.float32)),
            scales=torch.from_numpy(fields["scale"].astype(np.float32)),
            opacities=torch.from_numpy(fields["opacity"].astype(np.float32)[:, 0]),
            sh=torch.from_numpy(sh[:, None]),
        )
    except InputError as error:
        raise InputError(f"{folder}: {error}") from None


def read_semantics(folder: Path, gaussians: Gaussians, space: str | None = None) -> Semantics:
    """The language features of a scene, zero where a Gaussian has none.

    Args:
        folder: Of the scene.
        gaussians: As `read_gaussians` gives them.
        space: Of the features; SceneSplat's own for 768 channels if None.

    Raises:
        InputError: There are none, or not as many as the mask says.
    """
    features = read_array(folder / "lang_feat.npy")
    count = len(gaussians)
    valid = np.ones(count, dtype=bool)
    if (folder / "valid_feat_mask.npy").is_file():
        valid = _field(folder, "valid_feat_mask", 1, count)[:, 0] != 0
    if features.ndim != 2 or features.dtype.kind != "f" or len(features) not in (count, int(valid.sum())):
        wanted = f"{count} or {int(valid.sum())} rows, as valid_feat_mask.npy says"
        raise InputError(f"{folder}/lang_feat.npy: is {features.dtype} {list(features.shape)}; expected {wanted}")
    rows = torch.zeros(count, features.shape[1], dtype=torch.float16 if features.dtype == np.float16 else torch.float32)
    known = torch.from_numpy(valid)
    values = torch.from_numpy(np.ascontiguousarray(features)).to(rows.dtype)
    rows[known] = values[known] if len(features) == count else values
    weight = known.to(torch.float32)
    named = space or (SPACE if features.shape[1] == 768 else f"scenesplat:{features.shape[1]}")
    return Semantics(rows, weight, weight.clone(), named, gaussians.fingerprint)


def read_points(folder: Path) -> LabelledPoints:
    """Centers of the Gaussians with their classes."""
    coord = _field(folder, "coord", 3)
    labels = _field(folder, "segment", 1, len(coord))[:, 0]
    return LabelledPoints(torch.from_numpy(coord.astype(np.float32)), torch.from_numpy(labels.astype(np.int64)))


def _field(folder: Path, name: str, width: int, count: int | None = None) -> NDArray[Any]:
    """A field, [N, width]."""
    array = read_array(folder / f"{name}.npy")
    array = array[:, None] if array.ndim == 1 and width == 1 else array
    if array.ndim != 2 or array.shape[1] != width or (count is not None and len(array) != count):
        rows = "N" if count is None else count
        raise InputError(f"{folder}/{name}.npy: expected [{rows}, {width}], got {list(array.shape)}")
    return array
