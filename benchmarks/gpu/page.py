"""docs/gpu.md from the results."""

from __future__ import annotations

from typing import Any

HEAD = """# On a GPU

`python -m benchmarks.gpu` checks every operation on a CUDA device against the CPU and the float64 oracle, and then
times it: by events on the device, on the host, and kernel by kernel. It takes ten minutes. A machine without network is
served by `tools/pack_for_gpu.sh`.

"""
NOTHING = "**Not measured yet.** No GPU has run this version; nothing here or elsewhere claims a GPU time.\n"


def written(results: dict[str, Any] | None) -> str:
    """The page; without results from a GPU it says that nothing was measured."""
    if results is None or results.get("tiny") or "name" not in results["machine"]:
        return HEAD + NOTHING
    facts = results["machine"]
    lines = [f"{facts['name']}, {facts['memory_gib']} GiB, torch {facts['torch']}.\n"]
    for name, part in results["parts"].items():
        lines += [f"## {name}\n", *_rows(part.get("found", part)), ""]
    return HEAD + "\n".join(lines)


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
