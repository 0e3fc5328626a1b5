"""glTF scenes with the extension KHR_gaussian_splatting, .glb and .gltf.

A primitive of mode POINTS holds POSITION and, named KHR_gaussian_splatting:..., ROTATION (x, y, z, w), SCALE (linear),
OPACITY (0 to 1) and SH_DEGREE_l_COEF_n. Axes are glTF's, y up.

Source: KhronosGroup/glTF, extensions/2.0/Khronos/KHR_gaussian_splatting, and the glTF 2.0 specification.
"""

from __future__ import annotations

import json
import logging
import os
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sgwarp.errors import InputError
from sgwarp.files.atomic import atomic_path
from sgwarp.io.formats.axes import GLTF_AXES, PLY_AXES, change_axes, move_gaussians
from sgwarp.io.formats.gltf_buffers import Document, read_document
from sgwarp.io.formats.spz import gaussians_from_spz
from sgwarp.io.ply import build_gaussians, drawn_rows, host_arrays
from sgwarp.scene import Gaussians, join_gaussians

EXTENSION = "KHR_gaussian_splatting"
SPZ_EXTENSIONS = ("KHR_gaussian_splatting_compression_spz_2", "KHR_gaussian_splatting_compression_spz")
POINTS = 0  # mode of a primitive
DISPLAY = "srgb_rec709_display"  # the color space of 3DGS scenes
ELLIPSE = "ellipse"  # the kernel of 3DGS
FLOAT = 5126
GLB_MAGIC, GLB_JSON, GLB_BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
MAX_DEPTH = 64  # of nodes within nodes


def read_gltf(path: str | os.PathLike[str], axes: str = GLTF_AXES) -> Gaussians:
    """Read the Gaussians of a glTF file; those of several primitives are put together, moved as their nodes say.

    Args:
        path: A .glb or .gltf.
        axes: Directions of the file's axes; glTF says LUF, which is turned into the RDF of PLY files.

    Raises:
        InputError: The file is missing or damaged, or holds no Gaussians.
    """
    document = read_document(path)
    parts = [
        _moved(document, _primitive(document, primitive), matrix)
        for primitive, matrix in _primitives(document)
        if EXTENSION in _mapping(primitive.get("extensions"))
    ]
    if not parts:
        raise InputError(
            f"{path}: holds no primitive with {EXTENSION}; it is a mesh or a point cloud, not a 3DGS scene"
        )
    return change_axes(join_gaussians(parts), axes, PLY_AXES)


def _moved(document: Document, gaussians: Gaussians, matrix: NDArray[np.float64]) -> Gaussians:
    try:
        return move_gaussians(gaussians, matrix)
    except InputError as error:
        raise InputError(
            f"{document.path}: one of its nodes moves the scene: {error}; apply it and export again"
        ) from None


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, dict) else {}


def _list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []


def _primitives(document: Document) -> Iterator[tuple[Mapping[str, Any], NDArray[np.float64]]]:
    """Every primitive of the scene, and the matrix of its node."""
    nodes, scenes = document.rows("nodes"), document.rows("scenes")
    chosen = document.meta.get("scene", 0)  # the one to show
    roots = document.row("scenes", chosen).get("nodes") if scenes else list(range(len(nodes)))
    waiting = [(root, np.eye(4), 0) for root in _list(roots)]
    seen: set[int] = set()
    if not nodes:  # meshes that no node places
        waiting = []
        for mesh in document.rows("meshes"):
            for primitive in _list(_mapping(mesh).get("primitives")):
                yield _mapping(primitive), np.eye(4)
    while waiting:
        index, above, depth = waiting.pop()
        if not isinstance(index, int) or not 0 <= index < len(nodes) or index in seen or depth > MAX_DEPTH:
            raise InputError(f"{document.path}: its nodes are no tree (node {index}); it is damaged")
        seen.add(index)
        node = _mapping(nodes[index])
        matrix = above @ _node_matrix(document, node)
        waiting += [(child, matrix, depth + 1) for child in _list(node.get("children"))]
        if "mesh" in node:
            mesh = document.row("meshes", node["mesh"])
            for primitive in _list(mesh.get("primitives")):
                yield _mapping(primitive), matrix


def _node_matrix(document: Document, node: Mapping[str, Any]) -> NDArray[np.float64]:
    """Matrix of a node, points as columns."""

    def numbers(key: str, default: list[float]) -> NDArray[np.float64]:
        try:
            values = np.array(node.get(key, default), np.float64)
        except (OverflowError, TypeError, ValueError):
            values = np.empty(0)
        if values.shape != (len(default),) or not np.isfinite(values).all():
            raise InputError(f"{document.path}: '{key}' of a node must be {len(default)} numbers")
        return values

    if "matrix" in node:
        return numbers("matrix", [0.0] * 16).reshape(4, 4).T  # stored column after column
    x, y, z, w = numbers("rotation", [0.0, 0.0, 0.0, 1.0])
    matrix = np.eye(4)
    matrix[:3, :3] = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    ) * numbers("scale", [1.0, 1.0, 1.0])
    matrix[:3, 3] = numbers("translation", [0.0, 0.0, 0.0])
    return matrix


