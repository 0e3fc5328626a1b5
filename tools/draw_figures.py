"""Draw the figures of the documentation: `python -m tools.draw_figures`. They are kept in docs/images/."""

from __future__ import annotations

import ast
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import FancyBboxPatch

ROOT = Path(__file__).resolve().parents[1]
IMAGES = ROOT / "docs" / "images"
INK, FILL, ACCENT, EDGE = "#1f2933", "#e6f4f1", "#fde8c8", "#0f766e"


def floors() -> list[tuple[str, ...]]:
    """The floors as tests/test_layers.py states them, bottom to top."""
    tree = ast.parse((ROOT / "tests" / "test_layers.py").read_text(encoding="utf-8"))
    (found,) = (
        node.value for node in tree.body if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "FLOORS"
    )
    stated: list[tuple[str, ...]] = list(ast.literal_eval(found))
    return [kept for names in stated if (kept := tuple(name for name in names if exists(name)))]


def exists(name: str) -> bool:
    return any((ROOT / place).exists() for place in (f"sgwarp/{name}", f"sgwarp/{name}.py"))


def box(axes: Axes, x: float, y: float, width: float, height: float, text: str, fill: str = FILL) -> None:
    shape = FancyBboxPatch((x, y), width, height, boxstyle="round,pad=0,rounding_size=0.12", fc=fill, ec=EDGE, lw=1.2)
    axes.add_patch(shape)
    axes.text(x + width / 2, y + height / 2, text, ha="center", va="center", fontsize=10, color=INK)


def arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float]) -> None:
    axes.annotate("", end, start, arrowprops={"arrowstyle": "-|>", "color": INK, "lw": 1.2})


def blank(width: float, height: float) -> tuple[plt.Figure, Axes]:
    figure, axes = plt.subplots(figsize=(width, height))
    axes.set_xlim(0, width)
    axes.set_ylim(0, height)
    axes.set_aspect("equal")
    axes.axis("off")
    figure.subplots_adjust(0, 0, 1, 1)
    return figure, axes


def draw_floors() -> None:
    levels = floors()
    figure, axes = blank(9.0, 0.62 * len(levels) + 0.2)
    for level, names in enumerate(levels):
        width = 8.6 / len(names)
        for place, name in enumerate(names):
            fill = ACCENT if name in ("ops", "kernels") else FILL
            box(axes, 0.2 + place * width + 0.05, 0.15 + 0.62 * level, width - 0.1, 0.46, name, fill)
    figure.savefig(IMAGES / "floors.png", dpi=150)


def draw_pipeline() -> None:
    figure, axes = blank(10.0, 3.7)
    box(axes, 0.2, 2.6, 1.5, 0.8, "posed\nimages")
    box(axes, 0.2, 0.6, 1.5, 0.8, "Gaussians\n(fit or file)")
    box(axes, 2.5, 2.6, 1.7, 0.8, "2D encoder\nfeature maps", FILL)
    box(axes, 2.5, 0.6, 1.7, 0.8, "project, sort,\nbin into tiles", ACCENT)
    box(axes, 5.0, 1.6, 1.7, 0.8, "lift:\n$f = A^T F$", ACCENT)
    box(axes, 5.0, 0.2, 1.7, 0.8, "3D network\n(distilled)", FILL)
    box(axes, 7.4, 1.6, 1.1, 0.8, "text\nscores", FILL)
    box(axes, 8.8, 2.6, 1.1, 0.8, "render:\n$A\\,s$", ACCENT)
    box(axes, 8.8, 0.6, 1.1, 0.8, "select,\nedit, track", FILL)
    for start, end in (
        ((1.7, 3.0), (2.5, 3.0)),
        ((1.7, 1.0), (2.5, 1.0)),
        ((0.95, 2.6), (0.95, 1.4)),
        ((4.2, 2.8), (5.0, 2.25)),
        ((4.2, 1.2), (5.0, 1.75)),
        ((6.7, 2.0), (7.4, 2.0)),
        ((5.85, 1.6), (5.85, 1.0)),
        ((6.7, 0.7), (7.5, 1.6)),
        ((8.5, 2.2), (8.9, 2.6)),
        ((8.5, 1.8), (8.9, 1.4)),
    ):
        arrow(axes, start, end)
    axes.text(5.0, 3.45, "Warp kernels, CPU and CUDA", fontsize=9, color=INK, va="center")
    legend = "round,pad=0,rounding_size=0.05"
    axes.add_patch(FancyBboxPatch((4.62, 3.36), 0.28, 0.18, boxstyle=legend, fc=ACCENT, ec=EDGE))
    figure.savefig(IMAGES / "pipeline.png", dpi=150)


if __name__ == "__main__":
    draw_floors()
    draw_pipeline()
