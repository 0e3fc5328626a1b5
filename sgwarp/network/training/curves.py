"""The curves of a training run, as JSON and as a picture."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from sgwarp.files.atomic import atomic_path
from sgwarp.network.training.settings import Epoch


def write_curves(history: Sequence[Epoch], stem: Path) -> list[Path]:
    """{stem}_curves.json, and with matplotlib {stem}_curves.png: loss, validation cosine and mIoU by epoch."""
    written = [stem.with_name(f"{stem.name}_curves.json")]
    with atomic_path(written[0]) as temporary:
        figures = [asdict(epoch) for epoch in history]
        temporary.write_text(json.dumps(figures, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    try:
        from matplotlib.figure import Figure
    except ImportError:
        return written
    figure = Figure(figsize=(6.4, 3.6), layout="constrained")
    axes = figure.subplots()
    for name, colour in (("loss", "tab:blue"), ("cosine", "tab:orange"), ("miou", "tab:green")):
        points = [(e.epoch, getattr(e, name)) for e in history if getattr(e, name) is not None]
        if points:
            title = {"loss": "training loss", "cosine": "validation cosine", "miou": "validation mIoU"}[name]
            axes.plot(*zip(*points, strict=True), color=colour, label=title, marker="." if len(points) < 30 else "")
    axes.set_xlabel("epoch")
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)
    if axes.lines:
        axes.legend()
    picture = stem.with_name(f"{stem.name}_curves.png")
    with atomic_path(picture) as temporary:
        figure.savefig(temporary, dpi=120)
    return [*written, picture]
