"""The instances of a scene in a safetensors file.

Tensors `candidates` int16 or int32 [L, N, T], `shares` float16 [L, N, T], `observations` float16 [N], and `features`
float32 [K, C] if there are any; the header's metadata holds format, version, fingerprint of the scene, levels, table
and free notes as JSON.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.files.atomic import atomic_path
from sgwarp.files.documents import parse_json
from sgwarp.files.tensors import read_tensors, write_tensors
from sgwarp.io.ply import write_ply
from sgwarp.scene import Gaussians, Instance, InstanceMap

FORMAT = "sgwarp-instances"
VERSION = 1
TENSORS = ("candidates", "shares", "observations")
SHORT = 32767


def save_instances(found: InstanceMap, path: str | os.PathLike[str], notes: Mapping[str, Any] | None = None) -> None:
    """Write instances; `load_instances` reads them back exactly (those made elsewhere to a relative 2^-11).

    Args:
        found: What to write.
        path: Name ending in .safetensors.
        notes: Anything JSON can hold, such as where the masks came from.

    Raises:
        InputError: Wrong name, or notes that are not JSON.
    """
    if Path(path).suffix != ".safetensors":
        raise InputError(f"{path}: instances are written as .safetensors; change the name")
    kind = torch.int16 if len(found.table) <= SHORT else torch.int32
    tensors: dict[str, Tensor] = {
        "candidates": found.candidates.cpu().to(kind).contiguous(),
        "shares": found.shares.cpu().to(torch.float16).contiguous(),
        "observations": found.observations.cpu().to(torch.float16).contiguous(),
    }
    if found.features is not None:
        tensors["features"] = found.features.cpu().contiguous()
    try:
        stored_notes = json.dumps(dict(notes or {}))
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: notes must be JSON ({error})") from None
    metadata = {
        "format": FORMAT,
        "version": str(VERSION),
        "fingerprint": found.fingerprint,
        "least_confidence": repr(found.least_confidence),
        "levels": json.dumps(found.levels),
        "space": found.space,
        "table": json.dumps([asdict(row) for row in found.table]),
        "notes": stored_notes,
    }
    write_tensors(path, tensors, metadata)


def load_instances(path: str | os.PathLike[str], gaussians: Gaussians | None = None) -> InstanceMap:
    """Read instances; with `gaussians`, only if they were found in that scene.

    Raises:
        InputError: The file is missing, cut short, of another kind or a newer version, damaged, or of another scene.
    """
    metadata, tensors = _read(path)
    try:
        found = InstanceMap(
            candidates=tensors["candidates"],
            shares=tensors["shares"].to(torch.float32),
            observations=tensors["observations"].to(torch.float32),
            table=tuple(_row(row) for row in parse_json("table", metadata["table"])),
            levels=tuple(map(str, parse_json("levels", metadata["levels"]))),
            fingerprint=metadata["fingerprint"],
            least_confidence=float(metadata["least_confidence"]),
            features=tensors.get("features"),
            space=metadata.get("space", ""),
        )
        if gaussians is not None:
            found.require_scene(gaussians)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: its metadata is damaged ({error!r}); find the instances again") from None
    return found


def _row(row: Mapping[str, Any]) -> Instance:
    """A row of the table, its lists as tuples; fields that a newer program added are left out."""
    known = {name.name for name in fields(Instance)}
    values: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value for name, value in row.items() if name in known
    }
    found = Instance(**values)
    numbers = (found.id, found.parent, found.gaussians, found.masks, found.views)
    if not all(isinstance(number, int) for number in numbers):
        raise ValueError(f"row {row} holds something else than whole numbers")
    return found


def _read(path: str | os.PathLike[str]) -> tuple[dict[str, str], dict[str, Tensor]]:
    metadata, tensors = read_tensors(path, {*TENSORS, "features"})
    if metadata.get("format") != FORMAT:
        raise InputError(f"{path}: holds other tensors than instances; give the output of `sgwarp instances`")
    if metadata.get("version") != str(VERSION):
        raise InputError(f"{path}: has version {metadata.get('version')}, this program reads {VERSION}; update it")
    missing = sorted(set(TENSORS) - set(tensors))
    if missing:
        raise InputError(f"{path}: lacks the tensors {', '.join(missing)}; find the instances again")
    return metadata, tensors


def save_table(found: InstanceMap, path: str | os.PathLike[str]) -> None:
    """Write the table of instances as JSON, {"levels": [...], "labels": [...], "instances": [{...}, ...]}."""
    content = {
        "levels": list(found.levels),
        "labels": label_names(found),
        "instances": [asdict(row) for row in found.table],
    }
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def save_instance_scene(gaussians: Gaussians, found: InstanceMap, path: str | os.PathLike[str]) -> None:
    """Write the scene as PLY with the columns instance, label and confidence of the coarsest level.

    instance is int32, 0 for nothing and -1 for undecided; label is int32, the place of the instance's name among
    `label_names`, -1 for none; confidence is float32.

    Raises:
        InputError: The instances belong to another scene, or the file cannot be written.
    """
    found.require_scene(gaussians)
    ids = found.instance().cpu().numpy().astype(np.int32)
    names = label_names(found)
    place = np.array([-1, *(names.index(row.label) if row.label else -1 for row in found.table)], np.int32)
    columns = {
        "instance": ids,
        "label": place[np.maximum(ids, 0)],
        "confidence": found.confidence().cpu().numpy().astype(np.float32),
    }
    with atomic_path(path) as temporary:
        write_ply(replace(gaussians, extras={**(gaussians.extras or {}), **columns}), temporary)


def label_names(found: InstanceMap) -> list[str]:
    """The different names of the instances, in the order of the alphabet."""
    return sorted({row.label for row in found.table if row.label})
