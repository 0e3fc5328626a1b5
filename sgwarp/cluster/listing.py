"""The list of scenes: a folder, a pattern, a text file or a CSV file."""

from __future__ import annotations

import csv
import glob
import os
import shlex
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sgwarp.errors import InputError
from sgwarp.files.access import read_bytes

RESERVED = ("shards",)  # folders of the output that are no scenes
LONGEST = 200  # bytes of a name: file systems hold 255, and a folder at work adds some
POINTS = ("points3D.ply", "sparse_pc.ply", "point_cloud.ply")  # of data sets, to start a fit from
MAGIC = ("*", "?", "[")
LARGEST = 1 << 26  # bytes of a list


class MissingScene(InputError):
    """A folder holds no trained scene; that is a fault of this scene, not of the list."""


@dataclass(frozen=True)
class Scene:
    """One line of the list.

    Attributes:
        name: Of its folder in the output.
        path: A data set, a folder of photographs or a .ply file; absolute.
        options: "stage.option" or "option": value, of this scene alone.
    """

    name: str
    path: Path
    options: dict[str, str] = field(default_factory=dict)


def list_scenes(source: str, out: Path | None = None) -> list[Scene]:
    """The scenes that a list names.

    Args:
        source: A folder, each of whose folders and .ply files is a scene; a pattern such as "scans/*/dslr"; a .txt file
            with a path in each line, followed by option=value if needed; or a .csv file with a column `path`, perhaps
            `name`, and one for each option. Paths in a file are relative to it; lines that begin with # are comments.
        out: The folder of results: it is no scene where it lies beside them.

    Raises:
        InputError: There is no list, no scene in it, or two scenes have one name.
    """
    path = Path(source)
    found: list[tuple[str, Path, dict[str, str]]]
    if os.path.isdir(path):
        entries = sorted(p for p in path.iterdir() if p.name[0] != "." and (p.is_dir() or p.suffix == ".ply"))
        found = [(_name(p), p, {}) for p in entries if not _same_place(p, out)]
    elif path.suffix.lower() == ".csv" and os.path.isfile(path):
        found = list(_csv_rows(path))
    elif os.path.isfile(path):
        found = list(_text_lines(path))
    elif any(mark in source for mark in MAGIC):
        matches = sorted(p for p in map(Path, glob.glob(source, recursive=True)) if not _same_place(p, out))
        found = list(zip(_names_apart(matches), matches, [{} for _ in matches], strict=True))
    else:
        raise InputError(f"{source}: no such folder, list or pattern; check the path")
    scenes = [Scene(name, place.absolute(), options) for name, place, options in found]
    if not scenes:
        raise InputError(f"{source}: names no scene; a folder of scenes has a folder or a .ply file for each")
    _check_names(scenes, source)
    return scenes


def shard_of(scenes: Sequence[Scene], shard: str) -> list[Scene]:
    """The share "i/n" of a list: every n-th scene from the i-th on, counted from 0.

    Raises:
        InputError: It is not written so, or i is not below n.
    """
    index, count = parse_shard(shard)
    return list(scenes[index::count])


def parse_shard(shard: str) -> tuple[int, int]:
    """i and n of "i/n".

    Raises:
        InputError: As `shard_of`.
    """
    first, slash, second = shard.partition("/")
    if not (slash and first.isascii() and first.isdigit() and second.isascii() and second.isdigit()):
        raise InputError(f"--shard {shard}: expected i/n, such as 0/4 for the first of four")
    index, count = int(first), int(second)
    if index >= count:
        raise InputError(
            f"--shard {shard}: shards are counted from 0; expected 0/{count} to {max(count - 1, 0)}/{count}"
        )
    return index, count


def _same_place(path: Path, out: Path | None) -> bool:
    return out is not None and path.resolve() == out.resolve()


def _csv_rows(path: Path) -> Iterator[tuple[str, Path, dict[str, str]]]:
    lines = ["" if line.startswith("#") else line for line in _read(path).splitlines()]
    before = next((number for number, line in enumerate(lines) if line), 0)  # lines before the names of the columns
    rows = csv.reader(lines[before:])
    try:
        yield from _scenes_of(path, rows, before)
    except csv.Error as error:  # of a cell without end, for one
        line = before + rows.line_num
        raise InputError(f"{path}: line {line} cannot be read ({error}); quote cells in pairs") from None


