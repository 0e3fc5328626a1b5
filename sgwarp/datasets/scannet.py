"""ScanNet, frames exported by its own reader.

| file, below {scene} | holds |
|---|---|
| color/{i}.jpg | photographs |
| depth/{i}.png | uint16 [mm] |
| pose/{i}.txt | camera to world, OpenCV axes; infinite where tracking was lost |
| intrinsic/intrinsic_color.txt | 4 x 4 |
| label-filt/{i}.png, instance-filt/{i}.png | uint16 raw ids, and objects |
| {scene}_vh_clean_2.labels.ply | vertices with their nyu40 id |
| {scene}_vh_clean_2.0.010000.segs.json, {scene}.aggregation.json | segment of each vertex, and objects by segments |

Scenes lie in the root, in `scans` or in `scans_test`; scannetv2-labels.combined.tsv beside them or in the root.
Photographs may be smaller than they were taken (648 x 484 is usual): the intrinsics follow.
"""

from __future__ import annotations

import logging
import re
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgwarp.datasets.base import LabelledPoints, SceneData, absent, folders_in, images_in, require_scene, trained_in
from sgwarp.datasets.scannet_classes import COCO20, TABLE, coco_table, read_label_table, to_nyu40
from sgwarp.errors import InputError
from sgwarp.files.access import read_bytes
from sgwarp.files.documents import read_json
from sgwarp.files.images import read_ids, read_size
from sgwarp.scene import Camera, View
from sgwarp.scene.extent import with_near_plane

NAME = "scannet"
ABOUT = "ScanNet, exported frames: {scene}/color, depth, pose, intrinsic, label-filt"
SCENE = re.compile(r"scene\d{4}_\d{2}")
PLACES = (".", "scans", "scans_test")
TAKEN = ((1296, 968), (640, 480))  # widths and heights that ScanNet's intrinsics may be for
LARGEST_MATRIX = 1 << 16  # bytes
AGGREGATIONS = (".aggregation.json", "_vh_clean.aggregation.json")


def list_scenes(root: Path) -> list[str]:
    """Folders named scene0000_00 that hold exported frames or a labelled mesh."""
    found = {folder.name for place in PLACES if (root / place).is_dir() for folder in _scenes(root / place)}
    return sorted(found)


def _scenes(place: Path) -> list[Path]:
    return [
        f for f in folders_in(place) if SCENE.fullmatch(f.name) and ((f / "color").is_dir() or _mesh(f) is not None)
    ]


def _mesh(folder: Path) -> Path | None:
    path = folder / f"{folder.name}_vh_clean_2.labels.ply"
    return path if path.is_file() else None


def open_scene(root: Path, name: str) -> SceneData:
    """A scene, labelled with the 20 classes of COCO that panoptic lifting scores.

    Raises:
        InputError: There is none of that name.
    """
    require_scene(root, name, list_scenes(root))
    folder = next(root / place / name for place in PLACES if (root / place / name).is_dir())
    colors = sorted(images_in(folder / "color"), key=lambda path: (len(path.stem), path.stem))
    truth = folder / "label-filt"
    labelled = tuple(path.stem for path in colors if (truth / f"{path.stem}.png").is_file())
    table = next((place / TABLE for place in (folder.parent, root, folder) if (place / TABLE).is_file()), None)
    missing = absent(folder, ("color", "depth", "pose", "intrinsic/*color*.txt", "label-filt", "instance-filt"))
    missing += () if table else (TABLE,)
    missing += () if _mesh(folder) else (f"{name}_vh_clean_2.labels.ply",)

    def labels(stem: str) -> Tensor:
        assert table is not None
        raw = torch.from_numpy(read_ids(truth / f"{stem}.png")).long()
        return coco_table()[to_nyu40(raw, read_label_table(table))]

    def depth(view: View) -> NDArray[np.float32]:
        return read_ids(folder / "depth" / f"{view.stem}.png").astype(np.float32) * np.float32(0.001)

    def instances(stem: str) -> Tensor:
        return torch.from_numpy(read_ids(folder / "instance-filt" / f"{stem}.png")).long()

    return SceneData(
        name,
        folder,
        frames=len(colors),
        missing=missing,
        load_views=(lambda: read_views(folder, colors)) if colors else None,
        classes=tuple(COCO20),
        labelled=labelled if table else (),
        load_labels=labels if table and labelled else None,
        load_instances=instances if (folder / "instance-filt").is_dir() else None,
        load_points=(lambda: read_mesh(folder)) if _mesh(folder) else None,
        load_depth=depth if (folder / "depth").is_dir() else None,
        gaussians=trained_in(folder),
    )