def _primitive(document: Document, primitive: Mapping[str, Any]) -> Gaussians:
    """The Gaussians of one primitive, in glTF's axes."""
    extension = _mapping(_mapping(primitive.get("extensions")).get(EXTENSION))
    space = extension.get("colorSpace", DISPLAY)
    if space != DISPLAY:
        logging.getLogger("sgwarp").warning("%s: colors are in %s, taken for %s", document.path, space, DISPLAY)
    kernel = extension.get("kernel", ELLIPSE)
    if kernel != ELLIPSE:
        logging.getLogger("sgwarp").warning("%s: its kernel is %s, taken for %s", document.path, kernel, ELLIPSE)
    inner = _mapping(extension.get("extensions"))
    for name in SPZ_EXTENSIONS:
        if name in inner:
            view = document.view(_mapping(inner[name]).get("bufferView"))
            document.take(len(view))
            return gaussians_from_spz(document.path, bytes(view), PLY_AXES)  # the frame is the document's
    attributes = _mapping(primitive.get("attributes"))

    def values(name: str, width: int) -> NDArray[np.float32]:
        if name not in attributes:
            draft = "; it follows a draft of the extension, export it again" if "_SCALE" in attributes else ""
            raise InputError(f"{document.path}: a primitive with {EXTENSION} lacks the attribute {name}{draft}")
        return document.accessor(attributes[name], width, name)

    means = values("POSITION", 3)
    quats = values(f"{EXTENSION}:ROTATION", 4)[:, [3, 0, 1, 2]]
    scales, opacities = values(f"{EXTENSION}:SCALE", 3), values(f"{EXTENSION}:OPACITY", 1)[:, 0]
    degree = 0
    while degree < 3 and f"{EXTENSION}:SH_DEGREE_{degree + 1}_COEF_0" in attributes:
        degree += 1
    names = [f"{EXTENSION}:SH_DEGREE_{d}_COEF_{n}" for d in range(degree + 1) for n in range(2 * d + 1)]
    sizes = {len(field) for field in (means, quats, scales, opacities)}
    sh = np.empty((len(means), len(names), 3), np.float32)
    for place, name in enumerate(names):  # one after the other: all of them at once would be the scene once more
        coefficients = values(name, 3)
        sizes.add(len(coefficients))
        if len(sizes) == 1:
            sh[:, place] = coefficients
    if len(sizes) > 1 or 0 in sizes:
        raise InputError(f"{document.path}: its attributes hold {sorted(sizes)} Gaussians; expected one number, not 0")
    if bool((scales < 0).any()) or bool(((opacities < 0) | (opacities > 1)).any()):
        raise InputError(f"{document.path}: holds a negative scale or an opacity outside 0 to 1; it is damaged")
    return build_gaussians(document.path, means, quats, scales, opacities, sh)


def write_gltf(gaussians: Gaussians, path: str | os.PathLike[str], axes: str = GLTF_AXES) -> None:
    """Write a scene as binary glTF, float32, nothing lost but a quaternion's length.

    Raises:
        InputError: The name ends in something else than .glb, the scene is empty or holds nothing that is rendered.
    """
    if Path(path).suffix.lower() != ".glb":
        raise InputError(f"{path}: glTF scenes are written as .glb; change the name")
    gaussians = gaussians.subset(drawn_rows(path, gaussians))
    means, quats, scales, opacities, sh = host_arrays(change_axes(gaussians, PLY_AXES, axes))
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    unit = quats / norms
    columns = {
        "POSITION": means,
        f"{EXTENSION}:ROTATION": unit[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": scales,
        f"{EXTENSION}:OPACITY": opacities[:, None],
    }
    degrees = [(d, n) for d in range(gaussians.sh_degree + 1) for n in range(2 * d + 1)]
    columns |= {f"{EXTENSION}:SH_DEGREE_{d}_COEF_{n}": sh[:, d * d + n] for d, n in degrees}
    body = b"".join(np.ascontiguousarray(values, "<f4").tobytes() for values in columns.values())
    text = json.dumps(_description(columns, len(body)), separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), GLB_JSON) + text + struct.pack("<II", len(body), GLB_BIN) + body
    if 12 + len(chunks) >= 1 << 32:
        raise InputError(f"{path}: {12 + len(chunks)} bytes do not fit a .glb (4 GB); write .ply or .spz")
    with atomic_path(path) as temporary:
        temporary.write_bytes(struct.pack("<III", GLB_MAGIC, 2, 12 + len(chunks)) + chunks)


def _description(columns: Mapping[str, NDArray[Any]], size: int) -> dict[str, Any]:
    """The JSON of a file whose buffer holds the columns one after the other."""
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    offset = 0
    for name, values in columns.items():
        count, width = values.shape
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[width]
        accessor: dict[str, Any] = {"bufferView": len(views), "componentType": FLOAT, "count": count, "type": kind}
        if name == "POSITION":
            accessor |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": 4 * count * width})
        accessors.append(accessor)
        offset += 4 * count * width
    properties = {
        "kernel": ELLIPSE,
        "colorSpace": DISPLAY,
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    primitive = {
        "attributes": {name: index for index, name in enumerate(columns)},
        "mode": POINTS,
        "extensions": {EXTENSION: properties},
    }
    return {
        "asset": {"version": "2.0", "generator": "sgwarp"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": size}],
    }
