"""3D Gaussian scenes as PLY files with the columns of the 3DGS reference implementation (Kerbl et al. 2023).

The only module that imports plyfile (GPLv3).
"""

from __future__ import annotations

import io
import logging
import math
import os
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sgwarp.errors import InputError
from sgwarp.files.access import open_input, reading
from sgwarp.files.atomic import atomic_path
from sgwarp.io.colors import rgb_names, unit_colors
from sgwarp.io.formats.foreign import describe_ply
from sgwarp.io.ply_header import check_ply, tidied
from sgwarp.scene import SH_COUNTS, Gaussians

Elements = Mapping[str, NDArray[Any]]  # element name -> structured array, one field per property

POSITION = ("x", "y", "z")
NORMAL = ("nx", "ny", "nz")
COLOUR = ("f_dc_0", "f_dc_1", "f_dc_2")
SCALE = ("scale_0", "scale_1", "scale_2")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
FILTER = "filter_3D"  # of Mip-Splatting, a standard deviation
SH_C0 = 0.28209479177387814  # constant of degree 0: color = SH_C0 f_dc + 0.5
REST_COUNTS = tuple(3 * (k - 1) for k in SH_COUNTS)  # 0, 9, 24, 45

# Below the logarithm of the smallest float32 (1.4e-45, -103.3): exp() and sigmoid() of it are exactly 0 again.
LOG_ZERO = -110.0
SAMPLED, COARSE = 16, 0.2  # every so many rows are looked at; steps of float32 that matter [size of a Gaussian]
MIN_NORM = 1e-3  # a shorter quaternion has no direction; the renderer leaves it out, too
KNOWN = re.compile(r"[xyz]|n[xyz]|red|green|blue|opacity|scale_\d|rot_\d|f_dc_\d|f_rest_\d+")  # names of columns
ROWS_PER_BLOCK = 16384  # a block of 62 columns fits the cache, so that rows are fetched from memory once


def read_elements(path: str | os.PathLike[str]) -> Elements:
    """Read any PLY file (ascii or binary, either byte order) into one structured array per element.

    The file is read, not mapped: one that shrinks under a mapping ends the process (SIGBUS).

    Raises:
        InputError: The file is missing, not a PLY file, or cut short.
    """
    check_ply(path)
    try:
        return _parse(path, os.fspath(path))
    except InputError:
        # plyfile knows comments in ASCII alone, obj_info at the top alone, and no blank lines.
        tidy = tidied(path)
        if tidy is None:
            raise
    return _parse(path, io.BytesIO(tidy))


def _parse(path: str | os.PathLike[str], source: str | io.BytesIO) -> Elements:
    """The elements of a path, or of its content."""
    plyfile = _plyfile(path)
    try:
        with reading(path), np.errstate(over="ignore"):
            content = plyfile.PlyData.read(source)
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
        if unknown := re.search(r"line (\d+): field type '(.*?)' not in", reason):
            raise InputError(
                f"{path}: is not a valid PLY file (line {unknown[1]}: PLY has no type {unknown[2][:40]!r}); write "
                "these numbers as float"
            ) from None
        raise InputError(f"{path}: is not a valid PLY file ({reason})") from None
    elements = {element.name: _loaded(path, element.data) for element in content.elements}
    return elements | {"vertex": _in_lower_case(elements["vertex"])} if "vertex" in elements else elements


def _in_lower_case(rows: Any) -> Any:
    """Rows whose known columns are called as usual: some programs write X, Y, Z and Opacity."""
    names = rows.dtype.names or ()
    folded = Counter(name.lower() for name in names)
    usual = {name: name.lower() for name in names if folded[name.lower()] == 1 and KNOWN.fullmatch(name.lower())}
    renamed = [usual.get(name, name) for name in names]
    if renamed == list(names) or rows.dtype.hasobject:
        return rows
    kinds, places = zip(*((rows.dtype.fields[name][0], rows.dtype.fields[name][1]) for name in names), strict=True)
    described: Any = {"names": renamed, "formats": kinds, "offsets": places, "itemsize": rows.dtype.itemsize}
    return rows.view(np.dtype(described))


