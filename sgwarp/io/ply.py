"""3D Gaussian scenes as PLY files with the columns of the 3DGS reference implementation (Kerbl et al. 2023).

The only module that imports plyfile (GPLv3).
"""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sgwarp.errors import InputError
from sgwarp.files.access import reading
from sgwarp.files.atomic import atomic_path
from sgwarp.io.ply_header import check_ply
from sgwarp.scene import SH_COUNTS, Gaussians

Elements = Mapping[str, NDArray[Any]]  # element name -> structured array, one field per property

POSITION = ("x", "y", "z")
NORMAL = ("nx", "ny", "nz")
COLOUR = ("f_dc_0", "f_dc_1", "f_dc_2")
SCALE = ("scale_0", "scale_1", "scale_2")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
REST_COUNTS = tuple(3 * (k - 1) for k in SH_COUNTS)  # 0, 9, 24, 45

# Below the logarithm of the smallest float32 (1.4e-45, -103.3): exp() and sigmoid() of it are exactly 0 again.
LOG_ZERO = -110.0
ROWS_PER_BLOCK = 16384  # a block of 62 columns fits the cache, so that rows are fetched from memory once


def read_elements(path: str | os.PathLike[str]) -> Elements:
    """Read any PLY file (ascii or binary, either byte order) into one structured array per element.

    Binary elements without lists are memory-mapped, not loaded.

    Raises:
        InputError: The file is missing, not a PLY file, or cut short.
    """
    plyfile = _plyfile(path)
    check_ply(path)
    try:
        with reading(path), np.errstate(over="ignore"):
            content = plyfile.PlyData.read(os.fspath(path))
    except plyfile.PlyElementParseError as error:
        element = error.element
        if "end-of-file" not in error.message:
            raise InputError(f"{path}: {error}; the file is damaged, write it again") from None
        size = f"{element.count} rows"
        if not any(isinstance(p, plyfile.PlyListProperty) for p in element.properties):
            size += f" ({element.count * element.dtype().itemsize} bytes in binary)"
        raise InputError(
            f"{path}: is cut short: element '{element.name}' should hold {size}, the file ends after "
            f"{error.row or 0} rows ({os.path.getsize(path)} bytes in all); copy or download it again"
        ) from None
    except InputError:  # of `reading`, which says it all; it is a ValueError as well
        raise
    except (plyfile.PlyParseError, ArithmeticError, LookupError, MemoryError, TypeError, ValueError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: is not a valid PLY file ({reason})") from None
    return {element.name: element.data for element in content.elements}


def write_elements(path: str | os.PathLike[str], elements: Elements, comment: str | None = None) -> None:
    """Write structured arrays as a binary little-endian PLY file."""
    plyfile = _plyfile(path)
    described = [plyfile.PlyElement.describe(rows, name) for name, rows in elements.items()]
    content = plyfile.PlyData(described, text=False, byte_order="<", comments=[comment] if comment else [])
    with atomic_path(path) as temporary:
        content.write(os.fspath(temporary))


def _plyfile(path: str | os.PathLike[str]) -> Any:
    try:
        import plyfile
    except ImportError:
        raise InputError(f"{path}: PLY files need plyfile, which is under the GPL: pip install plyfile") from None
    return plyfile


def gaussians_from_elements(path: str | os.PathLike[str], elements: Elements) -> Gaussians:
    """Interpret the columns of the reference implementation; see `read_ply`."""
    vertex = elements.get("vertex")
    if vertex is None:
        raise InputError(f"{path}: has no element 'vertex' (it has: {', '.join(elements) or 'none'}); not a 3DGS scene")
    names = vertex.dtype.names or ()
    needed = (*POSITION, *COLOUR, "opacity", *SCALE, *ROTATION)
    missing = [name for name in needed if name not in names]
    if set(missing) >= {*COLOUR, "opacity", *SCALE, *ROTATION}:
        raise InputError(f"{path}: is a point cloud or mesh, not a 3DGS scene: no columns {', '.join(missing)}")
    if missing:
        raise InputError(f"{path}: lacks the columns {', '.join(missing)} of a 3DGS scene")
    rest = sum(re.fullmatch(r"f_rest_\d+", name) is not None for name in names)
    rest_names = tuple(f"f_rest_{i}" for i in range(rest))
    if rest not in REST_COUNTS or not set(rest_names) <= set(names):
        raise InputError(
            f"{path}: has {rest} columns f_rest_*, expected none, or f_rest_0 up to f_rest_8, 23 or 44 (degree 1 to 3)"
        )
    if len(vertex) == 0:
        raise InputError(f"{path}: has no Gaussians (element 'vertex' has 0 rows)")
    extra = [name for name in names if name not in {*needed, *rest_names, *NORMAL}]
    if extra:
        logging.getLogger("sgwarp").warning("%s: columns left out: %s", path, ", ".join(extra))
    values = columns(path, vertex, (*needed, *rest_names))
    means, dc, logits, log_scales, quats, sh_rest = np.split(values, np.cumsum([3, 3, 1, 3, 4]), axis=1)
    # The file holds all coefficients of red, then all of green, then all of blue.
    sh = np.concatenate([dc[:, None, :], sh_rest.reshape(len(values), 3, rest // 3).transpose(0, 2, 1)], axis=1)
    with np.errstate(over="ignore", invalid="ignore"):
        opacities = 1.0 / (1.0 + np.exp(-logits[:, 0].astype(np.float64)))
        scales = np.exp(log_scales.astype(np.float64)).astype(np.float32)
    return build_gaussians(path, means, quats, scales, opacities.astype(np.float32), sh)


def read_ply(path: str | os.PathLike[str]) -> Gaussians:
    """Read a 3DGS scene, ascii or binary, columns in any order and of any scalar type.

    Columns x y z, f_dc_0..2, opacity (logit), scale_0..2 (logarithm), rot_0..3 (w, x, y, z) are required; the number
    of f_rest_* columns (0, 9, 24, 45) gives the SH degree. Normals are ignored; other columns are left out with a
    logged notice. Rows with NaN or infinity are kept, with a logged notice of how many there are.

    Raises:
        InputError: The file is missing, cut short, no 3DGS scene, or empty.
    """
    return gaussians_from_elements(path, read_elements(path))


def write_ply(gaussians: Gaussians, path: str | os.PathLike[str]) -> None:
    """Write a scene with the columns of the reference implementation, binary little-endian float32.

    Opacities 0 and 1 become logits -110 and 110 and a scale of 0 the logarithm -110, which read back exactly; all
    other values read back to a relative 1e-6.

    Raises:
        InputError: The scene is empty or the file cannot be written.
    """
    if len(gaussians) == 0:
        raise InputError(f"{path}: not written, the scene has no Gaussians")
    means, quats, scales, opacities, sh = host_arrays(gaussians)
    rest = 3 * (sh.shape[1] - 1)
    names = (*POSITION, *NORMAL, *COLOUR, *(f"f_rest_{i}" for i in range(rest)), "opacity", *SCALE, *ROTATION)
    with np.errstate(divide="ignore", invalid="ignore"):
        o = opacities.astype(np.float64)
        logits = np.clip(np.log(o) - np.log1p(-o), LOG_ZERO, -LOG_ZERO)[:, None]
        log_scales = np.maximum(np.log(scales.astype(np.float64)), LOG_ZERO)
    sh_rest = sh[:, 1:].transpose(0, 2, 1).reshape(len(sh), rest)
    parts = (means, np.zeros_like(means), sh[:, 0], sh_rest, logits, log_scales, quats)
    table = np.concatenate([part.astype("<f4") for part in parts], axis=1)
    rows = table.view([(name, "<f4") for name in names]).reshape(-1)
    write_elements(path, {"vertex": rows})


def columns(path: str | os.PathLike[str], rows: NDArray[Any], names: Sequence[str]) -> NDArray[np.float32]:
    """Gather the named columns as float32 [N, len(names)]; a list column is an InputError."""
    lists = [name for name in names if rows.dtype[name].hasobject]
    if lists:
        raise InputError(f"{path}: column {lists[0]} holds lists, expected one number per row")
    values = np.empty((len(rows), len(names)), dtype=np.float32)
    # A double beyond float32 becomes infinity, a signalling NaN a quiet one: both are counted as non-finite.
    with np.errstate(over="ignore", invalid="ignore"):
        for start in range(0, len(rows), ROWS_PER_BLOCK):
            block = rows[start : start + ROWS_PER_BLOCK]
            for j, name in enumerate(names):
                values[start : start + len(block), j] = block[name]
    return values


def build_gaussians(path: str | os.PathLike[str], *fields: NDArray[np.float32]) -> Gaussians:
    """Gaussians from arrays in the order of its fields; says how many rows are not finite."""
    gaussians = Gaussians(*(torch.from_numpy(np.ascontiguousarray(field)) for field in fields))
    if gaussians.non_finite:
        logging.getLogger("sgwarp").warning(
            "%s: %d of %d Gaussians hold NaN or infinity; they are kept, and never rendered",
            path,
            gaussians.non_finite,
            len(gaussians),
        )
    return gaussians


def host_arrays(gaussians: Gaussians) -> tuple[NDArray[np.float32], ...]:
    """means, quats, scales, opacities, sh as NumPy arrays."""
    fields = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    return tuple(field.detach().cpu().numpy() for field in fields)
