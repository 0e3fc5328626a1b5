"""Tables as Markdown and LaTeX, from one description."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

NOTHING = "–"


@dataclass(frozen=True)
class Table:
    """Rows of text under named columns.

    Attributes:
        title: One line.
        columns: Names; the first column is text, the others are numbers unless listed in `words`.
        rows: Cells as text.
        words: Columns after the first that hold words.
        rule_after: Rows after which a line is drawn, in LaTeX.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    words: frozenset[str] = frozenset()
    rule_after: frozenset[int] = frozenset()

    def markdown(self) -> str:
        """The table with its title as a heading."""
        marks = ["---" if self._is_text(k) else "---:" for k in range(len(self.columns))]
        grid = [list(self.columns), marks, *([cell.replace("|", "\\|") for cell in row] for row in self.rows)]
        return f"## {self.title}\n\n" + "\n".join("| " + " | ".join(row) + " |" for row in grid)

    def latex(self) -> str:
        """The same for the package booktabs."""
        layout = "".join("l" if self._is_text(k) else "r" for k in range(len(self.columns)))
        lines = [
            f"% {self.title}",
            f"\\begin{{tabular}}{{{layout}}}",
            "\\toprule",
            _latex_row(self.columns),
            "\\midrule",
        ]
        for number, row in enumerate(self.rows):
            lines.append(_latex_row(row))
            if number in self.rule_after and number + 1 < len(self.rows):
                lines.append("\\midrule")
        return "\n".join([*lines, "\\bottomrule", "\\end{tabular}"])

    def _is_text(self, column: int) -> bool:
        return column == 0 or self.columns[column] in self.words


ESCAPES = {
    "&": r"\&",
    "%": r"\%",
    "_": r"\_",
    "#": r"\#",
    "$": r"\$",
    "–": "--",
    "{": r"\{",
    "}": r"\}",
    "\\": r"\textbackslash{}",
}


def _latex_row(cells: Sequence[str]) -> str:
    return " & ".join("".join(ESCAPES.get(letter, letter) for letter in cell) for cell in cells) + " \\\\"


def percent(value: float | None) -> str:
    """A share as percent with one decimal."""
    return NOTHING if value is None or math.isnan(value) else f"{100 * value:.1f}"


def number(value: float | None) -> str:
    """A number with three digits."""
    return NOTHING if value is None or math.isnan(value) else f"{value:.3g}"


def seconds_of(value: float) -> str:
    """Seconds with two decimals below ten, else whole."""
    return f"{value:.2f}" if value < 10 else f"{value:.0f}"


def size(count: float) -> str:
    """Bytes as MB or GB."""
    return NOTHING if not count else f"{count / 1e6:.0f} MB" if count < 1e9 else f"{count / 1e9:.2f} GB"
