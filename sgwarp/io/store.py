"""Lifted semantics in a safetensors file.

Tensors `features` [N, C] (float16, or float32 where that would lose them), `weight` [N], `effective_views` [N]; the
header's metadata holds format, version, space, fingerprint of the scene, labels and free notes as JSON.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.files.documents import parse_json
from sgwarp.files.tensors import read_tensors, write_tensors
from sgwarp.scene import Gaussians, Semantics

FORMAT = "sgwarp-semantics"
VERSION = 1
ROWS_PER_CHECK = 65536
TENSORS = ("features", "weight", "effective_views")
# Largest and smallest normal float16: between them rounding is relative, 2^-11.
HALF_MAX, HALF_MIN = 65504.0, 2.0**-14


def save_semantics(semantics: Semantics, path: str | os.PathLike[str], notes: Mapping[str, Any] | None = None) -> None:
    """Write semantics; `load_semantics` reads them back.

    Features are stored as float16 (relative error 2^-11) unless the largest lies outside its range, which keeps them
    float32; the metadata `dtype` says which.

    Args:
        semantics: What to write.
        path: Name ending in .safetensors.
        notes: Anything JSON can hold, such as how the features were made; `read_notes` returns it.

    Raises:
        InputError: Wrong name, or notes that are not JSON.
    """
    if Path(path).suffix != ".safetensors":
        raise InputError(f"{path}: semantics are written as .safetensors; change the name")
    features = semantics.features.detach().cpu()
    largest = features.abs().max().item() if features.numel() else 0.0
    half = largest == 0.0 or HALF_MIN <= largest <= HALF_MAX
    tensors = {
        "features": features.to(torch.float16 if half else torch.float32).contiguous(),
        "weight": semantics.weight.detach().cpu().contiguous(),
        "effective_views": semantics.effective_views.detach().cpu().contiguous(),
    }
    try:
        stored_notes = json.dumps(dict(notes or {}))
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: notes must be JSON ({error})") from None
    metadata = {
        "format": FORMAT,
        "version": str(VERSION),
        "dtype": "float16" if half else "float32",
        "space": semantics.space,
        "fingerprint": semantics.fingerprint,
        "labels": json.dumps(semantics.labels),
        "notes": stored_notes,
    }
    write_tensors(path, tensors, metadata)


def load_semantics(path: str | os.PathLike[str], gaussians: Gaussians | None = None) -> Semantics:
    """Read semantics; with `gaussians`, only if they were lifted on that scene.

    Raises:
        InputError: The file is missing, cut short, of another kind or a newer version, or of another scene.
    """
    metadata, tensors = _read(path, TENSORS)
    _require_numbers(path, tensors)
    try:
        labels = parse_json("labels", metadata["labels"], "lift the scene again")
        if not (labels is None or isinstance(labels, list)):
            raise ValueError("labels that are no list")
        semantics = Semantics(
            features=tensors["features"],
            weight=tensors["weight"],
            effective_views=tensors["effective_views"],
            space=metadata["space"],
            fingerprint=metadata["fingerprint"],
            labels=None if labels is None else tuple(map(str, labels)),
        )
        if gaussians is not None:
            semantics.require_scene(gaussians)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: its metadata is damaged ({error!r}); lift the scene again") from None
    return semantics


def _require_numbers(path: str | os.PathLike[str], tensors: Mapping[str, Tensor]) -> None:
    """Refuse what no lift writes and no query survives: NaN, infinity, negative weights, no channels."""
    for name, tensor in tensors.items():
        if not tensor.is_floating_point() or tensor.ndim != (2 if name == "features" else 1):
            raise InputError(f"{path}: its {name} are {tensor.dtype} {list(tensor.shape)}; lift the scene again")
        for start in range(0, len(tensor), ROWS_PER_CHECK):
            rows = tensor[start : start + ROWS_PER_CHECK]
            good = torch.isfinite(rows) if name == "features" else torch.isfinite(rows) & (rows >= 0)
            if not bool(good.all()):
                row = start + int((~good.reshape(len(rows), -1).all(dim=1)).nonzero()[0])
                fault = "NaN or infinity" if name == "features" else "NaN, infinity or a negative number"
                raise InputError(f"{path}: its {name} hold {fault}, first in row {row}; lift the scene again")
    if not tensors["features"].shape[1]:
        raise InputError(f"{path}: its features have no channels; lift the scene again")


def read_notes(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The notes given to `save_semantics`, without reading the features.

    Raises:
        InputError: As `load_semantics`.
    """
    metadata, _ = _read(path, ())
    notes = parse_json(f"{path}: its notes", metadata.get("notes", "{}"), "lift the scene again")
    if not isinstance(notes, dict):
        raise InputError(f"{path}: its notes are damaged; lift the scene again")
    return notes


def _read(path: str | os.PathLike[str], names: tuple[str, ...]) -> tuple[dict[str, str], dict[str, Tensor]]:
    metadata, tensors = read_tensors(path, names)
    if metadata.get("format") != FORMAT:
        raise InputError(f"{path}: holds no lifted semantics, but other tensors; give the output of a lift")
    if metadata.get("version") != str(VERSION):
        raise InputError(f"{path}: has version {metadata.get('version')}, this program reads {VERSION}; update it")
    missing = sorted(set(names) - set(tensors))
    if missing:
        raise InputError(f"{path}: lacks the tensors {', '.join(missing)}; lift the scene again")
    return metadata, tensors
