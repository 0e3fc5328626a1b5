"""JSON from files of others: bounded in size and depth."""

from __future__ import annotations

import json
import os
from typing import Any

from sgwarp.errors import InputError
from sgwarp.files.access import read_bytes

LARGEST = 256 * 2**20  # bytes; as Python objects a document takes up to 30 times as much
DEEPEST = 64  # lists and objects within each other


def read_json(path: str | os.PathLike[str], remedy: str = "copy or export it again") -> Any:
    """The content of a JSON file.

    Raises:
        InputError: The file is missing, not JSON, larger than LARGEST or nested deeper than DEEPEST.
    """
    return parse_json(path, read_bytes(path, LARGEST), remedy)


def parse_json(where: str | os.PathLike[str], text: str | bytes, remedy: str = "copy or export it again") -> Any:
    """The content of a JSON document; `where` names it in messages.

    Raises:
        InputError: It is not JSON, nested deeper than DEEPEST, or an entry stands twice in an object.
    """
    try:
        content = json.loads(text, object_pairs_hook=_entries)
    except RecursionError:
        raise InputError(f"{where}: is nested deeper than {DEEPEST}; {remedy}") from None
    except (ValueError, MemoryError) as error:
        line = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{where}: is not valid JSON ({line}); {remedy}") from None
    level = [content]
    for _ in range(DEEPEST):
        level = [item for outer in level for item in _inside(outer) if isinstance(item, (dict, list))]
        if not level:
            return content
    raise InputError(f"{where}: is nested deeper than {DEEPEST}; {remedy}")


def _entries(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object. Readers of JSON differ in which of two entries of one name they take, so none is taken."""
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"the entry '{twice[:40]}' stands twice in one object")
    return found


def _inside(outer: Any) -> Any:
    if isinstance(outer, dict):
        return outer.values()
    return outer if isinstance(outer, list) else ()
