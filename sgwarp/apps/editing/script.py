"""Edits as a file: a list of steps that replays on the scene it was made for."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from sgwarp.apps.editing.operations import Operation, operation_content, operation_from
from sgwarp.apps.editing.selection import Selection, selection_from
from sgwarp.errors import InputError
from sgwarp.files.atomic import atomic_path
from sgwarp.files.documents import read_json
from sgwarp.scene import Gaussians

FORMAT = "sgwarp-edit"
VERSION = 1


@dataclass(frozen=True)
class EditStep:
    """An operation and what it is applied to."""

    selection: Selection
    operation: Operation

    @property
    def content(self) -> dict[str, Any]:
        """As in a script: only what differs from the defaults of a selection."""
        plain = Selection(self.selection.select)
        values = {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in asdict(self.selection).items()
            if name == "select" or value != getattr(plain, name)
        }
        return values | operation_content(self.operation)


def step_from(content: Any) -> EditStep:
    """A step of a script, {"select": [...], "do": "move", "by": [0, 0, 1], ...}.

    Raises:
        InputError: An entry is missing, unknown or malformed.
    """
    if not isinstance(content, Mapping):
        raise InputError(f"a step is an object with select and do, got {content!r}")
    step = EditStep(selection_from(content), operation_from(content))
    known = {*asdict(step.selection), *operation_content(step.operation)}
    unknown = sorted(set(content) - known)
    if unknown:
        raise InputError(f"{step.operation.name}: has no entry '{unknown[0]}'; known are {', '.join(sorted(known))}")
    return step


def save_script(steps: Sequence[EditStep], gaussians: Gaussians, path: str | os.PathLike[str]) -> None:
    """Write the steps for a scene as JSON."""
    content = {
        "format": FORMAT,
        "version": VERSION,
        "scene": gaussians.fingerprint,
        "steps": [step.content for step in steps],
    }
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def load_script(path: str | os.PathLike[str], gaussians: Gaussians | None = None) -> tuple[EditStep, ...]:
    """Read the steps; with `gaussians`, only if they were made for that scene.

    Raises:
        InputError: The file is missing or no script, a step does not fit, or it was made for another scene.
    """
    content = read_json(path)
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(f'{path}: is no edit script; it must hold "format": "{FORMAT}"')
    if content.get("version") is not VERSION:
        raise InputError(f"{path}: has version {content.get('version')}, this program reads {VERSION}; update it")
    unknown = sorted(set(content) - {"format", "version", "scene", "steps"})
    if unknown:
        raise InputError(f"{path}: has no entry '{unknown[0]}'; known are format, version, scene, steps")
    steps = content.get("steps")
    if not isinstance(steps, list) or not steps:
        raise InputError(f"{path}: steps: expected a list of at least one step")
    if gaussians is not None and content.get("scene") != gaussians.fingerprint:
        theirs = content.get("scene")
        raise InputError(f"{path}: was made for scene {theirs}, this scene is {gaussians.fingerprint}")
    return tuple(_numbered_step(path, number, step) for number, step in enumerate(steps, start=1))


def _numbered_step(path: str | os.PathLike[str], number: int, content: Any) -> EditStep:
    try:
        return step_from(content)
    except InputError as error:
        raise InputError(f"{path}: step {number}: {error}") from None