def _scenes_of(path: Path, rows: Any, before: int) -> Iterator[tuple[str, Path, dict[str, str]]]:
    heads = [head.strip() for head in next(rows, ())]
    if "path" not in heads:
        raise InputError(f"{path}: has no column 'path'; its first line names the columns: path,name,fit.steps,...")
    if twice := next((head for head in heads if head and heads.count(head) > 1), None):
        raise InputError(f"{path}: column '{twice}' stands there twice; leave one")
    for row in rows:
        line = before + rows.line_num
        if len(row) > len(heads):
            raise InputError(f"{path}: line {line} has more cells than there are columns; quote commas")
        values = [value.strip() for value in row] + [""] * (len(heads) - len(row))
        if any(value for head, value in zip(heads, values, strict=True) if not head):
            raise InputError(f"{path}: line {line} has a cell in a column without a name; name it in the first line")
        cells = {head: value for head, value in zip(heads, values, strict=True) if head}
        if not any(cells.values()):
            continue
        if not cells["path"]:
            raise InputError(f"{path}: line {line} has no path")
        place = path.parent / cells.pop("path")
        yield cells.pop("name", "") or _name(place), place, {key: value for key, value in cells.items() if value}


def _text_lines(path: Path) -> Iterator[tuple[str, Path, dict[str, str]]]:
    for number, line in enumerate(_read(path).splitlines(), start=1):
        try:
            words = shlex.split(line, comments=True)
        except ValueError as error:
            raise InputError(f"{path}: line {number} cannot be read ({error}); quote spaces in pairs") from None
        if not words:
            continue
        pairs = [word.partition("=") for word in words[1:]]
        wrong = next((word for word, pair in zip(words[1:], pairs, strict=True) if not (pair[0] and pair[1])), None)
        if wrong is not None:
            raise InputError(f"{path}: line {number}: expected option=value after the path, got {wrong!r}")
        options = {key: value for key, _, value in pairs}
        place = path.parent / words[0]
        yield options.pop("name", "") or _name(place), place, options


def _read(path: Path) -> str:
    try:
        return read_bytes(path, LARGEST).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: cannot be read as text ({error}); a list is UTF-8 text") from None


def _name(path: Path) -> str:
    """Of a scene: its folder's or file's name, without the suffixes of a .ply."""
    name = path.absolute().name
    return name.removesuffix(".ply").removesuffix(".compressed") if path.suffix == ".ply" else name


def _names_apart(paths: Sequence[Path]) -> list[str]:
    """Names of the paths; if the last part is the same for all, as in scans/*/dslr, of the folder above."""
    while len(paths) > 1 and len({p.name for p in paths}) == 1:
        paths = [p.parent for p in paths]
    return [_name(p) for p in paths]


def _check_names(scenes: Iterable[Scene], source: str) -> None:
    seen: dict[str, Scene] = {}
    for scene in scenes:
        name = scene.name
        fits = name.isprintable() and len(os.fsencode(name)) <= LONGEST and not {"/", "\\"} & set(name)
        if not (fits and name) or name[0] == "." or name in RESERVED:
            raise InputError(f"{source}: {name!r} cannot be the name of a folder of results; give it another name")
        if name in seen:
            both = f"{seen[name].path} and {scene.path}"
            raise InputError(f"{source}: two scenes are named {name}: {both}; give names in a .csv list")
        seen[name] = scene


def gaussians_in(folder: Path) -> Path:
    """The trained scene in a folder: scene.ply, or the only .ply there that holds no points to start from.

    Raises:
        MissingScene: There is none, or more than one.
    """
    if (folder / "scene.ply").is_file():
        return folder / "scene.ply"
    found = sorted(p for p in folder.glob("*.ply") if p.name not in POINTS)
    if len(found) != 1:
        what = f"{folder}: holds {len(found)} scenes (.ply)"
        raise MissingScene(f"{what}; name one with the option scene, or do fit first")
    return found[0]
