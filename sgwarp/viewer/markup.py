"""Lines of the panel as HTML and Markdown; what users typed stays text."""

from __future__ import annotations

import html


def legend_rows(rows: list[tuple[str, str]]) -> str:
    """Names with a square of their color."""
    lines = [
        f'<div><span style="display:inline-block;width:0.9em;height:0.9em;background:{color};'
        f'border:1px solid #868e96;margin-right:0.5em">'
        f"</span>{html.escape(name)}</div>"
        for name, color in rows[:32]
    ]
    return f'<div style="padding:0 1em;font-size:0.85em">{"".join(lines)}</div>' if lines else ""


def score_table(rows: list[tuple[str, float]]) -> str:
    """Names with scores, and a bar of each score."""
    lines = [
        f'<tr><td>{html.escape(name)}</td><td style="width:40%"><div style="height:0.6em;background:#e8590c;'
        f'width:{100 * min(max(score, 0.0), 1.0):.0f}%"></div></td><td>{score_text(score)}</td></tr>'
        for name, score in rows
    ]
    return f'<table style="margin:0.3em 1em;width:90%;font-size:0.85em">{"".join(lines)}</table>' if lines else ""


def score_text(value: float) -> str:
    """Two decimals."""
    return f"{round(value, 2) + 0.0:.2f}"  # no -0.00


def notice(text: str) -> str:
    """A line of text; nothing for none."""
    return f'<div style="padding:0 1em;font-size:0.85em">{html.escape(text)}</div>' if text else ""


def as_plain(text: str) -> str:
    """Text that Markdown shows as it is."""
    return "".join(f"\\{letter}" if letter in "\\`*_{}[]<>()#+!|~" else letter for letter in text)
