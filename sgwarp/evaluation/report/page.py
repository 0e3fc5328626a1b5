"""The report as a page: Markdown tables with run time beside error, and the same figures as JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from sgwarp.evaluation.report.extremes import Extreme
from sgwarp.evaluation.report.stability import GradientResult, ImageResult
from sgwarp.evaluation.report.sweep import DEFAULT, Trial, pareto_front
from sgwarp.files.atomic import atomic_path

PLOT = "error_and_time.png"
MARK = "●"  # on the Pareto front


@dataclass(frozen=True)
class Stability:
    """Result of one extreme scene in one schedule."""

    extreme: Extreme
    schedule: str
    gaussians: int
    image: ImageResult
    gradient: GradientResult | None

    @property
    def within(self) -> bool:
        """Whether everything is finite and within its bound."""
        good = self.image.finite and self.image.error <= self.extreme.image_bound
        bound = self.extreme.gradient_bound
        if self.gradient is None or bound is None:
            return good
        return good and self.gradient.finite and self.gradient.error <= bound


@dataclass
class Findings:
    """Everything the report says.

    Attributes:
        about: Lines about the scene, the machine and how things were measured.
        rounding: Largest error of the default rendering against the oracle with the same settings.
        rendering, lifting: Trials of the sweeps; the default comes first. `lifting` is empty without labels.
        stability: Of the extreme scenes; empty if it was not asked for.
    """

    about: dict[str, Any]
    rounding: float
    rendering: list[Trial]
    lifting: list[Trial] = field(default_factory=list)
    stability: list[Stability] = field(default_factory=list)


def write_json(findings: Findings, path: Path) -> None:
    """The figures for machines; what is not finite becomes null."""
    record = {
        "about": findings.about,
        "rounding": findings.rounding,
        "rendering": _trials(findings.rendering, "psnr"),
        "lifting": _trials(findings.lifting, "miou"),
        "stability": [
            {
                "name": row.extreme.name,
                "what": row.extreme.what,
                "schedule": row.schedule,
                "gaussians": row.gaussians,
                "image_bound": row.extreme.image_bound,
                "gradient_bound": row.extreme.gradient_bound,
                "within": row.within,
                "image": asdict(row.image),
                "gradient": None if row.gradient is None else asdict(row.gradient),
            }
            for row in findings.stability
        ],
    }
    with atomic_path(path) as temporary:
        text = json.dumps(_finite(record), indent=1, allow_nan=False, ensure_ascii=False)
        temporary.write_text(text + "\n", encoding="utf-8")


def write_page(findings: Findings, path: Path) -> None:
    """Markdown with the plot on top, which lies beside it."""
    about = findings.about
    default = findings.rendering[0]
    patches = f"{about['pixels']:,} pixels in patches of {about['patch']} x {about['patch']}"
    parts = [
        f"# Error against run time: {about['scene']}",
        f"{about['gaussians']:,} Gaussians, {about['width']} x {about['height']} pixels, {about['device']} with "
        f"{about['threads']} {'thread' if about['threads'] == 1 else 'threads'}, sgwarp {about['version']}. Run times "
        f"are medians of {about['repeats']} runs in which all settings took turns, ± the median distance from them; "
        "differences below that are noise. One knob is turned at a time, everything else stays at its default.",
        f"![Quality over run time for every knob]({PLOT})",
        f"Up and to the left is better. The grey band is the Pareto front: nothing on this page is both faster and "
        f"better than what lies on it ({MARK} in the tables).",
        "## Rendering",
        f"Against the float64 oracle without any cut-off (every Gaussian down to an alpha of 1/65536, no early end), "
        f"at {patches} of the held-out views {', '.join(about['held_out'])}; the oracle composites every "
        "Gaussian that reaches a patch, which would take minutes for whole images. Errors are those of colours in "
        f"[0, 1]. At the defaults the renderer is {_number(default.errors['max'])} off at worst, which is all in the "
        f"cut-offs: against the oracle with the same cut-offs it is {_number(findings.rounding)}, the rounding of "
        "float32.",
        _rendering_table(findings.rendering),
    ]
    if findings.lifting:
        parts += [
            "## Lifting",
            f"Label images of {about['lifted']} views lifted into the scene, the {len(about['held_out'])} held-out "
            "views segmented, and compared with their own label images. The time is that of both together.",
            _lifting_table(findings.lifting),
        ]
    if findings.stability:
        parts += ["## Stability", *_stability(findings.stability, findings.about["device"])]
    with atomic_path(path) as temporary:
        temporary.write_text("\n\n".join(parts) + "\n", encoding="utf-8")


def _rendering_table(trials: Sequence[Trial]) -> str:
    front = {id(trial) for trial in pareto_front(trials, "psnr")}
    columns = ["knob", "setting", "ms per view", "speed-up", "max error", "mean error", "PSNR [dB]", "front"]
    photographs = "psnr_photograph" in trials[0].errors
    if photographs:
        columns.insert(-1, "PSNR, photographs [dB]")
    rows = []
    for trial in trials:
        errors = trial.errors
        row = [
            *_named(trial),
            f"{trial.seconds * 1e3:.1f} ± {trial.spread * 1e3:.1f}",
            f"{trials[0].seconds / trial.seconds:.2f}",
        ]
        row += [_number(errors["max"]), _number(errors["mean"]), f"{errors['psnr']:.1f}"]
        row += [f"{errors['psnr_photograph']:.2f}"] if photographs else []
        rows.append([*row, MARK if id(trial) in front else ""])
    return _table(columns, rows, text=2)


def _lifting_table(trials: Sequence[Trial]) -> str:
    front = {id(trial) for trial in pareto_front(trials, "miou")}
    columns = ("knob", "setting", "seconds", "speed-up", "mIoU", "pixel accuracy", "Gaussians seen", "front")
    rows = [
        [
            *_named(trial),
            f"{trial.seconds:.3f} ± {trial.spread:.3f}",
            f"{trials[0].seconds / trial.seconds:.2f}",
            f"{trial.errors['miou']:.4f}",
            f"{trial.errors['pixel_accuracy']:.4f}",
            f"{trial.errors['coverage']:.1%}",
            MARK if id(trial) in front else "",
        ]
        for trial in trials
    ]
    return _table(columns, rows, text=2)


def _stability(results: Sequence[Stability], device: str) -> list[str]:
    """One row per extreme scene: the worse of its schedules."""
    by_name: dict[str, list[Stability]] = {}
    for result in results:
        by_name.setdefault(result.extreme.name, []).append(result)
    rows = []
    for name, group in by_name.items():
        first = group[0]
        culled = ", ".join(f"{count:,} {reason.replace('_', ' ')}" for reason, count in first.image.culled.items())
        gradients = [result.gradient.error for result in group if result.gradient is not None]
        bound = first.extreme.gradient_bound
        rows.append(
            [
                f"**{name}**: {first.extreme.what}",
                f"{first.gaussians:,}",
                _number(_worst([result.image.error for result in group])),
                _number(first.extreme.image_bound),
                _number(_worst(gradients)) if gradients else "",
                _number(bound) if bound is not None else "",
                f"{max(result.image.undecidable for result in group):.0%}",
                culled,
                first.extreme.note,
                "yes" if all(result.within for result in group) else "**no**",
            ]
        )
    columns = ["scene", "Gaussians", "error", "bound", "gradient error", "bound", "undecidable", "culled", "how"]
    passed = sum(all(result.within for result in group) for group in by_name.values())
    both = "the schedule of CPUs (lanes) and in that of GPUs (blocks, on fibers); the worse of the two is shown"
    return [
        f"{passed} of {len(by_name)} extreme scenes are finite and within their bounds against the float64 oracle, in "
        f"{both if device == 'CPU' else f'the schedule of GPUs on {device}'}. Errors "
        "are the largest of colour and opacity; gradients are those of a random weighting of the image with respect to "
        "means, rotations, scales, opacities, colours and the camera's rotation and translation, each relative to its "
        "largest entry. Pixels are undecidable in float32, and left out, where an alpha or transmittance lies within "
        "1e-4 of its threshold or two depths within 2e-6 of each other, relatively.",
        _table([*columns, "within"], rows, text=1, words=(7, 8, 9)),
    ]


def _named(trial: Trial) -> list[str]:
    return [f"**{trial.knob}**" if trial.knob == DEFAULT else trial.knob, trial.setting]


def _table(columns: Sequence[str], rows: Sequence[Sequence[str]], text: int, words: Sequence[int] = ()) -> str:
    """Markdown; the first `text` columns and those in `words` are set flush left, the others flush right."""
    marks = ["---" if k < text or k in words else "---:" for k in range(len(columns))]
    return "\n".join("| " + " | ".join(row) + " |" for row in (columns, marks, *rows))


def _number(value: float) -> str:
    """Two significant digits, as people read them."""
    return "0" if value == 0 else f"{value:.1e}" if abs(value) < 1e-3 else f"{value:.2g}"


def _worst(values: Sequence[float]) -> float:
    return math.nan if any(math.isnan(value) for value in values) else max(values)


def _trials(trials: Sequence[Trial], quality: str) -> list[dict[str, Any]]:
    front = {id(trial) for trial in pareto_front(trials, quality)} if trials else set()
    return [asdict(trial) | {"on_front": id(trial) in front} for trial in trials]


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
