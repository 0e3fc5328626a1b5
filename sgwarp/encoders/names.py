"""The names that encoders are chosen by, taken apart.

MEMBER[@WEIGHT][++MEMBER[@WEIGHT]...]        an ensemble of members
KIND[:ARGUMENT][?OPTION=VALUE[&...]][+PART]  a member, with masks (+sam:PATH) or a text side (+text:clip:PATH)
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from functools import cache
from typing import Any

from sgwarp.encoders.catalogue import KINDS, TEXT, Kind
from sgwarp.errors import InputError

_WEIGHT = re.compile(r"@(\d+(?:\.\d+)?)$")


@dataclass(frozen=True)
class Part:
    """KIND:ARGUMENT?OPTIONS.

    Attributes:
        name: As written.
        kind: What it is.
        argument: What follows the colon.
        options: Converted to the types of the catalogue.
    """

    name: str
    kind: Kind
    argument: str
    options: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Member:
    """A source with what it is composed of.

    Attributes:
        source: The first part.
        masks: Where masks come from, if named.
        text: Name of the encoder of phrases, if named.
        weight: In an ensemble.
    """

    source: Part
    masks: Part | None = None
    text: str | None = None
    weight: float = 1.0


@cache
def _joints(kinds: tuple[str, ...]) -> tuple[re.Pattern[str], re.Pattern[str]]:
    """What separates parts of a member, and members of an ensemble: a plus counts before the name of a kind alone."""
    known = "|".join(map(re.escape, kinds))
    return re.compile(rf"\+(?=(?:{known})(?:[:?+]|$))"), re.compile(rf"\+\+(?=(?:{known})(?:[:?+@]|$))")


def parse(name: str) -> list[Member]:
    """Members of an ensemble, or the one there is.

    Raises:
        InputError: There is no encoder of that name, or options do not fit.
    """
    _, between_members = _joints((*KINDS, TEXT))
    return [_parse_member(text, name) for text in between_members.split(name)]


def _parse_member(text: str, whole: str) -> Member:
    weight = _WEIGHT.search(text)
    if weight:
        text = text[: weight.start()]
    if weight and float(weight[1]) == 0:
        raise InputError(f"encoder '{whole}': the weight after @ is a positive number, got '{weight[1]}'")
    between_parts, _ = _joints((*KINDS, TEXT))
    first, *rest = between_parts.split(text)
    source = parse_part(first, whole)
    if source.kind.role == "masks":
        raise InputError(f"encoder '{whole}': {source.kind.name} gives masks only; write what looks at them before it")
    masks, spoken = None, None
    for position, part in enumerate(rest):
        if part.partition(":")[0] == TEXT:
            spoken = part.partition(":")[2]
            if position + 1 < len(rest) or not spoken:
                raise InputError(f"encoder '{whole}': +text:NAME goes last, with the name of an encoder of phrases")
            continue
        found = parse_part(part, whole)
        if found.kind.role != "masks" or masks is not None or source.kind.role == "maps":
            raise InputError(f"encoder '{whole}': '{part}' does not go with '{first}'; put ++ between two encoders")
        masks = found
    return Member(source, masks, spoken, float(weight[1]) if weight else 1.0)


def parse_part(text: str, whole: str) -> Part:
    """One part.

    Raises:
        InputError: As `parse`.
    """
    body, _, tail = text.partition("?")
    name, colon, argument = body.partition(":")
    kind = KINDS.get(name)
    if kind is None:
        raise InputError(f"encoder '{whole}' does not exist; there are {', '.join(KINDS)} (see: sgwarp encoders)")
    if kind.argument and not argument and not kind.bare:
        raise InputError(f"encoder '{whole}': write {kind.name}:{kind.argument}")
    if not kind.argument and colon:
        raise InputError(f"encoder '{whole}' does not exist; {kind.name} takes nothing after a colon")
    options = {}
    for piece in filter(None, tail.split("&")):
        key, _, value = piece.partition("=")
        if key not in kind.options:
            known = ", ".join(kind.options) or "none"
            raise InputError(f"encoder '{whole}': {kind.name} has no option '{key}'; its options are: {known}")
        options[key] = _convert(value, kind.options[key], f"encoder '{whole}': option {key}")
    return Part(text, kind, argument, options)


def _convert(value: str, kind: str, what: str) -> Any:
    """The value of an option as its type."""
    if not value:
        raise InputError(f"{what} has no value; write it as key=value")
    try:
        if kind == "int":
            return int(value)
        if kind == "float":
            return float(value)
        if kind == "floats":
            return tuple(float(part) for part in value.split(","))
    except ValueError:
        raise InputError(f"{what}: expected a number, got '{value}'") from None
    if kind == "switch":
        if value not in ("yes", "no"):
            raise InputError(f"{what}: expected yes or no, got '{value}'")
        return value == "yes"
    return tuple(part.strip() for part in value.split(",")) if kind == "list" else value