def _loaded(path: str | os.PathLike[str], rows: NDArray[Any]) -> NDArray[Any]:
    """Rows that plyfile has mapped, none of which has been looked at, read from where they lie."""
    if not isinstance(rows, np.memmap):
        return rows
    with open_input(path) as file:
        file.seek(rows.offset)
        loaded = np.fromfile(file, rows.dtype, len(rows))
    if len(loaded) < len(rows):
        raise InputError(f"{path}: is cut short ({len(loaded)} of {len(rows)} rows); copy or download it again")
    return loaded


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
    if foreign := describe_ply(names, elements):
        raise InputError(f"{path}: {foreign}")
    rgb = None if set(COLOUR) <= set(names) else rgb_names(names)
    flat = "scale_2" not in names and {"scale_0", "scale_1"} <= set(names)
    shape = SCALE[:2] if flat else SCALE
    needed = (*POSITION, "opacity", *shape, *ROTATION)
    missing = [name for name in (*needed, *(rgb or COLOUR)) if name not in names]
    if missing:
        raise InputError(f"{path}: lacks the columns {', '.join(missing)} of a 3DGS scene")
    if len(vertex) == 0:
        raise InputError(f"{path}: has no Gaussians (element 'vertex' has 0 rows)")
    log = logging.getLogger("sgwarp")
    if unsigned := [name for name in needed if name not in POSITION and vertex.dtype[name].kind == "u"]:
        raise InputError(
            f"{path}: its column {unsigned[0]} holds whole numbers from 0 up, expected logits of opacities, logarithms "
            "of scales and quaternions; export it as the reference implementation does"
        )
    values = columns(path, vertex, needed)
    means, logits, log_scales, quats = np.split(values, np.cumsum([3, 1, len(shape)]), axis=1)
    if bool((log_scales > 0).all()) and bool(((logits > 0) & (logits <= 1)).all()):
        log.warning(
            "%s: its scales are all positive and its opacities all in 0 to 1: were they stored as they are, not as "
            "logarithms and logits? Then export it as the reference implementation does",
            path,
        )
    with np.errstate(over="ignore", invalid="ignore"):
        opacities = (1.0 / (1.0 + np.exp(-logits[:, 0].astype(np.float64)))).astype(np.float32)
        scales = np.exp(log_scales.astype(np.float64)).astype(np.float32)
    if flat:
        log.warning("%s: has two scales a Gaussian (2DGS); read as flat Gaussians", path)
        scales = np.concatenate([scales, np.zeros((len(scales), 1), np.float32)], axis=1)
    if FILTER in names:
        log.warning("%s: the 3D filter of Mip-Splatting (%s) is applied to scales and opacities", path, FILTER)
        scales, opacities = _filtered(scales, opacities, columns(path, vertex, (FILTER,)))
    sh = _plain_colors(path, vertex, rgb) if rgb is not None else _harmonics(path, vertex)
    rest = {name for name in names if re.fullmatch(r"f_rest_\d+", name)}
    own = {*needed, *(rgb or COLOUR), *NORMAL, *rest, FILTER}
    extras = {name: np.array(vertex[name]) for name in names if name not in own and not vertex.dtype[name].hasobject}
    if extras:
        log.info("%s: columns kept as they are: %s", path, ", ".join(extras))
    if lists := [name for name in names if vertex.dtype[name].hasobject]:
        log.warning("%s: columns left out: %s", path, ", ".join(lists))
    return build_gaussians(path, means, quats, scales, opacities, sh, extras=extras or None)


