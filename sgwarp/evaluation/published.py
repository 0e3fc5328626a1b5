"""Published figures of the paper and of other systems, with their sources: one data file, `published.json`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from sgwarp.files.documents import read_json

FILE = Path(__file__).with_name("published.json")


@dataclass(frozen=True)
class Published:
    """One system under one protocol.

    Attributes:
        system: Its name.
        kind: How it comes to its answers.
        source: Where the figures stand, in full.
        figures: Shares from 0 to 1, by the names that the profile gives its own figures.
        scenes: The first figure by scene.
        second_hand: Quoted by somebody else; check before printing it anywhere else.
        seconds: Time per scene, as it was stated.
        note: What to know of the figures.
    """

    system: str
    kind: str
    source: str
    figures: Mapping[str, float]
    scenes: Mapping[str, float] = field(default_factory=dict)
    second_hand: bool = False
    seconds: str = ""
    note: str = ""


@cache
def _content() -> dict[str, Any]:
    content: dict[str, Any] = read_json(FILE)
    return content


def find_published(profile: str) -> tuple[Published, ...]:
    """Systems with figures under a protocol, in the order of the file; none if there are none."""
    content = _content()
    entry = content["profiles"].get(profile, {"rows": []})
    return tuple(
        Published(
            row["system"],
            row["kind"],
            content["sources"][row["source"]],
            {name: value / 100 for name, value in row["figures"].items()},
            {name: value / 100 for name, value in row.get("scenes", {}).items()},
            row.get("second_hand", False),
            row.get("seconds", ""),
            row.get("note", ""),
        )
        for row in entry["rows"]
    )
