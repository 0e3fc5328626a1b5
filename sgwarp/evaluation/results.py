"""The record of one scene under one set of choices, as a file: once it is there, the scene is done."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from sgwarp.errors import InputError
from sgwarp.files.atomic import atomic_path
from sgwarp.files.documents import read_json
from sgwarp.files.inputs import own_files

FILE = "result.json"


@dataclass
class SceneResult:
    """What one scene gave.

    Attributes:
        scene: Its name.
        figures: Accuracy by name, NaN where there is none.
        values: Single outcomes by name, such as the IoU of every query, for means over scenes and over queries.
        per_class: IoU and the like by class.
        classes: Of the confusion matrix.
        confusion: Counts, row = true class, the last column = unknown, [Q, Q + 1]; None if the profile has none.
        seconds: By stage.
        peak_memory: Most bytes that the process held meanwhile.
        gaussians: How many.
        bytes_per_gaussian: Of the semantics.
        views: Lifted from, and scored.
        left_out: As in run.json.
        sheets: Pictures, relative to the folder of results.
    """

    scene: str
    figures: dict[str, float] = field(default_factory=dict)
    values: dict[str, list[float]] = field(default_factory=dict)
    per_class: dict[str, dict[str, float]] = field(default_factory=dict)
    classes: list[str] = field(default_factory=list)
    confusion: list[list[int]] | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    peak_memory: int = 0
    gaussians: int = 0
    bytes_per_gaussian: float = 0.0
    views: dict[str, int] = field(default_factory=dict)
    left_out: dict[str, float] = field(default_factory=dict)
    sheets: list[str] = field(default_factory=list)


def write_result(path: Path, result: SceneResult, identity: Mapping[str, Any]) -> None:
    """Write a record, whole or not at all; numbers that are not finite become null."""
    record = {"identity": dict(identity), "result": finite(asdict(result))}
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(record, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def read_result(path: Path, identity: Mapping[str, Any]) -> SceneResult | None:
    """The record in a file, if it was made under these choices; None if there is none, or it is another's."""
    if not path.is_file():
        return None
    try:
        with own_files():
            record = read_json(path)
        if not isinstance(record, dict) or _text(record.get("identity")) != _text(dict(identity)):
            return None
        return SceneResult(**_numbers(record["result"]))
    except (InputError, KeyError, TypeError, AttributeError):  # of an earlier version: it is made anew
        return None


def _text(identity: Any) -> str:
    """As JSON, which has no tuples."""
    return json.dumps(identity, sort_keys=True)


def finite(value: Any) -> Any:
    """The same with None for numbers that JSON does not have."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    return [finite(item) for item in value] if isinstance(value, (list, tuple)) else value


def _numbers(record: dict[str, Any]) -> dict[str, Any]:
    """Figures with NaN in place of null."""

    def back(value: Any) -> Any:
        return math.nan if value is None else value

    record["figures"] = {name: back(value) for name, value in record["figures"].items()}
    record["values"] = {name: [back(value) for value in values] for name, values in record["values"].items()}
    record["per_class"] = {
        name: {key: back(value) for key, value in row.items()} for name, row in record["per_class"].items()
    }
    return record
