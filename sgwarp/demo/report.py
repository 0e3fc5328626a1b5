"""The report of the demonstration: Markdown in a file, the same tables on the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from sgwarp.files.atomic import atomic_path


@dataclass(frozen=True)
class Table:
    """Rows of text under named columns."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]

    @property
    def numeric(self) -> list[bool]:
        """Columns that hold numbers, which are set flush right."""
        return [
            bool(self.rows) and all(row[k].rstrip("%").replace(".", "", 1).isdigit() for row in self.rows)
            for k in range(len(self.columns))
        ]


def write_report(
    path: Path, title: str, lines: Sequence[str], tables: Sequence[Table], pictures: Mapping[str, str]
) -> None:
    """Write Markdown: lines, tables, and the pictures, which lie beside it, with what they show."""
    parts = [f"# {title}", *lines]
    for table in tables:
        marks = ["---:" if numeric else "---" for numeric in table.numeric]
        grid = [table.columns, marks, *table.rows]
        parts += [f"## {table.title}", "\n".join("| " + " | ".join(row) + " |" for row in grid)]
    parts.append("## Pictures")
    parts += [f"{shows[0].upper()}{shows[1:]}:\n\n![{shows}]({name})" for name, shows in pictures.items()]
    with atomic_path(path) as temporary:
        temporary.write_text("\n\n".join(parts) + "\n", encoding="utf-8")


def print_report(headline: str, tables: Sequence[Table], pictures: Mapping[str, str], folder: Path) -> None:
    """Print the tables, with rich if it is installed, and where to look."""
    for table in tables:
        _print_table(table)
    print(f"{headline}\nLook at:")
    width = max(len(str(folder / name)) for name in pictures)
    for name, shows in pictures.items():
        print(f"  {folder / name!s:{width}}  {shows}")
    print(f"  {folder / 'report.md'!s:{width}}  these tables; run.json beside it holds them for machines")


def _print_table(table: Table) -> None:
    try:
        from rich.box import SIMPLE_HEAD
        from rich.console import Console
        from rich.table import Table as RichTable
    except ImportError:
        widths = [max(len(row[k]) for row in (table.columns, *table.rows)) for k in range(len(table.columns))]
        print(table.title)
        for row in (table.columns, *table.rows):
            print("  " + "  ".join(f"{cell:{width}}" for cell, width in zip(row, widths, strict=True)).rstrip())
        print()
        return
    rich = RichTable(title=table.title, title_justify="left", title_style="bold", box=SIMPLE_HEAD)
    for name, numeric in zip(table.columns, table.numeric, strict=True):
        rich.add_column(name, justify="right" if numeric else "left", no_wrap=True)
    for row in table.rows:
        rich.add_row(*row)
    Console().print(rich)
