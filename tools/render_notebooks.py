"""Run the notebooks and keep them as pages with their pictures: `python -m tools.render_notebooks [NAME ...]`.

The pages go to docs/notebooks/. Each begins with a hash of its notebook, so that a test notices when they differ.
"""

from __future__ import annotations

import argparse
import base64
import hashlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import jupytext
import numpy as np
from nbclient import NotebookClient

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ROOT / "notebooks"
PAGES = ROOT / "docs" / "notebooks"
QUALITY = 85  # of the pictures, JPEG
LONGEST = 40  # lines of printed output that are kept
ANSI = re.compile(r"\x1b\[[0-9;]*m")


def digest(source: Path) -> str:
    return hashlib.sha256(source.read_bytes()).hexdigest()[:16]


def render(source: Path) -> None:
    """Run one notebook and write its page and pictures."""
    notebook = jupytext.read(source, fmt="py:percent")
    NotebookClient(notebook, timeout=1800, resources={"metadata": {"path": str(SOURCES)}}).execute()
    PAGES.mkdir(parents=True, exist_ok=True)
    for old in PAGES.glob(f"{source.stem}_*.jpg"):
        old.unlink()
    parts = [f"<!-- notebooks/{source.name} {digest(source)} -->"]
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            parts.append(as_arithmatex(cell.source))
        elif cell.cell_type == "code":
            parts.append(f"```python\n{cell.source}\n```")
            parts.extend(outputs(cell, source.stem, len(parts)))
    (PAGES / f"{source.stem}.md").write_text("\n\n".join(parts) + "\n", encoding="utf-8")


def as_arithmatex(text: str) -> str:
    """Links of notebooks to each other, as pages."""
    return re.sub(r"\]\((\d\d_\w+)\.(?:py|ipynb)\)", r"](\1.md)", text)


def outputs(cell: Any, stem: str, number: int) -> Iterator[str]:
    for place, output in enumerate(cell.outputs):
        data = output.get("data", {})
        if "image/png" in data:
            name = f"{stem}_{number:03d}_{place}.jpg"
            pixels = cv2.imdecode(np.frombuffer(base64.b64decode(data["image/png"]), np.uint8), cv2.IMREAD_COLOR)
            cv2.imwrite(str(PAGES / name), pixels, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
            yield f"![Output of the cell above]({name})"
        else:
            text = ANSI.sub("", output.get("text", data.get("text/plain", ""))).rstrip()
            if text and output.get("name") != "stderr":
                yield "```text\n" + "\n".join(text.splitlines()[:LONGEST]) + "\n```"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="stems of notebooks; all if none is given")
    names = parser.parse_args().names
    for source in sorted(SOURCES.glob("*.py")):
        if not names or source.stem in names:
            print(source.stem, flush=True)
            render(source)


if __name__ == "__main__":
    main()
