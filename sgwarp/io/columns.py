"""Columns of a PLY scene beyond its own, such as labels: read, and written back beside the Gaussians."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sgwarp.errors import InputError
from sgwarp.files.atomic import atomic_path
from sgwarp.io.compressed_ply import is_compressed
from sgwarp.io.ply import read_elements, write_elements, write_ply
from sgwarp.scene import Gaussians

OWN = re.compile(r"[xyz]|n[xyz]|f_dc_[012]|f_rest_\d+|opacity|scale_[012]|rot_[0123]")

Columns = Mapping[str, NDArray[Any]]


def read_columns(path: str | os.PathLike[str]) -> dict[str, NDArray[Any]]:
    """Columns of a PLY scene that are not those of the 3DGS reference implementation, [N] each; lists are left out.

    Raises:
        InputError: The file is missing, cut short, or no PLY file.
    """
    elements = read_elements(path)
    if is_compressed(elements) or "vertex" not in elements:
        return {}
    rows = elements["vertex"]
    names = [name for name in rows.dtype.names or () if not OWN.fullmatch(name)]
    return {name: np.array(rows[name]) for name in names if not rows.dtype[name].hasobject}


def write_with_columns(gaussians: Gaussians, path: str | os.PathLike[str], columns: Columns) -> None:
    """Write a scene as PLY with further columns behind those of the reference implementation.

    Raises:
        InputError: A column does not have one number per Gaussian, or the file cannot be written.
    """
    for name, column in columns.items():
        if column.shape != (len(gaussians),) or not np.issubdtype(column.dtype, np.number):
            raise InputError(f"{path}: column {name}: expected {len(gaussians)} numbers, got {list(column.shape)}")
    with atomic_path(path) as temporary:
        write_ply(gaussians, temporary)
        rows = read_elements(temporary)["vertex"]
        new = {name: column for name, column in columns.items() if name not in (rows.dtype.names or ())}
        kinds = [*rows.dtype.descr, *((name, column.dtype.newbyteorder("<").str) for name, column in new.items())]
        table = np.empty(len(rows), kinds)
        for name in rows.dtype.names or ():
            table[name] = rows[name]
        for name, column in new.items():
            table[name] = column
        del rows  # it is a view of the file that is replaced now
        write_elements(temporary, {"vertex": table})
