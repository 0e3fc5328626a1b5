"""The .splat files of antimatter15's viewer: 32 bytes a Gaussian, no header, colors of degree 0.

    3 x float32   position
    3 x float32   scales
    4 x uint8     red, green, blue, opacity
    4 x uint8     rotation (w, x, y, z), value * 128 + 128

Source: antimatter15/splat, convert.py, read for the layout only.
"""

from __future__ import annotations

import logging
import os

import numpy as np

from sgwarp.errors import InputError
from sgwarp.files.access import read_bytes
from sgwarp.files.atomic import atomic_path
from sgwarp.io.formats.axes import PLY_AXES, change_axes
from sgwarp.io.ply import build_gaussians, drawn_rows, host_arrays
from sgwarp.scene import Gaussians

ROW = np.dtype([("position", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])
SH_C0 = 0.28209479177387814  # constant of degree 0: color = SH_C0 c + 0.5


def read_splat(path: str | os.PathLike[str], axes: str = PLY_AXES) -> Gaussians:
    """Read a .splat scene.

    Raises:
        InputError: The file is missing, cut short, empty, or holds no scales.
    """
    data = read_bytes(path)
    if len(data) % ROW.itemsize or not data:
        raise InputError(
            f"{path}: {len(data)} bytes are not a number of rows of 32 bytes; not a .splat file, or cut short"
        )
    rows = np.frombuffer(data, ROW)
    scales = rows["scales"]
    if bool((scales < 0).any()):
        row = int((scales < 0).any(axis=1).argmax())
        raise InputError(f"{path}: row {row} has a negative scale; not a .splat file, or damaged")
    rgba = rows["rgba"].astype(np.float32) / 255
    quats = rows["rotation"].astype(np.float32) / 128 - 1
    sh = ((rgba[:, None, :3] - np.float32(0.5)) / np.float32(SH_C0)).astype(np.float32)
    # Exactly 0 on all four bytes has no direction: 128 of each.
    quats[~quats.any(axis=1)] = (1, 0, 0, 0)
    gaussians = build_gaussians(path, rows["position"], quats, scales, rgba[:, 3], sh)
    return change_axes(gaussians, axes, PLY_AXES)


def write_splat(gaussians: Gaussians, path: str | os.PathLike[str], axes: str = PLY_AXES) -> None:
    """Write a scene as .splat, in the order it has; only colors of degree 0 fit, which a logged notice says.

    Rows that are never rendered (NaN, infinity, a rotation of zero) are left out with another.

    Raises:
        InputError: The scene is empty or the file cannot be written.
    """
    gaussians = gaussians.subset(drawn_rows(path, gaussians))
    if gaussians.used_sh_degree:
        logging.getLogger("sgwarp").warning("%s: holds no view-dependent color; degree 1 and up are left out", path)
    means, quats, scales, opacities, sh = host_arrays(change_axes(gaussians, PLY_AXES, axes))
    rows = np.zeros(len(means), ROW)
    rows["position"], rows["scales"] = means, scales
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    unit = quats / norms
    rgba = np.concatenate([sh[:, 0] * SH_C0 + 0.5, opacities[:, None]], axis=1) * 255
    rows["rgba"] = np.rint(rgba).clip(0, 255)
    rows["rotation"] = np.rint(unit * 128 + 128).clip(0, 255)
    with atomic_path(path) as temporary:
        temporary.write_bytes(rows.tobytes())