def _harmonics(path: str | os.PathLike[str], vertex: NDArray[Any]) -> NDArray[np.float32]:
    """Coefficients of f_dc_* and f_rest_*, float32 [N, K, 3]; degree 4 and up are left out."""
    names = vertex.dtype.names or ()
    rest = sum(re.fullmatch(r"f_rest_\d+", name) is not None for name in names)
    per_channel = rest // 3
    degree = math.isqrt(per_channel + 1) - 1
    whole = rest % 3 == 0 and (degree + 1) ** 2 == per_channel + 1
    if not whole or not {f"f_rest_{i}" for i in range(rest)} <= set(names):
        raise InputError(
            f"{path}: has {rest} columns f_rest_*, expected none, or f_rest_0 up to f_rest_8, 23 or 44 (degree 1 to 3)"
        )
    kept = min(per_channel, SH_COUNTS[-1] - 1)
    if kept < per_channel:
        logging.getLogger("sgwarp").warning("%s: harmonics of degree %d; up to 3 are kept", path, degree)
    # The file holds all coefficients of red, then all of green, then all of blue.
    chosen = [f"f_rest_{channel * per_channel + i}" for channel in range(3) for i in range(kept)]
    values = columns(path, vertex, (*COLOUR, *chosen))
    higher = values[:, 3:].reshape(len(values), 3, kept).transpose(0, 2, 1)
    return np.concatenate([values[:, None, :3], higher], axis=1)


def _plain_colors(path: str | os.PathLike[str], vertex: NDArray[Any], names: Sequence[str]) -> NDArray[np.float32]:
    """Coefficients of degree 0 from columns of colors, float32 [N, 1, 3]."""
    kinds = {vertex.dtype[name] for name in names}
    values = columns(path, vertex, names, np.float64)
    colors = unit_colors(values.astype(kinds.pop()) if len(kinds) == 1 else values)
    return ((colors - np.float32(0.5)) / np.float32(SH_C0))[:, None]


