"""Gaussian scenes in whatever format a file holds."""

from __future__ import annotations

import os

from sgwarp.errors import InputError
from sgwarp.io.compressed_ply import gaussians_from_packed, is_compressed, write_compressed_ply
from sgwarp.io.ply import gaussians_from_elements, read_elements, write_ply
from sgwarp.scene import Gaussians


def load_gaussians(path: str | os.PathLike[str]) -> Gaussians:
    """Read a scene: PLY of the 3DGS reference implementation or PlayCanvas compressed PLY, told apart by the header.

    Raises:
        InputError: The file is missing, cut short, holds no Gaussians, or columns are missing.
    """
    elements = read_elements(path)
    if is_compressed(elements):
        return gaussians_from_packed(path, elements)
    return gaussians_from_elements(path, elements)


def save_gaussians(gaussians: Gaussians, path: str | os.PathLike[str]) -> None:
    """Write a scene; a name ending in .compressed.ply chooses the PlayCanvas format, .ply the reference columns.

    The compressed format is lossy and changes the order of the Gaussians; see `write_compressed_ply`.

    Raises:
        InputError: The name ends in something else, the scene is empty, or the file cannot be written.
    """
    name = os.fspath(path).lower()
    if not name.endswith(".ply"):
        raise InputError(f"{path}: scenes are written as .ply or .compressed.ply; change the name")
    if name.endswith(".compressed.ply"):
        write_compressed_ply(gaussians, path)
    else:
        write_ply(gaussians, path)
