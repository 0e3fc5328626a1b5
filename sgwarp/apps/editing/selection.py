"""What an edit is applied to, as plain data.

A selection is a list of terms, each a short text:

| term | selects |
|---|---|
| lamp, or text:lamp | what the text names; whole instances where they are known |
| id:3 | an instance |
| box:x0,y0,z0,x1,y1,z1 | centers inside a box [m] |
| click:VIEW,x,y | the instance, or what looks alike around it, at a pixel of a view |
| rows:0-4,9 | Gaussians by their place in the scene as it is at that step, ends included |
| copy:1 | what the first duplication added |
| last | what the step before was applied to, or the copy it made |
| all | everything |
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

from sgwarp.errors import InputError

MOST_DIGITS = 12  # of a row number
KINDS = ("text", "id", "box", "click", "copy", "rows")


@dataclass(frozen=True)
class Term:
    """One term, taken apart: `kind` of KINDS, "all" or "last", `text` and `numbers` as it needs them."""

    kind: str
    text: str = ""
    numbers: tuple[float, ...] = ()


@dataclass(frozen=True)
class Selection:
    """Terms and what becomes of the Gaussians they select.

    Attributes:
        select: Terms; what any of them selects.
        keep: Terms whose Gaussians are never selected.
        negatives: Phrases that a Gaussian must fit less than the text.
        threshold: Least score of a text, where 0 is the scene's median and 1 its best thousandth. What scores more than
            half of it and is connected with such Gaussians belongs to them.
        grow: Add what lies within this distance, or if negative take away what lies within it of the rest [m].
        clean: Leave out scattered pieces of each text, id, box and click that hold less than a tenth of the largest.

    Raises:
        InputError: A term is malformed, or a number not finite.
    """

    select: tuple[str, ...]
    keep: tuple[str, ...] = ()
    negatives: tuple[str, ...] = ()
    threshold: float = 0.5
    grow: float = 0.0
    clean: bool = True

    def __post_init__(self) -> None:
        if not self.select:
            raise InputError("select: give at least one term, such as a text, id:3 or box:x0,y0,z0,x1,y1,z1")
        for name in ("select", "keep", "negatives"):
            if isinstance(getattr(self, name), str):
                raise InputError(f"{name}: expected a list of terms, got the text '{getattr(self, name)[:40]}'")
        for term in (*self.select, *self.keep):
            parse_term(term)
        if not all(isinstance(text, str) and text.strip() for text in self.negatives):
            raise InputError("negatives: a phrase is empty")
        for name in ("threshold", "grow"):
            value = getattr(self, name)
            if not is_number(value):
                raise InputError(f"{name}: expected a finite number, got {str(value)[:40]}")
        if not isinstance(self.clean, bool):
            raise InputError(f"clean: expected true or false, got {self.clean!r}")


def is_number(value: Any) -> bool:
    """Whether something is a number that a float can hold; whole numbers of a file may be of any length."""
    largest = sys.float_info.max
    return isinstance(value, (int, float)) and not isinstance(value, bool) and -largest <= value <= largest


def parse_term(term: str) -> Term:
    """A term taken apart.

    Raises:
        InputError: It is empty, or its numbers are missing or malformed.
    """
    if not isinstance(term, str) or not term.strip():
        raise InputError(f"select: a term is a text that is not empty, got {term!r}")
    kind, colon, rest = term.partition(":")
    if term in ("all", "last"):
        return Term(term)
    if not colon or kind not in KINDS:
        return Term("text", term.strip())
    if kind == "text":
        if not rest.strip():
            raise InputError(f"select '{term}': write text:PHRASE")
        return Term("text", rest.strip())
    if kind in ("id", "copy"):
        (number,) = _numbers(term, rest, 1, f"{kind}:NUMBER")
        if number < 1 or number != int(number):
            raise InputError(f"select '{term}': expected a whole number from 1 on")
        return Term(kind, numbers=(number,))
    if kind == "rows":
        return Term(kind, numbers=_ranges(rest))
    if kind == "box":
        corners = _numbers(term, rest, 6, "box:x0,y0,z0,x1,y1,z1")
        if any(low > high for low, high in zip(corners[:3], corners[3:], strict=True)):
            raise InputError(f"select '{term}': the first corner must be the lower one in x, y and z")
        return Term(kind, numbers=corners)
    *names, x, y = rest.rsplit(",", 2) if rest.count(",") > 1 else ("", "", rest)  # a name may hold commas
    return Term(kind, "".join(names), _numbers(term, f"{x},{y}", 2, "click:VIEW,x,y"))


def rows_term(rows: Sequence[int]) -> str:
    """The term that selects these rows, which ascend; runs of them are written as ranges."""
    parts: list[str] = []
    start = last = None
    for row in [*rows, None]:
        if last is not None and row == last + 1:
            last = row
            continue
        if start is not None:
            parts.append(str(start) if start == last else f"{start}-{last}")
        start = last = row
    return "rows:" + ",".join(parts)


def _ranges(text: str) -> tuple[float, ...]:
    """First and last row of each range, one after the other."""
    numbers: list[float] = []
    for part in text.split(","):
        first, dash, last = part.partition("-")
        if not (first.isdecimal() and (last.isdecimal() if dash else True)) or len(part) > 2 * MOST_DIGITS + 1:
            raise InputError(f"select 'rows:': write ranges such as rows:0-4,9; got '{part[:40]}'")
        numbers += [int(first), int(last) if dash else int(first)]
        if numbers[-1] < numbers[-2]:
            raise InputError(f"select 'rows:': the range '{part}' ends before it begins")
    return tuple(numbers)


def _numbers(term: str, text: str, count: int, form: str) -> tuple[float, ...]:
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != count or not all(math.isfinite(number) for number in numbers):
        raise InputError(f"select '{term}': write {form}")
    return numbers


def selection_from(content: Mapping[str, Any]) -> Selection:
    """The selection among the entries of a step of a script.

    Raises:
        InputError: `select` is missing, or an entry has the wrong type.
    """
    given: dict[str, Any] = {}
    for name in (attribute.name for attribute in fields(Selection) if attribute.name in content):
        value = content[name]
        if name in ("select", "keep", "negatives"):
            value = [value] if isinstance(value, str) else value
            if not isinstance(value, (list, tuple)):
                raise InputError(f"{name}: expected a list of texts, got {value!r}")
            value = tuple(value)
        given[name] = value
    if "select" not in given:
        raise InputError("select: is missing; every step says what it is applied to")
    return Selection(**given)