def _filtered(
    scales: NDArray[np.float32], opacities: NDArray[np.float32], width: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Scales and opacities after a Gaussian of standard deviation `width` [N, 1] (Yu et al. 2024, equation 7)."""
    before = scales.astype(np.float64) ** 2
    after = before + width.astype(np.float64) ** 2
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.sqrt(np.prod(np.where(after > 0, before / after, 1.0), axis=1))
    return np.sqrt(after).astype(np.float32), (opacities * share).astype(np.float32)


def read_ply(path: str | os.PathLike[str]) -> Gaussians:
    """Read a 3DGS scene, ascii or binary, columns in any order and of any scalar type.

    Columns x y z, f_dc_0..2, opacity (logit), scale_0..2 (logarithm), rot_0..3 (w, x, y, z) are required; the number
    of f_rest_* columns (0, 9, 24, 45) gives the SH degree. Plain colors (red, green, blue) may stand for f_dc_*.
    Without scale_2 (2DGS) the Gaussians are flat: their third scale is 0. The 3D filter of Mip-Splatting is applied.
    Normals are ignored; other columns are kept (`Gaussians.extras`). Rows with NaN or infinity are kept, with a logged
    notice of how many there are.

    Raises:
        InputError: The file is missing, cut short, no 3DGS scene, or empty.
    """
    return gaussians_from_elements(path, read_elements(path))


def write_ply(gaussians: Gaussians, path: str | os.PathLike[str]) -> None:
    """Write a scene with the columns of the reference implementation, binary little-endian float32.

    Columns that the scene was read with and that are none of them are written back, in their own types.
    Opacities 0 and 1 become logits -110 and 110 and a scale of 0 the logarithm -110, which read back exactly; all other
    values read back to a relative 1e-6.

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
    write_elements(path, {"vertex": _with_extras(rows, gaussians.extras)})


def _with_extras(rows: NDArray[Any], extras: Mapping[str, NDArray[Any]] | None) -> NDArray[Any]:
    """The rows with further columns behind."""
    further = {name: column for name, column in (extras or {}).items() if name not in (rows.dtype.names or ())}
    if not further:
        return rows
    described = rows.dtype.descr + [(name, column.dtype.newbyteorder("<").str) for name, column in further.items()]
    wide = np.empty(len(rows), described)
    for name in rows.dtype.names or ():
        wide[name] = rows[name]
    for name, column in further.items():
        wide[name] = column
    return wide


def columns(
    path: str | os.PathLike[str], rows: NDArray[Any], names: Sequence[str], kind: Any = np.float32
) -> NDArray[Any]:
    """Gather the named columns as float32 (or another `kind`) [N, len(names)]; a list column is an InputError."""
    lists = [name for name in names if rows.dtype[name].hasobject]
    if lists:
        raise InputError(f"{path}: column {lists[0]} holds lists, expected one number per row")
    values = np.empty((len(rows), len(names)), dtype=kind)
    # A double beyond float32 becomes infinity, a signalling NaN a quiet one: both are counted as non-finite.
    with np.errstate(over="ignore", invalid="ignore"):
        for start in range(0, len(rows), ROWS_PER_BLOCK):
            block = rows[start : start + ROWS_PER_BLOCK]
            for j, name in enumerate(names):
                values[start : start + len(block), j] = block[name]
    return values


def build_gaussians(
    path: str | os.PathLike[str], *fields: NDArray[Any], extras: Mapping[str, NDArray[Any]] | None = None
) -> Gaussians:
    """Gaussians from arrays in the order of its fields; says how many rows are not finite."""
    means, quats, scales, opacities, sh = (
        torch.from_numpy(np.require(field, np.float32, ("C", "W"))) for field in fields
    )
    gaussians = Gaussians(means, quats, scales, opacities, sh, extras)
    if gaussians.non_finite:
        logging.getLogger("sgwarp").warning(
            "%s: %d of %d Gaussians hold NaN or infinity; they are kept, and never rendered",
            path,
            gaussians.non_finite,
            len(gaussians),
        )
    say_coarse(path, means[::SAMPLED].numpy(), scales[::SAMPLED].numpy())
    return gaussians


def say_coarse(path: str | os.PathLike[str], means: NDArray[np.float32], scales: NDArray[np.float32]) -> None:
    """Log where coordinates are so large that float32 moves Gaussians by much of their size, as those of countries."""
    finite = np.isfinite(means).all(axis=1) & np.isfinite(scales).all(axis=1)
    if not finite.any():
        return
    farthest, size = (float(np.median(values[finite].max(axis=1))) for values in (np.abs(means), scales))
    step = farthest * float(np.finfo(np.float32).eps)
    if step > COARSE * size > 0:
        logging.getLogger("sgwarp").warning(
            "%s: lies so far from the origin (%g) that its positions are known to %.2g, its Gaussians of size %.2g are "
            "torn apart; move it near the origin where it was made",
            *(path, farthest, step, size),
        )


def drawn_rows(path: str | os.PathLike[str], gaussians: Gaussians) -> torch.Tensor:
    """Rows that are rendered at all, int64 [M]: neither NaN nor infinity, nor a rotation of zero.

    Formats of bytes cannot hold such values: the others would become Gaussians that are seen. A logged notice says how
    many are left out.

    Raises:
        InputError: There is none.
    """
    norms = torch.linalg.vector_norm(gaussians.quats.detach().double(), dim=1)
    kept = (gaussians.finite & (norms >= MIN_NORM)).cpu().nonzero()[:, 0]
    if len(kept) < len(gaussians):
        logging.getLogger("sgwarp").warning(
            "%s: left out %d of %d Gaussians with NaN, infinity or a rotation of zero",
            *(path, len(gaussians) - len(kept), len(gaussians)),
        )
    if len(kept) == 0:
        raise InputError(f"{path}: not written, the scene has no Gaussians")
    return kept


def host_arrays(gaussians: Gaussians) -> tuple[NDArray[np.float32], ...]:
    """means, quats, scales, opacities, sh as NumPy arrays."""
    fields = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    return tuple(field.detach().cpu().numpy() for field in fields)
