"""Gaussian scenes in whatever format a file holds."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sgwarp.errors import InputError
from sgwarp.files.access import reading
from sgwarp.files.documents import read_json
from sgwarp.io.compressed_ply import gaussians_from_packed, is_compressed, write_compressed_ply
from sgwarp.io.formats.axes import GLTF_AXES, PLY_AXES, SPZ_AXES, change_axes, parse_axes
from sgwarp.io.formats.dot_splat import read_splat, write_splat
from sgwarp.io.formats.foreign import describe_file, describe_pointer
from sgwarp.io.formats.gltf import read_gltf, write_gltf
from sgwarp.io.formats.sog import read_sog
from sgwarp.io.formats.spz import read_spz, write_spz
from sgwarp.io.ply import gaussians_from_elements, read_elements, write_ply
from sgwarp.scene import Gaussians

HEAD_BYTES = 32


@dataclass(frozen=True)
class SceneFormat:
    """A kind of scene file.

    Attributes:
        name: What it is called.
        suffixes: What file names end in, the longest first.
        axes: Directions of its axes, as its specification says.
        read: Reader of a path with axes of the file, into those of PLY; None if it is not read.
        write: Writer of a scene to a path with axes for the file; None if it is not written.
    """

    name: str
    suffixes: tuple[str, ...]
    axes: str
    read: Callable[..., Gaussians]
    write: Callable[..., Any] | None = None


def _read_ply(path: str | os.PathLike[str], axes: str | None = None) -> Gaussians:
    elements = read_elements(path)
    interpret = gaussians_from_packed if is_compressed(elements) else gaussians_from_elements
    return change_axes(interpret(path, elements), axes or PLY_AXES, PLY_AXES)


def _write_ply(gaussians: Gaussians, path: str | os.PathLike[str], axes: str | None = None) -> None:
    write_ply(change_axes(gaussians, PLY_AXES, axes or PLY_AXES), path)


def _write_compressed(gaussians: Gaussians, path: str | os.PathLike[str], axes: str | None = None) -> None:
    write_compressed_ply(change_axes(gaussians, PLY_AXES, axes or PLY_AXES), path)


COMPRESSED = SceneFormat("compressed PLY", (".compressed.ply",), PLY_AXES, _read_ply, _write_compressed)
PLY = SceneFormat("PLY", (".ply",), PLY_AXES, _read_ply, _write_ply)
SPZ = SceneFormat("SPZ", (".spz",), SPZ_AXES, read_spz, write_spz)
SPLAT = SceneFormat(".splat", (".splat",), PLY_AXES, read_splat, write_splat)
GLTF = SceneFormat("glTF", (".glb", ".gltf"), GLTF_AXES, read_gltf, write_gltf)
SOG = SceneFormat("SOG", (".sog", "meta.json"), PLY_AXES, read_sog)
FORMATS = (COMPRESSED, PLY, SPZ, SPLAT, GLTF, SOG)
SCENE_SUFFIXES = tuple(suffix for form in FORMATS for suffix in form.suffixes)
WRITTEN = ", ".join(suffix for form in FORMATS if form.write for suffix in form.suffixes if suffix != ".gltf")


def load_gaussians(path: str | os.PathLike[str], axes: str | None = None) -> Gaussians:
    """Read a scene: PLY (3DGS, 2DGS, PlayCanvas compressed), SPZ, .splat, glTF or SOG, told apart by its first bytes.

    Args:
        path: The file; of SOG also the folder that holds its meta.json.
        axes: Directions of the file's axes x, y, z, such as "rdf" or "rub"; what the format's specification says if
            None. The scene comes in the axes of PLY files, "rdf" (right, down, forward).

    Raises:
        InputError: The file is missing, cut short, no scene of Gaussians, or holds none.
    """
    if axes is not None:
        axes = parse_axes(axes)
    form = find_format(path)
    return form.read(path) if axes is None else form.read(path, axes)


def find_format(path: str | os.PathLike[str]) -> SceneFormat:
    """The format of a scene file.

    Raises:
        InputError: The file is missing or of none of the formats; the message names what it is, if that is known.
    """
    if os.path.isdir(path) and os.path.isfile(os.path.join(path, "meta.json")):
        return SOG
    if os.path.isdir(path) and (held := _scene_in(Path(path))):
        raise InputError(f"{path}: is a folder; give its scene, {held}")
    with reading(path), open(path, "rb") as file:
        head = file.read(HEAD_BYTES)
    if head[:4] == b"ply\n" or head[:4] == b"ply\r" or head[:3] == b"ply":
        return PLY
    if head[:4] == b"NGSP" or head[:2] == b"\x1f\x8b":
        return SPZ
    if head[:4] == b"glTF":
        return GLTF
    name = Path(path).name.lower()
    if head[:2] == b"PK" and name.endswith(".sog"):
        return SOG
    if foreign := describe_pointer(head) or describe_file(path):
        raise InputError(f"{path}: {foreign}")
    # By name, so that the reader says what is wrong with the file.
    form = next((form for form in FORMATS if name.endswith(form.suffixes)), None)
    if form is not None:
        return form
    if name.endswith(".json"):
        raise InputError(f"{path}: {_describe_json(path)}")
    raise InputError(
        f"{path}: is not a valid PLY file, nor a scene of another format that is read ({_read_suffixes()})"
    )


def _scene_in(folder: Path) -> Path | None:
    """The scene in a folder: the last one that a 3DGS trainer left, or the only file that is named like one."""
    trained = list(folder.glob("point_cloud/iteration_*/point_cloud.ply"))
    if trained:
        return max(trained, key=lambda path: (len(path.parent.name), path.parent.name))
    named = [path for path in folder.iterdir() if path.name.lower().endswith(SCENE_SUFFIXES) and path.is_file()]
    return named[0] if len(named) == 1 else None


def _read_suffixes() -> str:
    return ", ".join(suffix for form in FORMATS for suffix in form.suffixes)


def _describe_json(path: str | os.PathLike[str]) -> str:
    try:
        meta = read_json(path)
    except InputError:
        meta = None
    if isinstance(meta, dict) and "frames" in meta:
        return "holds cameras, not a scene; give the scene, and the cameras with --views"
    return "is no scene of Gaussians"


def find_writer(path: str | os.PathLike[str]) -> SceneFormat | None:
    """The format that the name of an output asks for, or None."""
    name = os.fspath(path).lower()
    return next((form for form in FORMATS if form.write and name.endswith(form.suffixes)), None)


def save_gaussians(gaussians: Gaussians, path: str | os.PathLike[str], axes: str | None = None) -> None:
    """Write a scene in the format that its name ends in: .ply, .compressed.ply, .spz, .splat or .glb.

    Only .ply and .glb keep the numbers; .compressed.ply also changes the order of the Gaussians. Columns beyond those
    of a scene (`Gaussians.extras`) are kept in .ply alone.

    Args:
        gaussians: The scene, in the axes of PLY files.
        path: The file.
        axes: Directions of the file's axes; what the format's specification says if None.

    Raises:
        InputError: The name ends in something else, the scene is empty, or the file cannot be written.
    """
    form = find_writer(path)
    if form is None or form.write is None:
        raise InputError(f"{path}: scenes are written as {WRITTEN}; change the name")
    form.write(gaussians, path, axes=parse_axes(axes) if axes is not None else form.axes)
