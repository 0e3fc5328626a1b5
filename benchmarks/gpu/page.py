"""docs/gpu.md from the results."""

from __future__ import annotations

from typing import Any

BEGIN, END = "<!-- measured -->\n", "<!-- end of what was measured -->\n"
NOTHING = "**Not measured yet.** No GPU has run this version; nothing here or elsewhere claims a GPU time.\n"


def written(results: dict[str, Any] | None, page: str) -> str:
    """The page with these results between its two marks; without results from a GPU it says that nothing was measured.

    Raises:
        ValueError: The page has no such marks.
    """
    before, rest = page.split(BEGIN)
    return before + BEGIN + _measured(results) + END + rest.split(END)[1]


def _measured(results: dict[str, Any] | None) -> str:
    if results is None or results.get("tiny") or "name" not in results["machine"]:
        return NOTHING
    facts = results["machine"]
    lines = [f"{facts['name']}, {facts['memory_gib']} GiB, torch {facts['torch']}.\n"]
    for name, part in results["parts"].items():
        lines += [f"### {name}\n", *_rows(part.get("found", part)), ""]
    return "\n".join(lines) + "\n"


def _rows(found: dict[str, Any]) -> list[str]:
    rows = ["| | |", "| --- | --- |"]
    for name, value in found.items():
        shown = value if not isinstance(value, dict) else {k: v for k, v in value.items() if k != "kernels"}
        rows.append(f"| {name} | {_text(shown)} |")
    return rows


def _text(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {_text(v)}" for name, v in value.items())
    return f"{value:.4g}" if isinstance(value, float) else str(value)