def read_views(folder: Path, colors: list[Path]) -> list[View]:
    """Views in the order of their numbers; those whose pose is infinite are left out, with a logged count.

    Raises:
        InputError: A matrix is damaged, or no pose is left.
    """
    places = sorted((folder / "intrinsic").glob("*color*.txt"))
    if not places:
        raise InputError(f"{folder}/intrinsic: has no intrinsic_color.txt; export it with ScanNet's reader")
    K, views, lost = read_matrix(places[0])[:3, :3], [], 0
    for path in colors:
        pose = read_matrix(folder / "pose" / f"{path.stem}.txt")
        if not np.isfinite(pose).all():
            lost += 1
            continue
        height, width = read_size(path)
        camera = Camera(scaled_intrinsics(K, width, height), torch.from_numpy(np.linalg.inv(pose)), width, height)
        views.append(View(path.stem, camera, path, name=path.name))
    if lost:
        logging.getLogger("sgwarp").warning("%s: left out %d frames whose pose was lost", folder, lost)
    if not views:
        raise InputError(f"{folder}: none of {len(colors)} frames has a finite pose; export the scene again")
    return with_near_plane(views)


def scaled_intrinsics(K: NDArray[np.float64], width: int, height: int) -> Tensor:
    """Intrinsics at the size of the photographs, float64 [3, 3].

    The matrix does not say which size it is for: of the photograph's own and ScanNet's, that whose middle is nearest to
    the principal point.
    """

    def distance(size: tuple[int, int]) -> float:
        return abs(2 * K[0, 2] / size[0] - 1) + abs(2 * K[1, 2] / size[1] - 1)

    of = min(((width, height), *TAKEN), key=distance)
    scale = np.array([width / of[0], height / of[1], 1.0])[:, None]
    return torch.from_numpy(K * scale * np.array([[1, 0, 1], [0, 1, 1], [0, 0, 1]]))


def read_matrix(path: Path) -> NDArray[np.float64]:
    """A 4 x 4 matrix as text.

    Raises:
        InputError: The file is missing or holds something else.
    """
    try:
        values = np.array(read_bytes(path, LARGEST_MATRIX).split(), dtype=np.float64)
    except ValueError:
        values = np.empty(0)
    if values.size != 16:
        raise InputError(f"{path}: expected the 16 numbers of a 4 x 4 matrix; export it again")
    return values.reshape(4, 4)


def read_mesh(folder: Path) -> LabelledPoints:
    """Vertices of the labelled mesh; their labels are nyu40 ids, 0 where there is none; objects, if they lie there.

    Raises:
        InputError: The mesh or its objects cannot be read.
    """
    from sgwarp.io.ply import read_elements

    path = folder / f"{folder.name}_vh_clean_2.labels.ply"
    vertex = dict(read_elements(path)).get("vertex")
    names = vertex.dtype.names if vertex is not None else None
    if vertex is None or names is None or not {"x", "y", "z", "label"} <= set(names):
        raise InputError(f"{path}: expected vertices with x, y, z and label; download the labelled mesh")
    positions = np.stack([vertex[axis] for axis in "xyz"], axis=1).astype(np.float32)
    labels = torch.from_numpy(vertex["label"].astype(np.int64))
    labels = torch.where((labels >= 0) & (labels <= 40), labels, 0)
    return LabelledPoints(torch.from_numpy(positions), labels, _read_objects(folder, len(labels)))


def _read_objects(folder: Path, count: int) -> Tensor | None:
    """Object of each vertex from 1 on, 0 for none, int64 [count]; None if the two files do not lie there.

    Raises:
        InputError: One of them is damaged, or belongs to another mesh.
    """
    segments = folder / f"{folder.name}_vh_clean_2.0.010000.segs.json"
    groups = next((p for p in (folder / f"{folder.name}{end}" for end in AGGREGATIONS) if p.is_file()), None)
    if not segments.is_file() or groups is None:
        return None
    try:
        of_vertex = np.array(read_json(segments)["segIndices"], dtype=np.int64)
        objects = [(g["objectId"] + 1, s) for g in read_json(groups)["segGroups"] for s in g["segments"]]
        numbers, ids = np.array(objects, dtype=np.int64).reshape(-1, 2).T
    except (KeyError, TypeError, ValueError, OverflowError):
        raise InputError(f"{segments}, {groups.name}: hold no segIndices or segGroups; download them again") from None
    if of_vertex.shape != (count,):
        raise InputError(f"{segments}: {of_vertex.size} vertices, but the mesh has {count}; download both again")
    if not len(ids):
        return torch.zeros(count, dtype=torch.int64)
    order = ids.argsort(kind="stable")
    place = np.searchsorted(ids[order], of_vertex).clip(max=len(ids) - 1)
    return torch.from_numpy(np.where(ids[order][place] == of_vertex, numbers[order][place], 0))
