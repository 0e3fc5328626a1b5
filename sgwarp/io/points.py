"""Coloured points of a scene, as structure from motion leaves them: COLMAP models and PLY files."""

from __future__ import annotations

import logging
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sgwarp.errors import InputError
from sgwarp.files.documents import read_json
from sgwarp.io.colmap_model import find_model, holds_model, read_points
from sgwarp.io.colors import rgb_names, unit_colors
from sgwarp.io.names import find_named, inside
from sgwarp.io.ply import COLOUR, POSITION, columns, read_elements
from sgwarp.io.world import apply_transform, camera_places, far_origin, transform_of_points

PLY_NAMES = ("points3D.ply", "sparse_pc.ply", "point_cloud.ply")  # beside a transforms.json that names none
MODEL_NAMES = ("points3D.bin", "points3D.txt")  # of a COLMAP model; 3DGS trainers leave a points3D.ply beside them
PLY_KEY = "ply_file_path"  # of nerfstudio's transforms.json
GREY = 0.5
SH_C0 = 0.28209479177387814  # constant of degree 0: color = SH_C0 f_dc + 0.5

Points = tuple[NDArray[np.float64], NDArray[np.float32]]  # positions [N, 3] [m], colours [N, 3] in [0, 1]


def load_points(path: str | os.PathLike[str], views: str | os.PathLike[str] | None = None) -> Points:
    """Read the points of a data set, or of one file.

    Args:
        path: What `load_views` takes: a folder with transforms.json (whose `ply_file_path` names the points, else
            points3D.ply, sparse_pc.ply or point_cloud.ply beside it) or with a COLMAP model; or a .ply, or a COLMAP
            points3D.bin or .txt.
        views: Data set that a file of points belongs to: where `load_views` moves its cameras, they move, too.

    Returns:
        Positions, float64 [N, 3], and colours in [0, 1], float32 [N, 3]. Points that are not finite are left out.
        Those of a COLMAP model beside a transforms.json are moved into the world of its cameras (`applied_transform`).

    Raises:
        InputError: There is no such file, or it holds no points.
    """
    if not os.path.exists(path):
        raise InputError(f"{path}: no such file or folder; check the path")
    source = find_points(path)
    if source is None:
        raise InputError(
            f"{path}: holds no points; looked for '{PLY_KEY}' in transforms.json, {', '.join(PLY_NAMES)} and the "
            "points3D of a COLMAP model"
        )
    if source.suffix.lower() == ".ply":
        positions, colours = _read_ply(source)
    else:
        positions, stored = read_points(source)
        colours = unit_colors(stored if source.suffix == ".txt" else stored.astype(np.uint8))
    finite = np.isfinite(positions).all(axis=1) & np.isfinite(colours).all(axis=1)
    if not finite.any():
        raise InputError(f"{source}: holds no finite points; export them again, or start without any")
    if not finite.all():
        logging.getLogger("sgwarp").warning(
            "%s: left out %d of %d points: not finite", source, int((~finite).sum()), len(positions)
        )
    return _placed(source, Path(views if views is not None else path), positions[finite]), colours[finite].clip(0, 1)


def _placed(source: Path, data_set: Path, positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points of a file in the coordinates that the cameras of their data set have once they are loaded."""
    if data_set.is_file() and data_set.suffix.lower() != ".json":
        return positions
    transforms = data_set if data_set.is_file() else data_set / "transforms.json"
    of_model = source.suffix.lower() != ".ply" or (source.parent != transforms.parent and holds_model(source.parent))
    if transforms.is_file() and of_model:
        matrix = transform_of_points(transforms, read_json(transforms), source.parent)
        if matrix is None:
            raise InputError(f"{source}: its points do not belong to {transforms}; name others, or start without any")
        positions = apply_transform(matrix, positions)
    origin = far_origin(camera_places(data_set))
    return positions if origin is None else positions - origin


def find_points(path: str | os.PathLike[str]) -> Path | None:
    """The file of points that belongs to a data set, or None."""
    path = Path(path)
    if path.is_file() and path.suffix.lower() != ".json":
        return path
    folder = path if path.is_dir() else path.parent
    transforms = path if path.is_file() else folder / "transforms.json"
    if transforms.is_file():
        named = _named_in(transforms)
        if named is not None:
            return named
        beside = [folder / name for name in PLY_NAMES]
        if found := next((file for file in beside if file.is_file()), None):
            return found
    model = find_model(folder)
    if model is None:
        return None
    return next((model / name for name in (*MODEL_NAMES, PLY_NAMES[0]) if (model / name).is_file()), None)


def _named_in(transforms: Path) -> Path | None:
    try:
        meta: Any = read_json(transforms)
    except InputError:
        return None  # whoever reads the cameras says what is wrong with the file
    name = meta.get(PLY_KEY) if isinstance(meta, dict) else None
    if name is None:
        return None
    if not isinstance(name, str):
        raise InputError(f"{transforms}: '{PLY_KEY}' must be the name of a file, got {name!r}")
    named = find_named(transforms, transforms.parent, name)
    if named is None:
        inside(transforms, transforms.parent, name)  # or else it leads out of the data set
        logging.getLogger("sgwarp").warning("%s: its '%s' %r does not exist", transforms, PLY_KEY, name)
        return None
    return named


def _read_ply(path: Path) -> Points:
    elements = read_elements(path)
    vertex = elements.get("vertex")
    if vertex is None or not set(POSITION) <= set(vertex.dtype.names or ()):
        raise InputError(f"{path}: has no element 'vertex' with x, y, z; expected points")
    # In the file's own precision: coordinates of a country do not fit float32.
    positions = columns(path, vertex, POSITION, np.float64)
    names = vertex.dtype.names or ()
    if (rgb := rgb_names(names)) is not None:
        kinds = {vertex.dtype[name] for name in rgb}
        values = columns(path, vertex, rgb, np.float64)
        return positions, unit_colors(values.astype(kinds.pop()) if len(kinds) == 1 else values)
    if set(COLOUR) <= set(names):  # a 3DGS scene
        return positions, (columns(path, vertex, COLOUR) * np.float32(SH_C0) + np.float32(0.5)).clip(0, 1)
    logging.getLogger("sgwarp").warning("%s: its points have no colors; they start grey", path)
    return positions, np.full(positions.shape, GREY, np.float32)
