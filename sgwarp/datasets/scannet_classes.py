"""Class sets of ScanNet: from raw ids to nyu40, to the 20 of COCO that panoptic lifting scores, and to 19, 15 or 10."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.files.access import read_bytes

NYU40 = (
    *("wall", "floor", "cabinet", "bed", "chair", "sofa", "table", "door", "window", "bookshelf", "picture", "counter"),
    *(
        "blinds",
        "desk",
        "shelves",
        "curtain",
        "dresser",
        "pillow",
        "mirror",
        "floor mat",
        "clothes",
        "ceiling",
        "books",
    ),
    *("refrigerator", "television", "paper", "towel", "shower curtain", "box", "whiteboard", "person", "night stand"),
    *("toilet", "sink", "lamp", "bathtub", "bag", "otherstructure", "otherfurniture", "otherprop"),
)
# Scored classes of COCO, in the order of panoptic lifting, with the nyu40 ids that go into each; the rest is `other`.
COCO20 = {
    "wall": (1,),
    "floor": (2,),
    "cabinet": (3,),
    "bed": (4,),
    "chair": (5,),
    "sofa": (6,),
    "table": (7, 14),
    "door": (8,),
    "window": (9,),
    "counter": (12,),
    "shelves": (10, 15),
    "curtain": (16, 28),
    "ceiling": (22,),
    "refrigerator": (24,),
    "television": (25,),
    "person": (31,),
    "toilet": (33,),
    "sink": (34,),
    "lamp": (35,),
    "bag": (37,),
}
SCANNET20 = (*range(1, 13), 14, 16, 24, 28, 33, 34, 36, 39)  # of the benchmark, nyu40 ids
# Sets that OpenGaussian scores, nyu40 ids.
SETS = {
    19: (*range(1, 13), 14, 16, 24, 28, 33, 34, 36),
    15: (*range(1, 11), 12, 14, 16, 33, 34),
    10: (1, 2, *range(4, 11), 33),
}
TABLE = "scannetv2-labels.combined.tsv"
LARGEST_TABLE = 1 << 24  # bytes


def coco_table() -> Tensor:
    """Index into COCO20 of every nyu40 id from 0 to 40, -1 for `other`, int64 [41]."""
    table = torch.full((41,), -1, dtype=torch.int64)
    for index, ids in enumerate(COCO20.values()):
        table[list(ids)] = index
    return table


def set_table(count: int) -> Tensor:
    """Index into SETS[count] of every nyu40 id from 0 to 40, -1 for the others, int64 [41]."""
    table = torch.full((41,), -1, dtype=torch.int64)
    table[list(SETS[count])] = torch.arange(len(SETS[count]))
    return table


def set_names(count: int) -> tuple[str, ...]:
    """Names of SETS[count]."""
    return tuple(NYU40[number - 1] for number in SETS[count])


def read_label_table(path: Path) -> Tensor:
    """nyu40 id of every raw id, 0 where the table has none, int64 [largest id + 1].

    Raises:
        InputError: The file is not the table of ScanNet.
    """
    lines = read_bytes(path, LARGEST_TABLE).decode("utf-8", "replace").splitlines()
    columns = lines[0].split("\t") if lines else []
    if "id" not in columns or "nyu40id" not in columns:
        raise InputError(f"{path}: has no columns id and nyu40id; expected ScanNet's {TABLE}")
    raw, nyu = columns.index("id"), columns.index("nyu40id")
    pairs = []
    for number, line in enumerate(lines[1:], start=2):
        cells = line.split("\t")
        if not line.strip():
            continue
        try:
            key, value = int(cells[raw]), int(cells[nyu] or 0) if cells[nyu].strip() else 0
        except (IndexError, ValueError):
            raise InputError(f"{path}: line {number}: id and nyu40id must be whole numbers") from None
        if not (0 <= key < 65536 and 0 <= value <= 40):
            raise InputError(f"{path}: line {number}: id {key} or nyu40id {value} is out of range")
        pairs.append((key, value))
    table = torch.zeros(max((key for key, _ in pairs), default=0) + 1, dtype=torch.int64)
    for key, value in pairs:
        table[key] = value
    return table


def to_nyu40(raw: Tensor, table: Tensor) -> Tensor:
    """nyu40 ids of raw ids, 0 where unknown."""
    return torch.where((raw >= 0) & (raw < len(table)), table[raw.clamp(0, len(table) - 1)], 0)
