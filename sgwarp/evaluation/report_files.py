"""results.json, results.md and results.tex: accuracy beside seconds, memory, bytes, and published figures."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sgwarp.evaluation.evaluator import Evaluation
from sgwarp.evaluation.profiles.base import pooled
from sgwarp.evaluation.published import Published, find_published
from sgwarp.evaluation.results import finite
from sgwarp.evaluation.tables import NOTHING, Table, number, percent, seconds_of, size
from sgwarp.files.atomic import atomic_path
from sgwarp.metrics.overlap import mean
from sgwarp.version import __version__

UNSHARED = {"residual", "held_out_residual", "switches"}  # figures that are no share of anything
ASK_STAGES = ("query", "answer", "locate")
OTHER_STAGES = (  # what all methods share, and what only measures or draws
    *("read", "gaussians_from_depth", "load_encoder", "encode", "compare", "residual", "measure", "match"),
    *("compare_views", "draw"),
)


def write_tables(found: Evaluation, out: Path, extra: Sequence[Table] = ()) -> list[Path]:
    """Write the three files; returns their paths."""
    tables = [headline(found), by_scene(found), *by_class(found), stages(found), *extra]
    paths = [out / "results.json", out / "results.md", out / "results.tex"]
    texts = [
        json.dumps(finite(as_record(found)), indent=1, allow_nan=False) + "\n",
        _page(found, tables),
        "\n\n".join(table.latex() for table in tables) + "\n",
    ]
    for path, text in zip(paths, texts, strict=True):
        with atomic_path(path) as temporary:
            temporary.write_text(text, encoding="utf-8")
    return paths


def as_record(found: Evaluation) -> dict[str, Any]:
    """Everything, for machines."""
    from dataclasses import asdict

    profile = found.profile
    return {
        "profile": profile.name,
        "version": __version__,
        "settings": found.settings.identity | {"device": found.settings.device},
        "figures": found.figures,
        "headline": list(profile.headline),
        "scenes": {result.scene: asdict(result) for result in found.results},
        "failed": found.failed,
        "not_in_the_data": found.absent,
        "seconds": found.seconds,
        "peak_memory": max(result.peak_memory for result in found.results),
        "bytes_per_gaussian": mean(result.bytes_per_gaussian for result in found.results),
        "published": [asdict(row) for row in find_published(profile.name)],
        "differences": list(profile.differences),
    }


def method_seconds(seconds: dict[str, float]) -> float:
    """Seconds of lifting or training alone: not of reading, encoding, checking and drawing, nor of asking."""
    return sum(value for name, value in seconds.items() if name not in (*OTHER_STAGES, *ASK_STAGES))


def ask_seconds(seconds: dict[str, float]) -> float:
    """Seconds of asking: scores and views."""
    return sum(seconds.get(name, 0.0) for name in ASK_STAGES)


def headline(found: Evaluation) -> Table:
    """Ours above the published systems."""
    names = found.profile.headline
    count = max(1, len(found.results))
    cost = [
        seconds_of(method_seconds(found.seconds) / count),
        seconds_of(ask_seconds(found.seconds) / count),
        size(max(result.peak_memory for result in found.results)),
        number(mean(result.bytes_per_gaussian for result in found.results)),
    ]
    settings = found.settings
    rows = [
        [
            f"sgwarp, {settings.method}, {settings.encoder}",
            *(cell(n, found.figures.get(n)) for n in names),
            *cost,
            "this run",
        ]
    ]
    rows += [_published_row(row, names) for row in find_published(found.profile.name)]
    columns = ["system", *names, "lifting [s]", "asking [s]", "memory", "B/Gaussian", "source"]
    return Table("Results", columns, rows, frozenset({"source", "lifting [s]"}), frozenset({0}))


def _published_row(row: Published, names: Sequence[str]) -> list[str]:
    mark = " (second hand)" if row.second_hand else ""
    figures = (cell(name, row.figures.get(name)) for name in names)
    return [
        f"{row.system} ({row.kind})",
        *figures,
        row.seconds or NOTHING,
        NOTHING,
        NOTHING,
        NOTHING,
        row.source + mark,
    ]


def cell(name: str, value: float | None) -> str:
    """A figure as its kind is written."""
    return number(value) if name in UNSHARED else percent(value)


def by_scene(found: Evaluation) -> Table:
    """Every scene, and why others have no figures."""
    names = [name for name in found.profile.headline if any(name in result.figures for result in found.results)]
    names += [name for name in ("accuracy_3d",) if any(name in result.figures for result in found.results)]
    rows = []
    for result in found.results:
        views = f"{result.views.get('lifted', 0)}/{result.views.get('scored', 0)}"
        cost = [seconds_of(method_seconds(result.seconds)), size(result.peak_memory), number(result.bytes_per_gaussian)]
        rows.append(
            [result.scene, *(cell(n, result.figures.get(n)) for n in names), views, str(result.gaussians), *cost]
        )
    rows += [[name, *[NOTHING] * (len(names) + 5)] for name in found.failed]
    return Table(
        "Scenes", ["scene", *names, "views lifted/scored", "Gaussians", "lifting [s]", "memory", "B/Gaussian"], rows
    )


def by_class(found: Evaluation) -> list[Table]:
    """Classes over all scenes, where there is one confusion matrix."""
    whole = pooled(found.results)
    if whole is None:
        return []
    names = found.results[0].classes
    pixels = whole.counts.sum(dim=1)
    rows = [
        [
            name,
            percent(float(whole.iou[k])),
            percent(float(whole.accuracy[k])),
            percent(float(whole.precision[k])),
            str(int(pixels[k])),
        ]
        for k, name in enumerate(names)
        if int(pixels[k])
    ]
    return [Table("Classes", ["class", "IoU", "accuracy", "precision", "pixels"], rows)]


def stages(found: Evaluation) -> Table:
    """Seconds per stage, a scene on average."""
    count = max(1, len(found.results))
    rows = [[name, seconds_of(value / count)] for name, value in found.seconds.items()]
    return Table("Seconds per stage and scene", ["stage", "seconds"], rows)


def _page(found: Evaluation, tables: Sequence[Table]) -> str:
    settings = found.settings
    about = (
        f"{found.profile.about[0].upper()}{found.profile.about[1:]}. sgwarp {__version__}, device {settings.device}, "
        f"encoder `{settings.encoder}`, method `{settings.method}`, views `{settings.views}`. "
        "Figures are percent, except seconds, bytes and the residual."
    )
    parts = [f"# Evaluation: {found.profile.name}", about, *(table.markdown() for table in tables)]
    if found.profile.differences:
        parts.append("## Differences of protocols\n\n" + "\n".join(f"- {line}" for line in found.profile.differences))
    if found.absent:
        parts.append(f"Scenes of the published list that are not in the data: {', '.join(found.absent)}.")
    if found.failed:
        parts.append("## Failed\n\n" + "\n".join(f"- {name}: {error}" for name, error in found.failed.items()))
    sheets = [sheet for result in found.results for sheet in result.sheets]
    if sheets:
        parts.append("## Sheets\n\n" + "\n\n".join(f"![{sheet}]({sheet})" for sheet in sheets[:24]))
    return "\n\n".join(parts) + "\n"
